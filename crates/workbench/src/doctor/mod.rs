//! Decides whether this machine is fit for a 1 kHz loop: measures the timer, examines the machine, gives a verdict.

mod findings;
mod soak;
mod suspect;
mod traced;

pub use findings::{Finding, Weight};
pub use soak::{LATE_NS, Soak};
pub use suspect::Suspect;

use cellpos_runtime::realtime::{Request, allowed_cpus};
use findings::Machine;
use serde::Serialize;
use std::path::Path;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

/// The examination of a machine.
#[derive(Debug, Serialize)]
pub struct Examination {
    /// Fit for 1 kHz, as far as measured.
    pub fit: bool,
    /// The verdict in words.
    pub verdict: String,
    /// How late the timer woke a thread with the control thread's rights.
    #[serde(flatten)]
    pub soak: Soak,
    /// The examined properties of the machine.
    pub findings: Vec<Finding>,
}

/// Shortest measurement that can call a machine fit, s: a stall that occurs once a second must have had its chance.
const SHORTEST_S: f64 = 2.0;

/// Requests the same rights as the control thread, and measures the timer for `duration` or until `stop` is raised. Then it examines the
/// machine: its ports and, if a run's folder and duration are given, the room on the disk for it. `why`: name the programs that delayed a
/// wake-up.
///
/// # Errors
/// The measuring thread could not be started.
pub fn examine(
    duration: Duration,
    why: bool,
    runs: Option<(&Path, f64)>,
    stop: &AtomicBool,
) -> std::io::Result<Examination> {
    let request = Request::control_thread();
    let machine = Machine {
        root: Path::new("/"),
        cpu: request.cpu.unwrap_or(0),
        cpus: allowed_cpus().len(),
    };
    let mut findings = machine.findings();
    findings.extend(machine.serial_ports());
    findings.extend(runs.and_then(|(folder, run_s)| findings::disk(folder, run_s)));
    let soak = soak::soak(request, duration, why, stop)?;
    let (fit, verdict) = verdict(&soak, &findings);
    Ok(Examination {
        fit,
        verdict,
        soak,
        findings,
    })
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
                p10: 5.0,
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
