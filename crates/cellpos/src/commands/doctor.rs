//! `cellpos doctor`: is this machine, with these devices, fit for 1 kHz.

use crate::outcome::{CommandResult, Outcome, print_json, print_text};
use cellpos_runtime::realtime::{self, Request};
use cellpos_units::Seconds;
use std::time::Duration;

/// Arguments of `cellpos doctor`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  cellpos doctor --duration 5s")]
pub struct Args {
    /// How long to measure the timer latency.
    #[arg(long, default_value = "2s")]
    duration: Seconds,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

/// Asks for everything that the control thread asks for, measures the timer, gives a verdict.
pub fn run(args: Args) -> CommandResult {
    let report = realtime::examine(
        &Request::control_thread(),
        Duration::from_secs_f64(args.duration.value().clamp(0.1, 3600.0)),
    );
    if args.json {
        print_json(&report)?;
    } else {
        print_text(&report.to_string())?;
    }
    Ok(if report.fit {
        Outcome::Done
    } else {
        Outcome::Broken
    })
}
