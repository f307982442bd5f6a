//! `cellpos identify --data`: anybody's records.

use super::report::{log_grid, number};
use super::sources::{self, Source};
use super::{Args, HoldKind};
use crate::commands::report::with_interval;
use crate::outcome::{CommandResult, Failure, Outcome, print_json, print_text};
use cellpos_ident::feedback::feedback;
use cellpos_ident::foreign::{
    Basis, Excitation, ForeignResult, ForeignSettings, bridged, identify, identify_in_loop,
    nothing_to_tell,
};
use cellpos_ident::rational::RationalFit;
use cellpos_ident::sampled::Hold;
use cellpos_plant::{Model, Noise, TransferFunction, effects};
use cellpos_report::{Axis, Column, Emphasis, Figure, Panel, Report, Series, Table};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::{Path, PathBuf};

const NO_LINEAR: &str = "harmonics remain in the output that the input does not hold: no linear model of any order explains them (hysteresis, saturation and other nonlinearities do); `cellpos reconcile` looks for what is missing";

const IN_LOOP: &str = "a record of a closed loop: input and output were both taken by way of the reference, which the noise is not in";
const NOTHING: &str = "a record of a closed loop that nothing from outside moved: the position moves the actuator as much as the actuator the position, and what the record shows is the controller's inverse as well as the plant. No response and no model can be taken from it. A record with a moving reference (track --sine, a script), or cellpos identify, which excites the loop, can tell";

const NO_MODEL: &str = "no linear model: each that fits has a pole that grows, and the plant has none (Eq. (1)-(3) are passive)";

/// Why there is no model.
fn no_model(r: &ForeignResult) -> &'static str {
    if r.points.len() < 3 {
        "no linear model: one or two frequencies tell gain and lag there, and no more"
    } else {
        NO_MODEL
    }
}

/// Coefficients with their 95 % intervals.
fn coefficients(values: &[f64], sds: &[f64]) -> String {
    let terms: Vec<String> = values
        .iter()
        .zip(sds)
        .map(|(value, sd)| match *sd {
            0.0 => number(*value),
            sd => format!("{} +- {}", number(*value), number(1.96 * sd)),
        })
        .collect();
    format!("[{}]", terms.join(", "))
}

/// Runs the command on records.
pub fn run(args: &Args) -> CommandResult {
    if args.input.is_some() != args.rate.is_some() || args.input.is_some() != args.output.is_some()
    {
        return Err(Failure::bad_input(
            "--input, --output and --rate are given together, or not at all",
            "for example --input pzt_um --output bead_um --rate 1kHz",
        ));
    }
    let mut results = Vec::new();
    let mut means = Vec::new();
    for path in &args.data {
        for source in sources::read(path, args)? {
            let result = judge(&source, args).map_err(|e| {
                Failure::bad_input(
                    format!("{}: {e}", source.name),
                    "check --input, --output and --rate, or give a longer record",
                )
            })?;
            let input = &source.input;
            means.push(input.iter().sum::<f64>() / input.len().max(1) as f64);
            results.push((PathBuf::from(source.name), result));
        }
    }
    let told = results
        .iter()
        .zip(&means)
        .find(|((_, r), _)| !r.models.is_empty());
    if let Some(path) = &args.out {
        match told {
            Some(((_, first), mean)) => write_model(path, first, *mean)?,
            None => eprintln!(
                "WARNING: {}: not written, there is no model",
                path.display()
            ),
        }
    }
    if let Some(path) = &args.report {
        report(&results)
            .write_with_figures(path)
            .map_err(Failure::failed)?;
    }
    if args.json {
        let files: Vec<Value> = results.iter().map(|(p, r)| to_json(p, r)).collect();
        print_json(&json!({ "files": files }))?;
    } else {
        let text: String = results.iter().map(|(p, r)| to_text(p, r)).collect();
        print_text(&text)?;
    }
    // A record that says nothing of the plant is no success, nor is a model asked for and not there.
    let silent = results
        .iter()
        .any(|(_, r)| matches!(r.basis, Basis::Nothing { .. }));
    Ok(if silent || (args.out.is_some() && told.is_none()) {
        Outcome::Broken
    } else {
        Outcome::Done
    })
}

fn judge(source: &Source, args: &Args) -> Result<ForeignResult, cellpos_ident::IdentError> {
    let settings = ForeignSettings {
        rate_hz: source.rate_hz,
        most_order: usize::from(args.order),
        hold: match args.hold {
            HoldKind::ZeroOrder => Hold::ZeroOrder,
            HoldKind::None => Hold::None,
        },
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

/// Whether a model's numbers are told by the record: none has an interval wider than itself.
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

/// The best model (those that grow are left out before) as a model file: its delay is an effect, and how its input was sampled is said, so that what reads
/// it next takes both as they are.
fn write_model(path: &Path, result: &ForeignResult, at_rest: f64) -> Result<(), Failure> {
    let Some(best) = result.models.first() else {
        return Err(Failure::bad_input(
            format!(
                "no model for {}: every one that fits has a pole that grows",
                path.display()
            ),
            "try another --order or --hold, or a record that excites more",
        ));
    };
    let plant = TransferFunction::new(best.numerator.clone(), best.denominator.clone())
        .map_err(Failure::failed)?;
    let delay_s = best.delay_s.max(0.0);
    let mut intervals = BTreeMap::new();
    if best.delay_sd_s.is_finite() && delay_s > 0.0 {
        let wide_s = 1.96 * best.delay_sd_s;
        intervals.insert(
            "time-delay.delay_s".to_owned(),
            [best.delay_s - wide_s, best.delay_s + wide_s],
        );
    }
    let hold = match result.sampling.hold {
        Hold::ZeroOrder => "zero-order",
        Hold::None => "none",
    };
    let mut model = Model {
        name: "identified".to_owned(),
        description: format!("linear model of order {} from records", best.order),
        plant,
        working_point_um: at_rest,
        effects: Vec::new(),
        noise: Noise::NONE,
        // A delay that the record shows is not known to be the camera's.
        camera_delay_s: None,
        covariance: None,
        intervals,
        provenance: BTreeMap::from([
            ("command".to_owned(), super::command_line()),
            (
                "version".to_owned(),
                cellpos_session::provenance::VERSION_AND_COMMIT.to_owned(),
            ),
            ("hold".to_owned(), hold.to_owned()),
            ("verdict".to_owned(), model_verdict(best).to_owned()),
        ]),
    };
    if delay_s > 0.0 {
        let delay = effects::time_delay(delay_s);
        delay.validate().map_err(Failure::input)?;
        model = model.with_effect(delay);
    }
    crate::output::write(path, &model.to_toml_string())
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

fn to_text(path: &Path, r: &ForeignResult) -> String {
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
    if let Some(m) = r.models.first() {
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

fn report(results: &[(std::path::PathBuf, ForeignResult)]) -> Report {
    let mut report = Report::new("Identification of records");
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
