//! `cellpos check`: a setpoint script against a model and the rig's limits, before anything moves.

use crate::outcome::{CommandResult, Failure, Outcome, print_json, print_text};
use cellpos_plant::Model;
use cellpos_report::{Axis, Column, Figure, Panel, Report, Series, Status, Table};
use cellpos_script::{Check, CheckLimits, Script, check};
use cellpos_units::{Micrometers, MicrometersPerSecond};
use std::path::PathBuf;

/// Arguments of `cellpos check`.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Example:\n  cellpos check examples/scripts/fatigue.toml --model eq6 --report fatigue.html\n\n\
                  Exit code 0: the script can run; 1: the rig cannot do it; 2: the script has an error."
)]
pub struct Args {
    /// The script.
    script: PathBuf,
    /// `eq6`, or a model file.
    #[arg(long, default_value = "eq6")]
    model: String,
    /// Smallest PZT displacement.
    #[arg(long, default_value = "0um", allow_hyphen_values = true)]
    low: Micrometers,
    /// Largest PZT displacement.
    #[arg(long, default_value = "40um")]
    high: Micrometers,
    /// PZT displacement at which the bead rests.
    #[arg(long, default_value = "20um", allow_hyphen_values = true)]
    neutral: Micrometers,
    /// Largest speed of the PZT.
    #[arg(long, default_value = "10000um/s")]
    slew: MicrometersPerSecond,
    /// Half of the field of view along the channel.
    #[arg(long, default_value = "50um")]
    view: Micrometers,
    /// Writes the reference and the PZT demand as a report (HTML, figures beside it).
    #[arg(long)]
    report: Option<PathBuf>,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

/// Checks, prints, and gives 1 if the rig cannot do it.
pub fn run(args: Args) -> CommandResult {
    let script = Script::read(&args.script).map_err(Failure::input)?;
    let model = Model::load(&args.model).map_err(Failure::input)?;
    let limits = CheckLimits {
        low_um: args.low.value(),
        high_um: args.high.value(),
        neutral_um: args.neutral.value(),
        slew_um_per_s: args.slew.value(),
        view_um: args.view.value(),
        ..CheckLimits::default()
    };
    let result = check(&script, &model, &limits).map_err(Failure::input)?;
    if let Some(path) = &args.report {
        report(&script, &result, &limits)
            .write_with_figures(path)
            .map_err(Failure::failed)?;
    }
    if args.json {
        print_json(&json(&script, &result))?;
    } else {
        print_text(&text(&script, &result))?;
    }
    Ok(if result.violations.is_empty() {
        Outcome::Done
    } else {
        Outcome::Broken
    })
}

/// Figures of a check as names and values.
fn figures(check: &Check) -> Vec<(&'static str, String)> {
    let range = |(low, high): (f64, f64)| format!("{low:.3} .. {high:.3}");
    vec![
        (
            "duration without waits (s)",
            format!("{:.3}", check.duration_s),
        ),
        ("cycles", check.cycles.to_string()),
        ("position (um)", range(check.position_um)),
        (
            "bead speed, highest (um/s)",
            format!("{:.1}", check.speed_um_per_s),
        ),
        ("PZT displacement (um)", range(check.pzt_um)),
        (
            "PZT speed, highest (um/s)",
            format!("{:.1}", check.pzt_speed_um_per_s),
        ),
        ("largest factor on all positions", factor(check)),
    ]
}

fn factor(check: &Check) -> String {
    if check.largest_factor.is_finite() {
        format!("{:.3}", check.largest_factor)
    } else {
        "any: nothing moves".to_owned()
    }
}

fn violations(script: &Script, check: &Check) -> Vec<String> {
    check
        .violations
        .iter()
        .map(|v| {
            format!(
                "{}:{}: {}: {:.3} {unit} asked for, {:.3} {unit} allowed; scale all positions by {} or less",
                script.file,
                v.line,
                v.what,
                v.asked,
                v.allowed,
                factor(check),
                unit = v.unit,
            )
        })
        .collect()
}

fn text(script: &Script, check: &Check) -> String {
    let mut out = String::new();
    for (name, value) in figures(check) {
        out.push_str(&format!("{name:34} {value}\n"));
    }
    for wave in &check.waves {
        out.push_str(&format!(
            "line {}: {} of {} um at {} Hz: the rig could do {:.3} um\n",
            wave.line,
            wave.shape.name(),
            wave.amplitude_um,
            wave.frequency_hz,
            wave.largest_um.max(0.0)
        ));
    }
    for line in violations(script, check) {
        out.push_str(&line);
        out.push('\n');
    }
    if check.violations.is_empty() {
        out.push_str("the script can run\n");
    }
    out
}

fn json(script: &Script, check: &Check) -> serde_json::Value {
    serde_json::json!({
        "script": script.file,
        "ok": check.violations.is_empty(),
        "duration_s": check.duration_s,
        "cycles": check.cycles,
        "position_um": [check.position_um.0, check.position_um.1],
        "speed_um_per_s": check.speed_um_per_s,
        "pzt_um": [check.pzt_um.0, check.pzt_um.1],
        "pzt_speed_um_per_s": check.pzt_speed_um_per_s,
        "largest_factor": check.largest_factor.is_finite().then_some(check.largest_factor),
        "waves": check.waves.iter().map(|wave| serde_json::json!({
            "line": wave.line,
            "shape": wave.shape.name(),
            "frequency_hz": wave.frequency_hz,
            "amplitude_um": wave.amplitude_um,
            "largest_um": wave.largest_um,
        })).collect::<Vec<_>>(),
        "violations": check.violations.iter().map(|v| serde_json::json!({
            "what": v.what,
            "line": v.line,
            "time_s": v.time_s,
            "asked": v.asked,
            "allowed": v.allowed,
            "unit": v.unit,
        })).collect::<Vec<_>>(),
    })
}

fn report(script: &Script, check: &Check, limits: &CheckLimits) -> Report {
    let mut report = Report::new(&format!("Script {}", script.name));
    if !script.notes.is_empty() {
        report.paragraph(&script.notes);
    }
    if check.violations.is_empty() {
        report.note(Status::Good, "The script can run.");
    }
    for line in violations(script, check) {
        report.note(Status::Bad, &line);
    }
    let mut table = Table::new([Column::left("figure"), Column::right("value")]);
    for (name, value) in figures(check) {
        table.row([name, value.as_str()]);
    }
    report.table(table);
    if !check.waves.is_empty() {
        let mut table = Table::new([
            Column::right("line"),
            Column::left("wave"),
            Column::right("frequency (Hz)"),
            Column::right("amplitude (um)"),
            Column::right("the rig could do (um)"),
        ]);
        for wave in &check.waves {
            table.row([
                &wave.line.to_string(),
                wave.shape.name(),
                &wave.frequency_hz.to_string(),
                &wave.amplitude_um.to_string(),
                &format!("{:.3}", wave.largest_um.max(0.0)),
            ]);
        }
        report.table(table);
    }
    let time = || Axis::linear("time", "s");
    report.figure(
        Figure::new(
            "reference",
            "Reference and PZT demand; long repeats and waves are shortened, waits take no time.",
        )
        .panel(
            Panel::new(time(), Axis::linear("bead", "um")).series(Series::line(
                "reference",
                &check.time_s,
                &check.reference_um,
            )),
        )
        .panel(
            Panel::new(time(), Axis::linear("PZT", "um"))
                .series(Series::step("demand", &check.time_s, &check.demand_um).color(2))
                .horizontal(limits.low_um, "lower limit")
                .horizontal(limits.high_um, "upper limit"),
        )
        .share_x(),
    );
    report.section("Script");
    report.verbatim(&script.text);
    report
}
