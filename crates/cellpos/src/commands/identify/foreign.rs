//! `cellpos identify --data`: anybody's records.

use super::Args;
use super::report::log_grid;
use super::sources::{self, Source};
use crate::outcome::{CommandResult, Failure, Outcome, print_json, print_text};
use cellpos_ident::feedback::feedback;
use cellpos_ident::foreign::{
    Basis, Excitation, ForeignResult, ForeignSettings, bridged, identify, identify_in_loop,
    nothing_to_tell,
};
use cellpos_ident::rational::RationalFit;
use cellpos_plant::Model;
use cellpos_report::{
    Axis, Column, Emphasis, Figure, Panel, Report, Series, Table, number, with_interval,
};
use cellpos_workbench::foreign::base::{self, Base, coefficients};
use cellpos_workbench::foreign::form::Asked;
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

/// Runs the command on records.
pub(super) fn run(args: &Args) -> CommandResult {
    let mut results = Vec::new();
    let mut sources = Vec::new();
    for path in &args.data {
        for source in sources::read(path, args)? {
            let result = judge(&source, args);
            // A record without a spectrum can still have a model in time.
            match result {
                Ok(result) => results.push((PathBuf::from(&source.name), result)),
                Err(e) if args.input.is_none() => {
                    return Err(Failure::bad_input(
                        format!("{}: {e}", source.name),
                        "check --input, --output and --rate, or give a longer record",
                    ));
                }
                Err(e) => tracing::warn!("{}: no frequency response: {e}", source.name),
            }
            sources.push(source);
        }
    }
    let base = base_of(args, &sources, &results)?;
    let told = results.iter().find(|(_, r)| !r.models.is_empty());
    let model = match (&base, told) {
        (Some(base), _) => Some(base.model()?),
        (None, Some((_, r))) => Some(model_of_response(r, mean_input(&sources))?),
        (None, None) => None,
    };
    if let Some(path) = &args.out {
        match &model {
            Some(model) => crate::output::write(path, &model.to_toml_string())?,
            None => eprintln!(
                "WARNING: {}: not written, there is no model",
                path.display()
            ),
        }
    }
    if let Some(path) = &args.report {
        report(&results, base.as_ref())
            .write_with_figures(path)
            .map_err(Failure::failed)?;
    }
    if args.json {
        let files: Vec<Value> = results.iter().map(|(p, r)| to_json(p, r)).collect();
        print_json(&json!({ "files": files, "base": base.as_ref().map(Base::to_json) }))?;
    } else {
        let mut text: String = (results.iter())
            .map(|(p, r)| to_text(p, r, base.is_none()))
            .collect();
        text += &base.as_ref().map(Base::words).unwrap_or_default();
        print_text(&text)?;
    }
    // A record that says nothing of the plant is no success, nor is a model asked for and not there.
    let silent = results
        .iter()
        .any(|(_, r)| matches!(r.basis, Basis::Nothing { .. }));
    Ok(if silent || (args.out.is_some() && model.is_none()) {
        Outcome::Broken
    } else {
        Outcome::Done
    })
}

/// The model of other rigs' records, fitted in time to every record. None for records of this rig, of a loop, or of too few rows
/// where no form was asked for.
fn base_of(
    args: &Args,
    sources: &[Source],
    results: &[(PathBuf, ForeignResult)],
) -> Result<Option<Base>, Failure> {
    let of_loop = results.iter().any(|(_, r)| r.basis != Basis::Input);
    if args.input.is_none() || (of_loop && args.base.is_none()) {
        return Ok(None);
    }
    if of_loop {
        tracing::warn!(
            "a record looks like that of a loop: its noise is in its input too, and the base model may be the controller's inverse"
        );
    }
    // One or two frequencies tell gain and lag there; more of a model than that must be asked for.
    let sparse = results.iter().all(|(_, r)| r.points.len() < 3) && !results.is_empty();
    if sparse && args.base.is_none() {
        return Ok(None);
    }
    let rate_hz = base::common_rate(sources.iter().map(|s| s.rate_hz))?;
    let records: Vec<_> = (sources.iter())
        .map(|s| cellpos_ident::base::Series {
            input: s.input.clone(),
            output: s.output.clone(),
        })
        .collect();
    let hold = args.hold.into();
    let found = base::fit(
        &records,
        rate_hz,
        hold,
        args.base.and_then(Asked::form),
        usize::from(args.order),
    );
    let spectral = results.iter().any(|(_, r)| !r.models.is_empty());
    match found {
        // Brownian motion on an integrator is no error of the free run: the response, fitted on increments, knows more.
        Ok(base) if base.fit.wanders && responds(results) && args.base.is_none() => Ok(None),
        Ok(base) => Ok(Some(base)),
        Err(error) if args.base.is_some() || !spectral => Err(error),
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

fn judge(source: &Source, args: &Args) -> Result<ForeignResult, cellpos_ident::IdentError> {
    let settings = ForeignSettings {
        rate_hz: source.rate_hz,
        most_order: usize::from(args.order),
        hold: args.hold.into(),
    };
    let (input, output) = (&source.input, &source.output);
    let found = feedback(input, output);
    // A record of another rig was perhaps taken with a noisy input: only a loop makes half of its change answer the output.
    let least = if args.input.is_some() { 0.5 } else { 0.0 };
    let closed =
        source.closed || found.is_some_and(|found| found.is_there() && found.share > least);
    match &source.reference {
        Some(reference) if closed => identify_in_loop(reference, input, output, &settings),
        None if closed => Ok(nothing_to_tell(
            output,
            &settings,
            found.map(|found| found.share),
        )),
        _ => identify(input, &bridged(output), &settings),
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
            .all(|(value, sd)| sd.is_finite() && (1.96 * sd <= value.abs() || *sd == 0.0))
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

/// The best model of a frequency response (those that grow are left out before).
fn model_of_response(result: &ForeignResult, at_rest: f64) -> Result<Model, Failure> {
    let Some(best) = result.models.first() else {
        return Err(Failure::bad_input(
            "no model: every one that fits is unstable",
            "try another --order or --hold, or a record that excites more",
        ));
    };
    let mut model = base::model_of(best, result.sampling.hold, at_rest)?;
    (model.provenance).insert("verdict".to_owned(), model_verdict(best).to_owned());
    Ok(model)
}

fn to_json(path: &Path, r: &ForeignResult) -> Value {
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
                "delay_ms": m.delay_s * 1e3, "delay_sd_ms": if m.delay_sd_s.is_finite() { json!(m.delay_sd_s * 1e3) } else { Value::Null },
                "verdict": model_verdict(m), "delay_ci95_ms": if m.delay_sd_s.is_finite() { json!([(m.delay_s - 1.96 * m.delay_sd_s) * 1e3, (m.delay_s + 1.96 * m.delay_sd_s) * 1e3]) } else { Value::Null },
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

fn to_text(path: &Path, r: &ForeignResult, with_model: bool) -> String {
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
        let _ = writeln!(
            out,
            "  linear model of order {}: num {}, den {}, delay {} ms: {}",
            m.order,
            coefficients(&m.numerator, &m.numerator_sd),
            coefficients(&m.denominator, &m.denominator_sd),
            with_interval(m.delay_s * 1e3, 1.96e3 * m.delay_sd_s),
            model_verdict(m)
        );
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

fn report(results: &[(PathBuf, ForeignResult)], base: Option<&Base>) -> Report {
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
                    "Linear model of order {}: num {}, den {}, delay {} ms (95 % intervals): {}.",
                    m.order,
                    coefficients(&m.numerator, &m.numerator_sd),
                    coefficients(&m.denominator, &m.denominator_sd),
                    with_interval(m.delay_s * 1e3, 1.96e3 * m.delay_sd_s),
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
    let figure = Figure::new(
        &format!("bode-{}", index + 1),
        "Response in the record and the chosen linear model with delay.",
    )
    .share_x();
    let mut panels = [
        Panel::new(Axis::log("frequency", "Hz"), Axis::linear("gain", "dB"))
            .series(Series::points("record", &f, &gain)),
        Panel::new(Axis::log("frequency", "Hz"), Axis::linear("phase", "deg"))
            .series(Series::points("record", &f, &phase)),
    ];
    if let Some(m) = r.models.first() {
        let curve: Vec<_> = grid
            .iter()
            .map(|&f| m.sampled_response(f, r.sampling))
            .collect();
        let g: Vec<f64> = curve.iter().map(|c| 20.0 * c.norm().log10()).collect();
        let p: Vec<f64> = curve.iter().map(|c| c.arg().to_degrees()).collect();
        panels[0] = panels[0].clone().series(Series::line("model", &grid, &g));
        panels[1] = panels[1].clone().series(Series::line("model", &grid, &p));
    }
    let [upper, lower] = panels;
    figure.panel(upper).panel(lower)
}
