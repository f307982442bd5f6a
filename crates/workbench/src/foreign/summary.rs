//! What a record of any rig tells: its response, its harmonics, a model; in words, as JSON and on a page.

use super::base::{self, Base, coefficients};
use super::form::Asked;
use super::sources::Source;
use cellpos_ident::feedback::feedback;
use cellpos_ident::foreign::{
    Basis, Excitation, ForeignResult, ForeignSettings, bridged, identify, identify_in_loop,
    nothing_to_tell,
};
use cellpos_ident::rational::RationalFit;
use cellpos_ident::sampled::Hold;
use cellpos_numeric::statistics::Z95;
use cellpos_plant::Model;
use cellpos_report::{
    Column, Emphasis, Figure, Report, Series, Table, log_grid, number, with_interval,
};
use cellpos_session::Failure;
use serde_json::{Value, json};
use std::fmt::Write;
use std::path::{Path, PathBuf};

const NO_LINEAR: &str = "the output has harmonics that the input has not: no linear model explains them, but hysteresis, saturation and other nonlinearities do; `cellpos reconcile` searches for them";

const IN_LOOP: &str = "a record of a closed loop: input and output were both projected on the reference, which is free of the noise";
const NOTHING: &str = "a record of a closed loop that nothing from outside moved: the position moves the actuator as much as the actuator the position, and what the record shows is the controller's inverse as well as the plant. No response and no model can be taken from it. A record with a moving reference (track --sine, a script), or cellpos identify, which excites the loop, can tell";

const NO_MODEL: &str = "no linear model: each one that fits is unstable, and the plant is not (Eq. (1)-(3) are passive)";

/// Why there is no model.
fn no_model(r: &ForeignResult) -> &'static str {
    if r.points.len() < 3 {
        "no linear model: one or two frequencies give gain and lag there only"
    } else {
        NO_MODEL
    }
}

/// The model of other rigs' records, fitted in time to every record. None for records of this rig, of a loop, or of too few rows
/// where no form was asked for.
///
/// # Errors
/// A stated form that cannot be fitted, and records of different rates.
pub fn base_of(
    asked: Option<Asked>,
    foreign: bool,
    (hold, most_order): (Hold, usize),
    sources: &[Source],
    results: &[(PathBuf, ForeignResult)],
) -> Result<Option<Base>, Failure> {
    let of_loop = results.iter().any(|(_, r)| r.basis != Basis::Input);
    if !foreign || (of_loop && asked.is_none()) {
        return Ok(None);
    }
    if of_loop {
        tracing::warn!(
            "a record looks like that of a loop: its noise is in its input too, and the base model may be the controller's inverse"
        );
    }
    // One or two frequencies tell gain and lag there; more of a model than that must be asked for.
    let sparse = results.iter().all(|(_, r)| r.points.len() < 3) && !results.is_empty();
    if sparse && asked.is_none() {
        return Ok(None);
    }
    let rate_hz = base::common_rate(sources.iter().map(|s| s.rate_hz))?;
    let records: Vec<_> = (sources.iter())
        .map(|s| cellpos_ident::base::Series {
            input: s.input.clone(),
            output: s.output.clone(),
        })
        .collect();
    let found = base::fit(
        &records,
        rate_hz,
        hold,
        asked.and_then(Asked::form),
        most_order,
    );
    let spectral = results.iter().any(|(_, r)| !r.models.is_empty());
    match found {
        // Brownian motion on an integrator is no error of the free run: the response, fitted on increments, knows more.
        Ok(base) if base.fit.wanders && responds(results) && asked.is_none() => Ok(None),
        Ok(base) => Ok(Some(base)),
        Err(error) if asked.is_some() || !spectral => Err(error),
        Err(_) => Ok(None),
    }
}

/// Whether a frequency response has told a plant that integrates, number by number.
fn responds(results: &[(PathBuf, ForeignResult)]) -> bool {
    results.iter().any(|(_, r)| {
        let slowest = r.points.first().map_or(0.0, |p| p.frequency_hz);
        (r.models.first()).is_some_and(|m| {
            let below = std::f64::consts::TAU * slowest;
            identified(m) && m.poles.iter().any(|p| p.norm() < below)
        })
    })
}

fn mean_input(sources: &[Source]) -> f64 {
    let first = sources.first().map_or(&[][..], |s| &s.input);
    first.iter().sum::<f64>() / first.len().max(1) as f64
}

/// Identifies one record: of a loop from its reference, else from its input. `foreign`: of another rig.
///
/// # Errors
/// A record that is too short or holds no motion.
pub fn judge(
    source: &Source,
    foreign: bool,
    settings: &ForeignSettings,
) -> Result<ForeignResult, cellpos_ident::IdentError> {
    let (input, output) = (&source.input, &source.output);
    let found = feedback(input, output);
    // A record of another rig was perhaps taken with a noisy input: only a loop makes half of its change answer the output.
    let least = if foreign { 0.5 } else { 0.0 };
    let closed =
        source.closed || found.is_some_and(|found| found.is_there() && found.share > least);
    match &source.reference {
        Some(reference) if closed => identify_in_loop(reference, input, output, settings),
        None if closed => Ok(nothing_to_tell(
            output,
            settings,
            found.map(|found| found.share),
        )),
        _ => identify(input, &bridged(output), settings),
    }
}

/// The model that the records tell: the base, else that of the first response that has one.
///
/// # Errors
/// A model that no file can hold.
pub fn model(
    base: Option<&Base>,
    sources: &[Source],
    results: &[(PathBuf, ForeignResult)],
) -> Result<Option<Model>, Failure> {
    let told = results
        .iter()
        .find_map(|(_, r)| r.models.first().map(|m| (m, r.sampling.hold)));
    match (base, told) {
        (Some(base), _) => base.model().map(Some),
        (None, Some((best, hold))) => {
            let mut model = base::model_of(best, hold, mean_input(sources))?;
            (model.provenance).insert("verdict".to_owned(), model_verdict(best).to_owned());
            Ok(Some(model))
        }
        (None, None) => Ok(None),
    }
}

/// What is to be said of a record before its figures.
fn verdict(r: &ForeignResult) -> Option<String> {
    match r.basis {
        Basis::Input => None,
        Basis::Reference => Some(IN_LOOP.to_owned()),
        Basis::Nothing { share } => Some(match share {
            Some(share) => format!(
                "{NOTHING} (the position's past tells {:.0} % of what the actuator does)",
                100.0 * share
            ),
            None => NOTHING.to_owned(),
        }),
    }
}

/// Whether the record determines a model's numbers: no interval is wider than its number.
fn identified(m: &RationalFit) -> bool {
    let told = |values: &[f64], sds: &[f64]| {
        values
            .iter()
            .zip(sds)
            .all(|(value, sd)| sd.is_finite() && (Z95 * sd <= value.abs() || *sd == 0.0))
    };
    told(&m.numerator, &m.numerator_sd)
        && told(&m.denominator, &m.denominator_sd)
        && m.delay_sd_s.is_finite()
}

fn model_verdict(m: &RationalFit) -> &'static str {
    if identified(m) {
        "identified"
    } else {
        "not identifiable from this record: an interval is wider than its value"
    }
}

/// The model's order and numbers, with their 95 % intervals.
fn numbers_of(m: &RationalFit) -> String {
    format!(
        "model of order {}: num {}, den {}, delay {} ms",
        m.order,
        coefficients(&m.numerator, &m.numerator_sd),
        coefficients(&m.denominator, &m.denominator_sd),
        with_interval(m.delay_s * 1e3, 1e3 * Z95 * m.delay_sd_s)
    )
}

/// What a record tells, as JSON.
pub fn to_json(path: &Path, r: &ForeignResult) -> Value {
    let lines: Vec<Value> = r
        .lines
        .iter()
        .map(|l| {
            json!({
                "frequency_hz": l.frequency_hz, "gain": l.gain, "gain_ci95": l.gain_ci95, "phase_deg": l.phase_deg,
                "phase_ci95_deg": l.phase_ci95_deg, "lag_ms": l.lag_ms, "coherence": l.coherence,
            })
        })
        .collect();
    let harmonics: Vec<Value> = r
        .harmonics
        .iter()
        .map(|h| {
            json!({
                "fundamental_hz": h.fundamental_hz, "number": h.number, "output_ratio": h.output_ratio,
                "input_ratio": h.input_ratio, "p_value": h.p_value, "unexplained_by_linear": h.unexplained,
            })
        })
        .collect();
    let models: Vec<Value> = r
        .models
        .iter()
        .take(5)
        .map(|m| {
            json!({
                "order": m.order, "num": m.numerator, "num_sd": m.numerator_sd, "den": m.denominator, "den_sd": m.denominator_sd,
                "delay_ms": m.delay_s * 1e3, "delay_sd_ms": m.delay_sd_s * 1e3,
                "verdict": model_verdict(m), "delay_ci95_ms": if m.delay_sd_s.is_finite() { json!([(m.delay_s - Z95 * m.delay_sd_s) * 1e3, (m.delay_s + Z95 * m.delay_sd_s) * 1e3]) } else { Value::Null },
                "poles_rad_per_s": m.poles.iter().map(|p| [p.re, p.im]).collect::<Vec<_>>(), "chi2": m.chi2, "dof": m.dof,
            })
        })
        .collect();
    json!({
        "file": path.display().to_string(),
        "basis": match r.basis { Basis::Input => "input", Basis::Reference => "reference", Basis::Nothing { .. } => "nothing" },
        "verdict": verdict(r),
        "excitation": match r.excitation { Excitation::Lines => "lines", Excitation::Broadband => "broadband" },
        "lines": lines,
        "harmonics": harmonics,
        "harmonics_remain": r.harmonics_remain(),
        "message": if r.harmonics_remain() { json!(NO_LINEAR) } else { Value::Null },
        "models": models,
        "output_rms": r.output_rms,
        "linear_residual_rms": r.linear_residual_rms,
        "points": r.points.len(),
    })
}

/// What a record tells, in words; `with_model` where no base model of all records is said beside it.
pub fn to_text(path: &Path, r: &ForeignResult, with_model: bool) -> String {
    let mut out = format!("{}\n", path.display());
    if let Some(verdict) = verdict(r) {
        let _ = writeln!(out, "  {verdict}");
    }
    for l in r.lines.iter().take(12) {
        let _ = writeln!(
            out,
            "  {:.4} Hz: gain {} +- {}, phase {:.2} +- {:.2} deg, lag {:.2} ms, coherence {:.5}",
            l.frequency_hz,
            number(l.gain),
            number(l.gain_ci95),
            l.phase_deg,
            l.phase_ci95_deg,
            l.lag_ms,
            l.coherence
        );
    }
    for h in r.harmonics.iter().filter(|h| h.unexplained) {
        let _ = writeln!(
            out,
            "  harmonic {} of {:.4} Hz: {:.2} % of the fundamental",
            h.number,
            h.fundamental_hz,
            100.0 * h.output_ratio
        );
    }
    if r.harmonics_remain() {
        let _ = writeln!(out, "  {NO_LINEAR}");
    }
    if !with_model {
        // The base model of all records stands below.
    } else if let Some(m) = r.models.first() {
        let _ = writeln!(out, "  linear {}: {}", numbers_of(m), model_verdict(m));
    } else if !matches!(r.basis, Basis::Nothing { .. }) {
        let _ = writeln!(out, "  {}", no_model(r));
    }
    if let Some(left) = r.linear_residual_rms {
        let _ = writeln!(
            out,
            "  the coherent linear part leaves {} RMS of {} RMS",
            number(left),
            number(r.output_rms)
        );
    }
    out
}

/// The page of some records.
pub fn report(results: &[(PathBuf, ForeignResult)], base: Option<&Base>) -> Report {
    let mut report = Report::new("Identification of records");
    if let Some(base) = base {
        report.section("Base model of all records");
        report.paragraph(&base.words());
    }
    for (index, (path, r)) in results.iter().enumerate() {
        report.section(&path.display().to_string());
        match (r.basis, verdict(r)) {
            (Basis::Nothing { .. }, Some(verdict)) => {
                report.note(Emphasis::Bad, &verdict);
                continue;
            }
            (_, Some(verdict)) => {
                report.note(Emphasis::Plain, &verdict);
            }
            (_, None) => {}
        }
        if r.harmonics_remain() {
            report.note(Emphasis::Warning, NO_LINEAR);
        }
        match r.models.first() {
            _ if base.is_some() => {}
            Some(m) => {
                report.paragraph(&format!(
                    "Linear {} (95 % intervals): {}.",
                    numbers_of(m),
                    model_verdict(m)
                ));
            }
            None => {
                report.note(Emphasis::Warning, no_model(r));
            }
        }
        if !r.lines.is_empty() {
            let mut table = Table::new([
                Column::right("Hz"),
                Column::right("gain"),
                Column::right("phase deg"),
                Column::right("lag ms"),
                Column::right("coherence"),
            ]);
            for l in &r.lines {
                table.row([
                    format!("{:.4}", l.frequency_hz),
                    format!("{} +- {}", number(l.gain), number(l.gain_ci95)),
                    format!("{:.2} +- {:.2}", l.phase_deg, l.phase_ci95_deg),
                    format!("{:.2}", l.lag_ms),
                    format!("{:.5}", l.coherence),
                ]);
            }
            report.table(table);
        }
        if !r.harmonics.is_empty() {
            let mut table = Table::new([
                Column::left("harmonic"),
                Column::right("output %"),
                Column::right("input %"),
                Column::left("linear?"),
            ]);
            for h in &r.harmonics {
                table.row([
                    format!("{} x {:.4} Hz", h.number, h.fundamental_hz),
                    format!("{:.3}", 100.0 * h.output_ratio),
                    format!("{:.3}", 100.0 * h.input_ratio),
                    if h.unexplained {
                        "no linear model explains it"
                    } else {
                        "within noise or the input's own"
                    }
                    .to_owned(),
                ]);
            }
            report.table(table);
        }
        report.figure(bode(index, r));
    }
    report
}

fn bode(index: usize, r: &ForeignResult) -> Figure {
    let f: Vec<f64> = r.points.iter().map(|p| p.frequency_hz).collect();
    let gain: Vec<f64> = r.points.iter().map(|p| p.gain_db()).collect();
    let phase: Vec<f64> = r.points.iter().map(|p| p.phase_deg()).collect();
    let low = f.iter().copied().fold(f64::INFINITY, f64::min);
    let high = f.iter().copied().fold(0.0, f64::max);
    let grid = log_grid(0.5 * low, (2.0 * high).min(0.49 / r.sampling.period_s), 200);
    let mut figure = Figure::bode(
        &format!("bode-{}", index + 1),
        "Response in the record and the chosen linear model with delay.",
    )
    .bode_series(
        Series::points("record", &f, &gain),
        Series::points("record", &f, &phase),
    );
    if let Some(m) = r.models.first() {
        let curve = grid.iter().map(|&f| m.sampled_response(f, r.sampling));
        let (g, p): (Vec<f64>, Vec<f64>) = curve
            .map(|c| (20.0 * c.norm().log10(), c.arg().to_degrees()))
            .unzip();
        figure = figure.bode_series(
            Series::line("model", &grid, &g),
            Series::line("model", &grid, &p),
        );
    }
    figure
}
