//! `cellpos rig partner`: gain, lag and delay of the slow actuator, measured while the bead is held.

use crate::arguments::positive;
use crate::outcome::{CommandResult, Outcome, print_json, print_text};
use crate::rig_file::{ClockKind, Frames, RigFile};
use cellpos_numeric::units::{Micrometers, Seconds};
use cellpos_plant::Model;
use cellpos_workbench::experiment::on_rig::OnRig;
use cellpos_workbench::experiment::partner::{Measured, Moves, measure};
use cellpos_workbench::partner::write_partner;
use serde::Serialize;
use std::path::PathBuf;

/// Arguments of `cellpos rig partner`.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "The PZT holds the bead while the slow actuator makes a square wave about its present position.\n\n\
    Examples:\n  cellpos rig partner rig.toml\n  cellpos rig partner rig.toml --amplitude 0.5um --duration 60s --write\n\n\
    Exit code 0: measured; 1: the run failed, or the effect of the actuator is below the noise; 2: bad input."
)]
pub(super) struct Args {
    /// The rig file, with a table [partner].
    rig: PathBuf,
    /// Model of the plant: a model.toml, or eq6.
    #[arg(long, default_value = "eq6")]
    model: String,
    /// Amplitude of the square wave (half of peak to peak), on the actuator's own scale.
    #[arg(long, default_value = "0.2um", value_parser = positive::<Micrometers>)]
    amplitude: Micrometers,
    /// Half of the period of the square wave.
    #[arg(long, default_value = "0.5s", value_parser = positive::<Seconds>)]
    half_period: Seconds,
    /// Duration of the measurement.
    #[arg(long, default_value = "30s", value_parser = positive::<Seconds>)]
    duration: Seconds,
    /// Write the result into the rig file.
    #[arg(long)]
    write: bool,
    /// Seed of the emulated rig; default: that of rig.toml.
    #[arg(long)]
    seed: Option<u64>,
    /// Clock of the emulated rig [default: virtual].
    #[arg(long, value_enum)]
    clock: Option<ClockKind>,
    /// Render frames of the emulated rig.
    #[arg(long, value_enum, default_value = "on")]
    frames: Frames,
    /// Run without real-time priority.
    #[arg(long)]
    best_effort: bool,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

/// What `--json` prints.
#[derive(Debug, Serialize)]
struct Found<'a> {
    rig: &'a PathBuf,
    #[serde(flatten)]
    measured: Measured,
    written: bool,
}

/// Measures the slow actuator of a rig.
pub(super) fn run(args: &Args) -> CommandResult {
    let mut file = RigFile::load(Some(&args.rig))?;
    file.emulate_as(args.seed, None)?;
    let model = Model::load(&args.model).map_err(crate::outcome::Failure::input)?;
    let on = OnRig::new(file, model, args.clock, args.frames, args.best_effort)?;
    let moves = Moves {
        amplitude_um: args.amplitude.value(),
        half_period_s: args.half_period.value(),
        duration_s: args.duration.value(),
    };
    let measured = measure(&on, moves)?;
    if args.write {
        write_partner(&args.rig, &keys(&measured))?;
    }
    if args.json {
        print_json(&Found {
            rig: &args.rig,
            measured,
            written: args.write,
        })?;
    } else {
        print_text(&text(&measured, args))?;
    }
    Ok(Outcome::Done)
}

/// The keys of the rig file, to what the intervals allow.
fn keys(m: &Measured) -> [(&'static str, f64); 4] {
    let rounded = |value: f64, step: f64| (value / step).round() * step;
    let short = |value: f64| format!("{value:.6}").parse().unwrap_or(value);
    [
        ("gain", short(m.gain)),
        ("gain_ci95", short(m.gain_ci95)),
        ("lag_ms", short(rounded(m.lag_ms, 0.01))),
        ("delay_ms", short(rounded(m.delay_ms, 0.01))),
    ]
}

fn text(m: &Measured, args: &Args) -> String {
    let mut text = format!(
        "gain   {:.4} +- {:.4} um of PZT per um of the slow actuator\nlag    {:.1} +- {:.1} ms\ndelay  {:.1} +- {:.1} ms\n",
        m.gain, m.gain_ci95, m.lag_ms, m.lag_ci95_ms, m.delay_ms, m.delay_ci95_ms
    );
    if args.write {
        text += &format!("written into {}\n", args.rig.display());
    } else {
        text += "[partner] of the rig file (--write puts them there):\n";
        for (key, value) in keys(m) {
            text += &format!("{key} = {value}\n");
        }
    }
    text
}
