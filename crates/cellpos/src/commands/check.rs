//! `cellpos check`: a setpoint script against a model and the rig's limits, before anything moves.

use super::run::possible;
use crate::outcome::{CommandResult, Failure, Outcome, print_json, print_text};
use crate::output;
use cellpos_numeric::units::{Micrometers, MicrometersPerSecond};
use cellpos_report::{Axis, Column, Emphasis, Figure, Panel, Report, Series, Table};
use cellpos_script::{Check, CheckLimits, Plan, Script};
use cellpos_session::rig_file::{ClockKind, Frames, RigFile};
use cellpos_session::setup::{self, Prepared};
use cellpos_session::{Options, Rig, connect};
use std::path::PathBuf;

/// Arguments of `cellpos check`.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Example:\n  cellpos check examples/scripts/fatigue.toml --model eq6 --report fatigue.html\n\n\
                  Exit code 0: the script can run; 1: the rig cannot do it; 2: the script has an error.\n\
                  `cellpos run` and `run --dry` refuse what this check refuses, in the same words."
)]
pub(crate) struct Args {
    /// The script.
    script: PathBuf,
    /// `eq6`, or a model file.
    #[arg(long, default_value = "eq6")]
    model: String,
    /// Controller with limits of its own, as for `cellpos run`.
    #[arg(long, default_value = setup::DEFAULT_LAW)]
    controller: String,
    /// Rig file with the limits; default: the emulated rig. A camera that only the rig knows is taken to see -50um to 50um.
    #[arg(long)]
    rig: Option<PathBuf>,
    /// Smallest PZT displacement, instead of the rig's.
    #[arg(long, allow_hyphen_values = true)]
    low: Option<Micrometers>,
    /// Largest PZT displacement, instead of the rig's.
    #[arg(long)]
    high: Option<Micrometers>,
    /// Zero-flow displacement, instead of the rig's.
    #[arg(long, allow_hyphen_values = true)]
    neutral: Option<Micrometers>,
    /// Largest speed of the PZT, instead of the rig's.
    #[arg(long)]
    slew: Option<MicrometersPerSecond>,
    /// Field of view along the channel: positions from minus this to plus this are in view.
    #[arg(long = "field", alias = "view")]
    view: Option<Micrometers>,
    /// Write reference and PZT demand as a report.
    #[arg(long)]
    report: Option<PathBuf>,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

/// Checks, prints, and gives 1 if the rig cannot do it.
pub(crate) fn run(args: Args) -> CommandResult {
    output::ready(&args.report)?;
    let script = Script::read(&args.script).map_err(Failure::input)?;
    let plan = Plan::new(&script).map_err(Failure::input)?;
    let (rig, prepared, knows_view) = rehearsed(&args)?;
    let limits = replaced(possible::limits(&prepared, &rig), &args);
    let result = possible::checked(&script, &plan, &prepared, &limits, rig.file())?;
    if let Some(path) = &args.report {
        report(&script, &result, &limits, &args)
            .write_with_figures(path)
            .map_err(Failure::failed)?;
    }
    if args.json {
        print_json(&json(&script, &result))?;
    } else {
        print_text(&text(&script, &result))?;
        if !knows_view {
            print_text(&format!(
                "field of view: assumed from -{0} to {0} um; give yours with --field (`cellpos run` asks the camera)\n",
                limits.view_um
            ))?;
        }
    }
    Ok(if result.violations.is_empty() {
        Outcome::Done
    } else {
        Outcome::Broken
    })
}

/// The rehearsed rig of `cellpos run --dry`: it has the limits of the rig, with a controller fitted to it.
/// The last value: whether the field of view is known without asking the camera.
fn rehearsed(args: &Args) -> Result<(Rig, Prepared, bool), Failure> {
    let mut file = RigFile::load(args.rig.as_deref())?;
    let knows_view = args.view.is_some() || possible::knows_field(&file);
    possible::rehearse(&mut file, &args.model);
    let mut prepared = connect::prepare(&args.model, &args.controller, &file)?;
    let options = Options {
        clock: ClockKind::Virtual,
        frames: Frames::Off,
        best_effort: true,
    };
    let rig = Rig::open(file, options)?;
    rig.fit(&mut prepared);
    Ok((rig, prepared, knows_view))
}

/// Limits with the options that replace them.
fn replaced(mut limits: CheckLimits, args: &Args) -> CheckLimits {
    let instead = |value: &mut f64, said: Option<f64>| {
        if let Some(said) = said {
            *value = said;
        }
    };
    instead(&mut limits.low_um, args.low.map(Micrometers::value));
    instead(&mut limits.high_um, args.high.map(Micrometers::value));
    instead(&mut limits.neutral_um, args.neutral.map(Micrometers::value));
    let slew = args.slew.map(MicrometersPerSecond::value);
    instead(&mut limits.slew_um_per_s, slew);
    instead(&mut limits.view_um, args.view.map(Micrometers::value));
    limits
}

/// Figures of a check as names and values.
fn figures(check: &Check) -> Vec<(&'static str, String)> {
    // Rounded first, so that a rounding error below zero does not read as -0.000.
    let shown = |value: f64| (value * 1e3).round() / 1e3 + 0.0;
    let range = |(low, high): (f64, f64)| format!("{:.3} .. {:.3}", shown(low), shown(high));
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

/// What came out, in a sentence.
fn sentence(check: &Check, limits: &CheckLimits) -> (Emphasis, String) {
    let broken = match check.violations.len() {
        0 => {
            let room = check.tightest().map_or_else(
                || " Nothing moves in it.".to_owned(),
                |tightest| {
                    format!(
                        " The tightest limit is the {}, of which it uses {:.0} %: all positions could be {} times as large.",
                        in_words(tightest.what, limits),
                        1e2 * tightest.share,
                        short(check.largest_factor)
                    )
                },
            );
            let cycles = match check.cycles {
                0 => String::new(),
                1 => " in one cycle".to_owned(),
                many => format!(" in {many} cycles"),
            };
            return (
                Emphasis::Good,
                format!(
                    "The script can run within the limits of this rig. It lasts {:.1} s{cycles}, without the time that \
                     it waits for events.{room}",
                    check.duration_s
                ),
            );
        }
        1 => "one limit of this rig".to_owned(),
        many => format!("limits of this rig in {many} places"),
    };
    let factor = short(check.largest_factor);
    let text = format!(
        "The script cannot run: it breaks {broken}. It could with all positions multiplied by {factor} or less."
    );
    (Emphasis::Bad, text)
}

/// To two digits, so as not to promise more than is free.
fn short(factor: f64) -> String {
    let digits = (1.0 - factor.log10().floor()).clamp(0.0, 4.0) as i32;
    let unit = 10f64.powi(digits);
    // 3.2 as a product of floats is just below it.
    format!(
        "{:.*}",
        digits as usize,
        (factor * unit * (1.0 + 1e-9)).floor() / unit
    )
}

/// A limit with its value.
fn in_words(what: &str, limits: &CheckLimits) -> String {
    match what {
        "PZT range" => format!(
            "range of the piezo (PZT), {} to {} um",
            limits.low_um, limits.high_um
        ),
        "PZT slew" => format!("speed of the piezo (PZT), {} um/s", limits.slew_um_per_s),
        _ => format!("field of view, {} um to each side", limits.view_um),
    }
}

/// Reference, PZT displacement that it takes, and how much of each limit is used.
fn figure(check: &Check) -> Figure {
    let cut = match check.cycles_shown < check.cycles {
        true => format!(
            "{} of {} cycles are drawn, without the others and with long holds cut short: the time axis is that of what is drawn",
            check.cycles_shown, check.cycles
        ),
        false => "Waits take no time here".to_owned(),
    };
    let time = || match check.cycles_shown < check.cycles {
        true => Axis::linear(
            &format!("time, {} of {} cycles", check.cycles_shown, check.cycles),
            "s",
        ),
        false => Axis::linear("time", "s"),
    };
    let names: Vec<&str> = check.used.iter().map(|one| one.what).collect();
    let at: Vec<f64> = (0..names.len()).map(|n| n as f64).collect();
    let used: Vec<f64> = check.used.iter().map(|one| 1e2 * one.share).collect();
    Figure::new(
        "reference",
        &format!(
            "Position that the script asks for, displacement of the piezo (PZT) that the model needs for it, and the largest share of each \
             limit, the reserve taken off. {cut}."
        ),
    )
    .panel(
        Panel::new(time(), Axis::linear("position of the bead", "um"))
            .height_px(170.0)
            .series(Series::line("", &check.time_s, &check.reference_um)),
    )
    .panel(
        Panel::new(Axis::categories("", &names), Axis::linear("used", "%"))
            .height_px(170.0)
            .series(Series::bars("", &at, &used, 0.6).color(1))
            .horizontal(100.0, "limit"),
    )
    .panel(
        Panel::new(time(), Axis::linear("PZT", "um"))
            .height_px(170.0)
            .series(Series::step("", &check.time_s, &check.demand_um).color(2)),
    )
    .columns(2)
}

fn report(script: &Script, check: &Check, limits: &CheckLimits, args: &Args) -> Report {
    let mut report = Report::new(&format!("Check of {}", script.file));
    let rig = match &args.rig {
        Some(path) => format!("of the rig {}", path.display()),
        None => "of a rig as in the paper, for want of a rig file".to_owned(),
    };
    report.lead(&format!(
        "Task: check the script {} before it runs: against the limits {rig}, and the model {} of how a bead follows the piezo. All figures \
         are calculated; nothing moved.",
        script.file, args.model
    ));
    let (status, sentence) = sentence(check, limits);
    report.result(status, &sentence);
    report.certainty(&format!(
        "calculated for a bead that follows the model exactly. {:.0} % of the piezo's range and speed are kept free for the loop's answer to \
         noise and drift, and for a gain other than the model's; the field of view has no such reserve.",
        1e2 * limits.reserve
    ));
    if !script.notes.is_empty() {
        report.paragraph(&script.notes);
    }
    for line in violations(script, check) {
        report.note(Emphasis::Bad, &line);
    }
    report.figure(figure(check));
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
    report.section("Script");
    report.verbatim(&script.text);
    report.command(&cellpos_session::provenance::command_text());
    report
}

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_plant::Model;
    use cellpos_script::{LimitUse, check};

    /// No factor is promised that would break the limit.
    #[test]
    fn a_factor_is_rounded_down() {
        assert_eq!(short(6.259), "6.2");
        assert_eq!(short(0.999), "0.99");
        assert_eq!(short(111.9), "111");
    }

    #[test]
    fn the_sentence_names_the_limit_that_binds() {
        let text = "[[step]]\ndo = \"move\"\nto = \"8um\"\nduration = \"200ms\"\n";
        let script = Script::parse(text, "s.toml").unwrap();
        let limits = CheckLimits::default();
        let mut found = check(&script, &Model::eq6(), &limits).unwrap();
        let (_, text) = sentence(&found, &limits);
        assert!(
            text.contains("field of view, 50 um to each side, of which it uses 16 %"),
            "{text}"
        );
        found.used.push(LimitUse {
            what: "PZT slew",
            share: 0.5,
        });
        let (_, text) = sentence(&found, &limits);
        assert!(
            text.contains("speed of the piezo (PZT), 10000 um/s, of which it uses 50 %"),
            "{text}"
        );
    }
}
