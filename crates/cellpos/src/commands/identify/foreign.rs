//! `cellpos identify --data`: anybody's records.

use super::columns;
use super::report::{log_grid, number};
use super::{Args, HoldKind};
use crate::outcome::{CommandResult, Failure, Outcome, print_json, print_text};
use cellpos_ident::foreign::{Excitation, ForeignResult, ForeignSettings, identify};
use cellpos_ident::sampled::Hold;
use cellpos_plant::{Model, Noise, TransferFunction};
use cellpos_report::{Axis, Column, Figure, Panel, Report, Series, Status, Table};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::Path;

const NO_LINEAR: &str = "harmonics remain in the output that the input does not hold: no linear model of any order explains them (hysteresis, saturation and other nonlinearities do); `cellpos reconcile` looks for what is missing";

/// Runs the command on records.
pub fn run(args: &Args) -> CommandResult {
    let (Some(input), Some(output), Some(rate)) = (&args.input, &args.output, args.rate) else {
        return Err(Failure::bad_input(
            "--data needs --input, --output and --rate",
            "for example --input pzt_um --output bead_um --rate 1kHz",
        ));
    };
    let settings = ForeignSettings {
        rate_hz: rate.0,
        most_order: usize::from(args.order),
        hold: match args.hold {
            HoldKind::ZeroOrder => Hold::ZeroOrder,
            HoldKind::None => Hold::None,
        },
    };
    let mut results = Vec::new();
    for path in &args.data {
        let (u, y) = columns::read(path, input, output).map_err(Failure::input)?;
        let result = identify(&u, &y, &settings).map_err(|e| {
            Failure::bad_input(
                format!("{}: {e}", path.display()),
                "check --input, --output and --rate",
            )
        })?;
        results.push((path.clone(), result));
    }
    if let (Some(path), Some((_, first))) = (&args.out, results.first()) {
        write_model(path, first)?;
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
    Ok(Outcome::Done)
}

fn write_model(path: &Path, result: &ForeignResult) -> Result<(), Failure> {
    let Some(best) = result.models.first() else {
        return Ok(());
    };
    let plant = TransferFunction::new(best.numerator.clone(), best.denominator.clone())
        .map_err(Failure::failed)?;
    let model = Model {
        name: "identified".to_owned(),
        description: format!("linear model of order {} from records", best.order),
        plant,
        working_point_um: 0.0,
        effects: Vec::new(),
        noise: Noise::NONE,
        covariance: None,
        intervals: BTreeMap::from([(
            "delay_ms".to_owned(),
            [
                (best.delay_s - 1.96 * best.delay_sd_s) * 1e3,
                (best.delay_s + 1.96 * best.delay_sd_s) * 1e3,
            ],
        )]),
        provenance: BTreeMap::from([
            ("command".to_owned(), super::command_line()),
            ("version".to_owned(), env!("CARGO_PKG_VERSION").to_owned()),
            ("delay_ms".to_owned(), format!("{:.4}", best.delay_s * 1e3)),
        ]),
    };
    std::fs::write(path, model.to_toml_string()).map_err(Failure::failed)
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
                "poles_rad_per_s": m.poles.iter().map(|p| [p.re, p.im]).collect::<Vec<_>>(), "chi2": m.chi2, "dof": m.dof,
            })
        })
        .collect();
    json!({
        "file": path.display().to_string(),
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
            "  linear model of order {}: num {:?}, den {:?}, delay {:.3} ms",
            m.order,
            m.numerator,
            m.denominator,
            m.delay_s * 1e3
        );
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
        if r.harmonics_remain() {
            report.note(Status::Warning, NO_LINEAR);
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
