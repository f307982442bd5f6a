//! `cellpos doctor`: is this machine, with these devices, fit for 1 kHz.

use crate::arguments::{positive, span};
use crate::outcome::{CommandResult, Failure, Outcome, print_json, print_text};
use cellpos_numeric::units::Seconds;
use cellpos_session::signals;
use cellpos_workbench::doctor::{self, Examination, LATE_NS, Weight};
use std::path::PathBuf;

/// Arguments of `cellpos doctor`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  cellpos doctor
  cellpos doctor --for 10h --why

Ctrl-C ends the measurement early.
Exit code 0: fit; 1: not fit, or not measured for long enough.")]
pub(crate) struct Args {
    /// Duration of the measurement.
    #[arg(long = "for", alias = "duration", value_name = "DURATION", default_value = "5s", value_parser = positive::<Seconds>)]
    duration: Seconds,
    /// Name the program that delayed a wake-up.
    #[arg(long)]
    why: bool,
    /// Check the room on the disk for a run of this length
    #[arg(long, default_value = "1h", value_parser = positive::<Seconds>)]
    run: Seconds,
    /// Folder of the runs.
    #[arg(long, default_value = "runs")]
    runs: PathBuf,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

/// Measures, prints and says whether the machine is fit.
pub(crate) fn run(args: Args) -> CommandResult {
    let runs = Some((args.runs.as_path(), args.run.value()));
    let stop = signals::ends_measuring();
    let examined =
        doctor::examine(span(args.duration), args.why, runs, &stop).map_err(Failure::failed)?;
    if args.json {
        print_json(&examined)?;
    } else {
        print_text(&text(&examined))?;
    }
    Ok(if examined.fit {
        Outcome::Done
    } else {
        Outcome::Broken
    })
}

fn text(report: &Examination) -> String {
    let soak = &report.soak;
    let q = &soak.wake_us;
    let mut out = format!("{}\n{}", report.verdict, soak.conditions);
    out.push_str(&format!(
        "  wake-up       p50 {:.1} us, p99 {:.1} us, p99.9 {:.1} us, max {:.1} us over {} wake-ups; {} later than {} us, {} \
         missed\n",
        q.p50,
        q.p99,
        q.p999,
        q.max,
        soak.wakeups,
        soak.late,
        LATE_NS / 1000,
        soak.missed
    ));
    for finding in &report.findings {
        let sign = match finding.weight {
            Weight::Good => "ok  ",
            Weight::Note => "note",
            Weight::Bad => "BAD ",
        };
        out.push_str(&format!("  {sign}  {}: {}\n", finding.what, finding.found));
        if let Some(change) = &finding.change {
            out.push_str(&format!("        change: {change}\n"));
        }
    }
    if let Some(how) = &soak.why {
        if soak.suspects.is_empty() {
            out.push_str(&format!(
                "  why           no wake-up was late, or nothing else ran; {how}\n"
            ));
        }
        for suspect in &soak.suspects {
            out.push_str(&format!(
                "  why           {}: {} times, {:.1} {} in all\n",
                suspect.name, suspect.times, suspect.amount, suspect.unit
            ));
        }
        if !soak.suspects.is_empty() {
            out.push_str(&format!("                {how}\n"));
        }
    }
    out
}
