//! `cellpos doctor`: is this machine, with these devices, fit for 1 kHz.

mod findings;
mod soak;
mod suspect;
mod traced;

use crate::arguments::{positive, span};
use crate::outcome::{CommandResult, Failure, Outcome, print_json, print_text};
use cellpos_runtime::realtime::{Request, allowed_cpus};
use cellpos_session::signals;
use cellpos_units::Seconds;
use findings::{Finding, Machine, Weight};
use serde::Serialize;
use soak::Soak;
use std::path::{Path, PathBuf};

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

/// The examination.
#[derive(Debug, Serialize)]
struct Report {
    fit: bool,
    verdict: String,
    #[serde(flatten)]
    soak: Soak,
    findings: Vec<Finding>,
}

/// Shortest measurement that is called fit, s: a stall that comes once a second must have had its chance.
const SHORTEST_S: f64 = 2.0;

/// Asks for everything that the control thread asks for, measures the timer, looks at the machine, gives a verdict.
pub(crate) fn run(args: Args) -> CommandResult {
    let request = Request::control_thread();
    let cpus = allowed_cpus().len();
    let machine = Machine {
        root: Path::new("/"),
        cpu: request.cpu.unwrap_or(0),
        cpus,
    };
    let mut findings = machine.findings();
    findings.extend(machine.serial_ports());
    findings.extend(findings::disk(&args.runs, args.run.value()));
    let stop = signals::ends_measuring();
    let soak =
        soak::soak(request, span(args.duration), args.why, &stop).map_err(Failure::failed)?;
    let (fit, verdict) = verdict(&soak, &findings);
    let report = Report {
        fit,
        verdict,
        soak,
        findings,
    };
    if args.json {
        print_json(&report)?;
    } else {
        print_text(&text(&report))?;
    }
    Ok(if fit { Outcome::Done } else { Outcome::Broken })
}

/// Whether this machine is fit by a measurement of so long, in words, and the wake-up latency that 99.9 % are below, us.
pub(super) fn verdict_after(duration: std::time::Duration) -> Result<(bool, String, f64), Failure> {
    let request = Request::control_thread();
    let machine = Machine {
        root: Path::new("/"),
        cpu: request.cpu.unwrap_or(0),
        cpus: allowed_cpus().len(),
    };
    let findings = machine.findings();
    let stop = signals::ends_measuring();
    let soak = soak::soak(request, duration, false, &stop).map_err(Failure::failed)?;
    let (fit, words) = verdict(&soak, &findings);
    Ok((fit, words, soak.wake_us.p999))
}

fn verdict(soak: &Soak, findings: &[Finding]) -> (bool, String) {
    let bad: Vec<&str> = findings
        .iter()
        .filter(|finding| finding.weight == Weight::Bad)
        .map(|finding| finding.what)
        .collect();
    let quiet = soak.wake_us.p999 < 200.0 && soak.missed * 1000 <= soak.wakeups;
    if !quiet {
        return (
            false,
            format!(
                "not fit for a 1 kHz loop: p99.9 of the wake-up latency is {:.0} us (200 us allowed), {} of {} wake-ups came a \
                 whole period late",
                soak.wake_us.p999, soak.missed, soak.wakeups
            ),
        );
    }
    if soak.seconds < SHORTEST_S {
        return (
            false,
            format!(
                "timing was good, but {:.1} s are too short for a verdict: measure for {SHORTEST_S} s or more, and overnight before a night's run (--for 10h)",
                soak.seconds
            ),
        );
    }
    if !soak.conditions.degraded.is_empty() {
        return (
            false,
            "timing is good now, but rights for real time are missing: a busy machine will stall the loop".to_string(),
        );
    }
    if !bad.is_empty() {
        return (
            false,
            format!(
                "timing is good now, but not to be relied on: {}",
                bad.join(", ")
            ),
        );
    }
    (
        true,
        format!(
            "fit for a 1 kHz loop, as far as {} can tell",
            if soak.seconds < 120.0 {
                format!("{:.0} s", soak.seconds)
            } else {
                format!("{:.0} min", soak.seconds / 60.0)
            }
        ),
    )
}

fn text(report: &Report) -> String {
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
        soak::LATE_NS / 1000,
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

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_runtime::latency::Quantiles;
    use cellpos_runtime::realtime::Conditions;

    fn quiet(seconds: f64) -> Soak {
        Soak {
            conditions: Conditions::default(),
            seconds,
            wakeups: (seconds * 1e3) as u64,
            wake_us: Quantiles {
                p999: 50.0,
                ..Quantiles::default()
            },
            late: 0,
            missed: 0,
            suspects: Vec::new(),
            why: None,
        }
    }

    #[test]
    fn nothing_is_called_fit_on_a_tenth_of_a_second_or_beside_a_bad_finding() {
        assert!(!verdict(&quiet(0.1), &[]).0);
        assert!(verdict(&quiet(10.0), &[]).0);
        let bad = Finding {
            what: "virtual machine",
            found: String::new(),
            weight: Weight::Bad,
            change: None,
        };
        let (fit, said) = verdict(&quiet(10.0), &[bad]);
        assert!(!fit && said.contains("virtual machine"), "{said}");
        let mut late = quiet(36_000.0);
        late.missed = 1_000_000;
        assert!(!verdict(&late, &[]).0);
    }
}
