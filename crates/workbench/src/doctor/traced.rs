//! Names who had the CPU while the loop waited for it, to the microsecond, from the kernel's own record of every switch.
//!
//! A separate trace instance (a ring in the kernel's memory) records `sched_switch` and `irq_handler_entry` during the
//! measurement, and is removed afterwards. It does not affect other tracing. It needs root and a mounted tracefs.

use super::suspect::Suspect;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicI64, Ordering};

/// Capacity for late wake-ups between two evaluations, which are a tenth of a second apart.
const WAITING: usize = 128;

/// Late wake-ups, handed over without a lock: from the due time to the wake-up, ns of the monotonic clock. If it is full, or two
/// are written at once, one is lost.
pub(super) struct LateWindows {
    from_ns: [AtomicI64; WAITING],
    to_ns: [AtomicI64; WAITING],
    next: std::sync::atomic::AtomicUsize,
}

impl LateWindows {
    pub(super) fn new() -> Self {
        Self {
            from_ns: std::array::from_fn(|_| AtomicI64::new(0)),
            to_ns: std::array::from_fn(|_| AtomicI64::new(0)),
            next: std::sync::atomic::AtomicUsize::new(0),
        }
    }

    /// A wake-up at `now_ns` that was `late_ns` late.
    pub(super) fn add(&self, now_ns: i64, late_ns: i64) {
        let place = self.next.fetch_add(1, Ordering::Relaxed) % WAITING;
        self.from_ns[place].store(now_ns - late_ns, Ordering::Relaxed);
        self.to_ns[place].store(now_ns, Ordering::Release);
    }

    /// The late wake-ups since the last call.
    fn take(&self) -> Vec<(i64, i64)> {
        let each = self.from_ns.iter().zip(&self.to_ns);
        each.filter_map(|(from, to)| {
            let to = to.swap(0, Ordering::Acquire);
            (to != 0).then(|| (from.load(Ordering::Relaxed), to))
        })
        .collect()
    }
}

/// The trace instance; removed on drop.
pub(super) struct Tracing {
    folder: PathBuf,
    cpu: Option<usize>,
    /// Late wake-ups that were evaluated, and those that the record no longer covered.
    pub looked: u64,
    pub unknown: u64,
    found: BTreeMap<String, Suspect>,
}

impl Tracing {
    /// Starts to record on the CPU of the loop (on all if it is not pinned), or returns the reason.
    pub(super) fn start(cpu: Option<usize>) -> Result<Self, String> {
        let root = ["/sys/kernel/tracing", "/sys/kernel/debug/tracing"]
            .into_iter()
            .map(Path::new)
            .find(|root| root.join("instances").is_dir());
        let Some(root) = root else {
            return Err(match rustix::process::geteuid().is_root() {
                true => {
                    "tracefs is not mounted: mount -t tracefs nodev /sys/kernel/tracing".to_owned()
                }
                false => {
                    "the kernel's record of switches is read by root alone: run doctor with sudo"
                        .to_owned()
                }
            });
        };
        remove_left_behind(&root.join("instances"));
        let folder = root.join(format!("instances/cellpos-doctor-{}", std::process::id()));
        std::fs::create_dir(&folder)
            .map_err(|error| format!("{}: {error}: run doctor with sudo", folder.display()))?;
        let tracing = Self {
            folder,
            cpu,
            looked: 0,
            unknown: 0,
            found: BTreeMap::new(),
        };
        let set = |name: &str, value: &str| {
            let path = tracing.folder.join(name);
            std::fs::write(&path, value).map_err(|error| format!("{}: {error}", path.display()))
        };
        set("trace_clock", "mono")?;
        set("buffer_size_kb", "512")?;
        set("events/sched/sched_switch/enable", "1")?;
        // A kernel without this event still records the switches.
        let _ = set("events/irq/irq_handler_entry/enable", "1");
        Ok(tracing)
    }

    /// Evaluates the late wake-ups since the last call.
    pub(super) fn look(&mut self, windows: &LateWindows) {
        let late = windows.take();
        if late.is_empty() {
            return;
        }
        let file = match self.cpu {
            Some(cpu) => self.folder.join(format!("per_cpu/cpu{cpu}/trace")),
            None => self.folder.join("trace"),
        };
        let text = std::fs::read_to_string(file).unwrap_or_default();
        let runs = runs(&text);
        for window in late {
            self.looked += 1;
            let shares = shares(&runs, window);
            self.unknown += u64::from(shares.is_empty());
            for (name, (amount, unit)) in shares {
                let suspect = self.found.entry(name.clone()).or_insert_with(|| Suspect {
                    name,
                    times: 0,
                    amount: 0.0,
                    unit,
                });
                suspect.times += 1;
                suspect.amount += amount;
            }
        }
    }

    /// The users of the CPU, the longest first.
    pub(super) fn suspects(&self) -> Vec<Suspect> {
        const MOST: usize = 8;
        let mut all: Vec<Suspect> = self.found.values().cloned().collect();
        all.sort_by(|a, b| b.amount.total_cmp(&a.amount).then(b.times.cmp(&a.times)));
        all.truncate(MOST);
        all
    }
}

/// Removes instances of killed processes: they would record forever.
fn remove_left_behind(instances: &Path) {
    for entry in std::fs::read_dir(instances).into_iter().flatten().flatten() {
        let name = entry.file_name();
        let pid = name
            .to_str()
            .and_then(|name| name.strip_prefix("cellpos-doctor-"));
        if pid.is_some_and(|pid| !Path::new("/proc").join(pid).exists()) {
            let _ = std::fs::remove_dir(entry.path());
        }
    }
}

impl Drop for Tracing {
    fn drop(&mut self) {
        let _ = std::fs::write(self.folder.join("events/enable"), "0");
        let _ = std::fs::remove_dir(&self.folder);
    }
}

/// A task on a CPU, or an interrupt (without an end).
#[derive(Debug, Clone, PartialEq)]
struct OnCpu {
    name: String,
    from_ns: i64,
    to_ns: Option<i64>,
}

/// Reads a trace: who was on which CPU from when to when.
fn runs(trace: &str) -> Vec<OnCpu> {
    let mut all = Vec::new();
    let mut running: BTreeMap<&str, (String, i64)> = BTreeMap::new();
    for line in trace.lines().filter(|line| !line.starts_with('#')) {
        // `  name-12 [001] d..2. 29720.455444: sched_switch: prev_comm=... ==> next_comm=... next_pid=... next_prio=...`
        let Some((head, event)) = line.split_once(": ") else {
            continue;
        };
        let Some(cpu) = head
            .split('[')
            .next_back()
            .and_then(|rest| rest.split(']').next())
        else {
            continue;
        };
        let time = head
            .split_whitespace()
            .next_back()
            .and_then(|text| text.parse::<f64>().ok());
        let Some(now_ns) = time.map(|s| (s * 1e9) as i64) else {
            continue;
        };
        if let Some(rest) = event.strip_prefix("sched_switch: ") {
            let Some((_, next)) = rest.split_once(" ==> next_comm=") else {
                continue;
            };
            let (name, pid) = next.rsplit_once(" next_pid=").unwrap_or((next, ""));
            let pid = pid.split_whitespace().next().unwrap_or("");
            let name = match pid {
                "0" => IDLE.to_owned(),
                pid => format!("{name} ({pid})"),
            };
            if let Some((name, from_ns)) = running.insert(cpu, (name, now_ns)) {
                all.push(OnCpu {
                    name,
                    from_ns,
                    to_ns: Some(now_ns),
                });
            }
        } else if let Some(rest) = event.strip_prefix("irq_handler_entry: ") {
            let name = rest.split("name=").nth(1).unwrap_or(rest).trim();
            all.push(OnCpu {
                name: format!("interrupt {name}"),
                from_ns: now_ns,
                to_ns: None,
            });
        }
    }
    // Who runs when the record ends still runs.
    all.extend(running.into_values().map(|(name, from_ns)| OnCpu {
        name,
        from_ns,
        to_ns: Some(i64::MAX),
    }));
    all
}

/// No task: the CPU slept, or the host of a virtual machine had it.
const IDLE: &str = "nobody (the CPU was idle: it woke late, or a hypervisor had it)";

/// Share of each task in a late window: ms, or the number of interrupts.
fn shares(runs: &[OnCpu], (from_ns, to_ns): (i64, i64)) -> BTreeMap<String, (f64, &'static str)> {
    let mut all = BTreeMap::new();
    for run in runs {
        match run.to_ns {
            Some(end_ns) => {
                let ns = end_ns.min(to_ns) - run.from_ns.max(from_ns);
                // The measuring thread itself runs in the last microseconds.
                if ns > 0 && !run.name.starts_with("cellpos-doctor ") {
                    all.entry(run.name.clone()).or_insert((0.0, "ms")).0 += ns as f64 * 1e-6;
                }
            }
            None if (from_ns..=to_ns).contains(&run.from_ns) => {
                all.entry(run.name.clone()).or_insert((0.0, "interrupts")).0 += 1.0;
            }
            None => {}
        }
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    const TRACE: &str = "# tracer: nop
            bash-25471   [001] d..2. 29720.455444: sched_switch: prev_comm=bash prev_pid=25471 prev_prio=120 prev_state=S ==> next_comm=opt 4ktsp next_pid=25475 next_prio=120
       opt 4ktsp-25475   [001] d.h1. 29720.456500: irq_handler_entry: irq=24 name=virtio0-input.0
       opt 4ktsp-25475   [001] d..2. 29720.457444: sched_switch: prev_comm=opt 4ktsp prev_pid=25475 prev_prio=120 prev_state=R ==> next_comm=swapper/1 next_pid=0 next_prio=120
          <idle>-0       [001] d..2. 29720.459444: sched_switch: prev_comm=swapper/1 prev_pid=0 prev_prio=120 prev_state=R ==> next_comm=cellpos-doctor next_pid=7 next_prio=9
";

    #[test]
    fn a_late_window_names_who_had_the_cpu_and_for_how_long() {
        let runs = runs(TRACE);
        let ns = |s: f64| (s * 1e9) as i64;
        let found = shares(&runs, (ns(29_720.456_0), ns(29_720.459_5)));
        let of = |name: &str| found.get(name).map_or(0.0, |(amount, _)| *amount);
        assert!((of("opt 4ktsp (25475)") - 1.444).abs() < 0.002, "{found:?}");
        assert!((of(IDLE) - 2.0).abs() < 0.002, "{found:?}");
        assert_eq!(
            found.get("interrupt virtio0-input.0"),
            Some(&(1.0, "interrupts"))
        );
        assert_eq!(
            found.len(),
            3,
            "the measuring thread is nobody's suspect: {found:?}"
        );
        // If the record no longer covers a time, later entries do not explain it.
        assert!(shares(&runs, (ns(29_700.0), ns(29_700.5))).is_empty());
    }

    #[test]
    fn windows_are_handed_over_once() {
        let windows = LateWindows::new();
        windows.add(5_000_000, 300_000);
        windows.add(9_000_000, 400_000);
        assert_eq!(
            windows.take(),
            vec![(4_700_000, 5_000_000), (8_600_000, 9_000_000)]
        );
        assert!(windows.take().is_empty());
    }
}
