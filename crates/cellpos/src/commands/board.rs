//! `cellpos board`: identity, counters and LED of the PZT board, and quality of its line.

use crate::outcome::{CommandResult, Failure, Outcome, print_json, print_text};
use crate::rig_file::{ActuatorConfig, RigFile};
use cellpos_workbench::Bench;
use cellpos_workbench::line_test::{self, LineTest};
use std::path::PathBuf;

/// Arguments of `cellpos board`.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Nothing moves.\n\nExamples:\n  cellpos board --rig rig.toml\n  cellpos board --port /dev/ttyACM0 --led on"
)]
pub(crate) struct Args {
    /// Board of this rig.toml.
    #[arg(long, required_unless_present = "port", conflicts_with = "port")]
    rig: Option<PathBuf>,
    /// Board on this serial port.
    #[arg(long)]
    port: Option<String>,
    /// Pings to send, one a millisecond.
    #[arg(long, default_value_t = 1000, value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    pings: u32,
    /// Switch the LED in front of the camera.
    #[arg(long, value_name = "STATE")]
    led: Option<Led>,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Led {
    On,
    Off,
}

/// Asks the board and tests the line.
pub(crate) fn run(args: Args) -> CommandResult {
    let mut file = RigFile::load(args.rig.as_deref())?;
    if let Some(port) = args.port {
        file.actuator = ActuatorConfig::Serial {
            port,
            baud: 3_000_000,
            watchdog_ms: None,
            hold_watchdog_ms: None,
        };
    }
    let mut board = Bench::of(file)?.board()?;
    if let Some(led) = args.led {
        board.led(led == Led::On).map_err(Failure::failed)?;
    }
    let test = line_test::run(&mut board, args.pings)?;
    if args.json {
        print_json(&test)?;
    } else {
        print_text(&text(&test))?;
    }
    // One in a hundred lost is no line for a loop.
    let good = test.lost * 100 < test.sent;
    Ok(if good { Outcome::Done } else { Outcome::Broken })
}

fn text(test: &LineTest) -> String {
    let (info, trip, jitter) = (&test.info, &test.round_trip_ms, &test.jitter_ms);
    format!(
        "{}\nrange       {} to {} um, steps of {:.2} nm, {} um/s\nwatchdogs   {} ms without a command: holds; {} ms more: parks\n\
         now         {}, at {:.3} um\nround trip  median {:.3} ms, p99 {:.3} ms, largest {:.3} ms; {} of {} lost\n\
         jitter      median {:.3} ms, p99 {:.3} ms, largest {:.3} ms (spacing of pings by the board's own clock)\n\
         counters    {} bad frames, {} commands ignored, {} late, {} clipped, {} messages unsent; {} bad frames here\n",
        info.name,
        info.low_um,
        info.high_um,
        info.step_um * 1e3,
        info.slew_um_per_s,
        info.watchdog_ms,
        info.hold_watchdog_ms,
        test.state,
        test.applied_um,
        trip.p50,
        trip.p99,
        trip.max,
        test.lost,
        test.sent,
        jitter.p50,
        jitter.p99,
        jitter.max,
        test.bad_frames,
        test.ignored,
        test.late,
        test.clipped,
        test.unsent,
        test.bad_frames_here
    )
}
