//! Runs a bare loop at 1 kHz, and names the programs that ran when it was late.

use super::suspect::Suspect;
use super::traced::{LateWindows, Tracing};
use cellpos_runtime::latency::Quantiles;
use cellpos_runtime::realtime::{self, Conditions, Request, bare_loop_while};
use serde::Serialize;
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// Wake-ups later than this are explained, ns: a fifth of the period.
pub const LATE_NS: u64 = 200_000;

/// What the loop measured.
#[derive(Debug, Clone, Serialize)]
pub struct Soak {
    /// What was obtained.
    pub conditions: Conditions,
    /// How long it ran, s.
    pub seconds: f64,
    /// Wake-ups measured.
    pub wakeups: u64,
    /// From the due time to the wake-up, us.
    pub wake_us: Quantiles,
    /// Wake-ups later than [`LATE_NS`].
    pub late: u64,
    /// Periods that were missed altogether.
    pub missed: u64,
    /// The programs that ran while a wake-up was late; empty unless requested. With the kernel's record: those on the loop's CPU
    /// at that time. Without: those on the machine in that tenth of a second.
    pub suspects: Vec<Suspect>,
    /// How complete these names are, in a sentence; none unless requested.
    pub why: Option<String>,
}

/// Runs the loop, until `stop` is raised. `why`: whether to watch the other programs (ten times a second, at low priority).
pub(super) fn soak(
    request: Request,
    duration: Duration,
    why: bool,
    stop: &AtomicBool,
) -> std::io::Result<Soak> {
    let late = AtomicU64::new(0);
    let done = AtomicBool::new(false);
    let windows = LateWindows::new();
    std::thread::scope(|scope| {
        let watcher = why.then(|| {
            scope.spawn(|| match Tracing::start(request.cpu) {
                Ok(tracing) => watch_traced(tracing, &windows, &done),
                Err(error) => (watch(&late, &done, request.cpu), tracing(&error)),
            })
        });
        let measured = std::thread::Builder::new()
            .name("cellpos-doctor".to_string())
            .spawn_scoped(scope, || {
                let conditions = realtime::apply(&request);
                let start = Instant::now();
                let (latency, missed) = bare_loop_while(duration, |late_ns| {
                    if late_ns > LATE_NS {
                        late.fetch_add(1, Ordering::Relaxed);
                        windows.add(cellpos_rig::clock::monotonic_ns(), late_ns as i64);
                    }
                    !stop.load(Ordering::Relaxed)
                });
                (conditions, latency, missed, start.elapsed().as_secs_f64())
            });
        let measured = measured.map(|thread| thread.join());
        done.store(true, Ordering::Relaxed);
        let found = watcher.and_then(|thread| thread.join().ok());
        let Ok((conditions, latency, missed, seconds)) = measured? else {
            return Err(std::io::Error::other("the measuring thread broke off"));
        };
        Ok(Soak {
            conditions,
            seconds,
            wakeups: latency.count(),
            wake_us: latency.quantiles_us(),
            late: late.load(Ordering::Relaxed),
            missed,
            why: found.as_ref().map(|(_, how)| how.clone()),
            suspects: found.map(|(suspects, _)| suspects).unwrap_or_default(),
        })
    })
}

/// Processor time of every process (ms) and number of every interrupt so far, by name.
fn snapshot(cpu: Option<usize>) -> BTreeMap<String, (f64, &'static str)> {
    let mut all = BTreeMap::new();
    let own = std::process::id().to_string();
    for entry in std::fs::read_dir("/proc").into_iter().flatten().flatten() {
        let pid = entry.file_name().to_string_lossy().into_owned();
        if !pid.starts_with(|c: char| c.is_ascii_digit()) || pid == own {
            continue;
        }
        let Ok(stat) = std::fs::read_to_string(entry.path().join("stat")) else {
            continue;
        };
        // The name may contain blanks and brackets: the fields continue after its last bracket.
        if let (Some(open), Some(close)) = (stat.find('('), stat.rfind(')')) {
            let name = stat.get(open + 1..close).unwrap_or("?");
            let fields: Vec<&str> = stat
                .get(close + 1..)
                .unwrap_or("")
                .split_whitespace()
                .collect();
            let ticks = |index: usize| -> f64 {
                fields
                    .get(index)
                    .and_then(|field| field.parse().ok())
                    .unwrap_or(0.0)
            };
            // User and system time, in hundredths of a second.
            all.insert(
                format!("{name} ({pid})"),
                (10.0 * (ticks(11) + ticks(12)), "ms"),
            );
        }
    }
    let interrupts = std::fs::read_to_string("/proc/interrupts").unwrap_or_default();
    for line in interrupts.lines().skip(1) {
        let mut fields = line.split_whitespace();
        let Some(number) = fields.next() else {
            continue;
        };
        let rest: Vec<&str> = fields.collect();
        let counts: Vec<f64> = rest
            .iter()
            .map_while(|field| field.parse::<f64>().ok())
            .collect();
        let count = match cpu {
            Some(cpu) => counts.get(cpu).copied().unwrap_or(0.0),
            None => counts.iter().sum(),
        };
        let device = rest.get(counts.len()..).unwrap_or(&[]).join(" ");
        // The timer that wakes the loop fires a thousand times a second; it is not a suspect.
        if !device.contains("timer") {
            all.insert(
                format!("interrupt {number} {device}"),
                (count, "interrupts"),
            );
        }
    }
    all
}

/// Looks at the kernel's record ten times a second, until the loop is over, and once more.
fn watch_traced(
    mut tracing: Tracing,
    windows: &LateWindows,
    done: &AtomicBool,
) -> (Vec<Suspect>, String) {
    const LOOK: Duration = Duration::from_millis(100);
    loop {
        let last = done.load(Ordering::Relaxed);
        tracing.look(windows);
        if last {
            break;
        }
        std::thread::sleep(LOOK);
    }
    let lost = match tracing.unknown {
        0 => String::new(),
        lost => format!(" (of {lost} of them it no longer had the time)"),
    };
    let how = format!(
        "by the kernel's record of switches on the loop's CPU, over {} late wake-ups{lost}",
        tracing.looked
    );
    (tracing.suspects(), how)
}

fn watch(late: &AtomicU64, done: &AtomicBool, cpu: Option<usize>) -> Vec<Suspect> {
    const LOOK: Duration = Duration::from_millis(100);
    /// A tenth of a second holds ten samples: a program in one sample counts.
    const MOST: usize = 8;
    let mut found: BTreeMap<String, Suspect> = BTreeMap::new();
    let mut before = snapshot(cpu);
    let mut seen = late.load(Ordering::Relaxed);
    while !done.load(Ordering::Relaxed) {
        std::thread::sleep(LOOK);
        let after = snapshot(cpu);
        let now = late.load(Ordering::Relaxed);
        if now > seen {
            for (name, (amount, unit)) in &after {
                let grown = amount - before.get(name).map_or(0.0, |before| before.0);
                if grown > 0.0 {
                    let suspect = found.entry(name.clone()).or_insert_with(|| Suspect {
                        name: name.clone(),
                        times: 0,
                        amount: 0.0,
                        unit,
                    });
                    suspect.times += 1;
                    suspect.amount += grown;
                }
            }
        }
        seen = now;
        before = after;
    }
    let mut suspects: Vec<Suspect> = found.into_values().collect();
    suspects.sort_by(|a, b| {
        (b.times, b.amount)
            .partial_cmp(&(a.times, a.amount))
            .unwrap_or(std::cmp::Ordering::Equal)
    });
    suspects.truncate(MOST);
    suspects
}

/// The limit of naming without the kernel's record, and how to get the record.
fn tracing(error: &str) -> String {
    format!(
        "these programs ran within the same tenth of a second; which one had the CPU is unknown: {error}"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_else_runs_is_seen_by_name() {
        let all = snapshot(None);
        assert!(!all.is_empty());
        assert!(all.values().all(|(amount, _)| *amount >= 0.0));
        assert!(!all.keys().any(|name| name.contains("timer")));
    }
}
