//! Real time asked of the operating system, and an honest account of what was obtained.
//!
//! Each grant (policy and priority, CPU, locked memory) is asked for, then read back. Each refusal becomes a line of
//! [`Conditions::degraded`], which is printed with every timing figure.

use crate::latency::Latency;
use cellpos_rig::clock::{monotonic_ns, sleep_until_ns};
use rustix::mm::{MlockAllFlags, mlockall};
use rustix::thread::{CpuSet, sched_getaffinity, sched_setaffinity};
use serde::Serialize;
use std::fmt;
use std::time::Duration;
use thread_priority::{
    RealtimeThreadSchedulePolicy, ThreadPriority, ThreadPriorityValue, ThreadSchedulePolicy,
    set_thread_priority_and_policy, thread_native_id, thread_schedule_policy_param,
};

/// What a thread asks for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Request {
    /// SCHED_FIFO priority, 1 (low) to 99; `None` leaves the ordinary scheduler.
    pub fifo_priority: Option<u8>,
    /// CPU to stay on; `None` lets the scheduler choose.
    pub cpu: Option<usize>,
    /// Lock all pages, present and future (of the process).
    pub lock_memory: bool,
}

impl Request {
    /// What the control thread asks for: priority 80, the last allowed CPU (interrupts favour the first), locked memory.
    pub fn control_thread() -> Self {
        Self {
            fifo_priority: Some(80),
            cpu: allowed_cpus().last().copied(),
            lock_memory: true,
        }
    }

    /// What a measurement before a run asks for: to be as late as the control thread will be.
    pub fn like_control() -> Self {
        Self {
            lock_memory: false,
            ..Self::control_thread()
        }
    }

    /// What the threads around it ask for: a FIFO priority below control, on control's CPU. A frame wakes one thread after the other.
    /// Waking a thread on another CPU takes an interrupt: 0.2 to 0.4 ms if that CPU sleeps on a virtual machine, 1 us on the same CPU.
    pub fn io_thread(priority: u8) -> Self {
        Self {
            fifo_priority: Some(priority),
            cpu: Self::control_thread().cpu,
            lock_memory: false,
        }
    }

    /// Nothing at all: the named opt-out.
    pub fn best_effort() -> Self {
        Self {
            fifo_priority: None,
            cpu: None,
            lock_memory: false,
        }
    }
}

/// What was obtained, and what was not.
#[derive(Debug, Clone, PartialEq, Serialize, Default)]
pub struct Conditions {
    /// Scheduling policy read back after the request.
    pub policy: String,
    /// FIFO priority read back; 0 under the ordinary scheduler.
    pub priority: i32,
    /// CPU the thread is pinned to.
    pub cpu: Option<usize>,
    /// Whether all memory is locked.
    pub memory_locked: bool,
    /// CPUs this process may use.
    pub cpus: usize,
    /// Kernel release and version.
    pub kernel: String,
    /// Frequency governor of the CPU in use; `unknown` where the machine does not say.
    pub governor: String,
    /// CPUs isolated from the scheduler at boot; empty for none.
    pub isolated: String,
    /// Requests that were refused, and conditions that are known to spoil timing: one sentence each.
    pub degraded: Vec<String>,
}

/// CPUs the process may run on, in order.
pub fn allowed_cpus() -> Vec<usize> {
    sched_getaffinity(None)
        .map(|set| {
            (0..CpuSet::MAX_CPU)
                .filter(|&cpu| set.is_set(cpu))
                .collect()
        })
        .unwrap_or_default()
}

fn first_line(path: &str) -> Option<String> {
    let text = std::fs::read_to_string(path).ok()?;
    Some(text.lines().next().unwrap_or("").trim().to_string())
}

/// Does some work on a thread of its own with a request applied, and waits for it.
pub fn with<T: Send>(request: &Request, work: impl FnOnce() -> T + Send) -> T {
    let work = || {
        apply(request);
        work()
    };
    std::thread::scope(|scope| scope.spawn(work).join())
        .unwrap_or_else(|panic| std::panic::resume_unwind(panic))
}

/// Applies a request to the calling thread and says what was obtained.
pub fn apply(request: &Request) -> Conditions {
    let mut degraded = Vec::new();
    // Counted before this thread is pinned to one CPU.
    let cpus = allowed_cpus().len().max(1);
    if let Some(priority) = request.fifo_priority {
        let fifo = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
        let granted = ThreadPriorityValue::try_from(priority)
            .map_err(|error| error.to_string())
            .and_then(|value| {
                set_thread_priority_and_policy(
                    thread_native_id(),
                    ThreadPriority::Crossplatform(value),
                    fifo,
                )
                .map_err(|error| match error {
                    thread_priority::Error::OS(code) => {
                        std::io::Error::from_raw_os_error(code).to_string()
                    }
                    other => format!("{other:?}"),
                })
            });
        if let Err(error) = granted {
            degraded.push(format!(
                "SCHED_FIFO priority {priority} was refused ({error}): allow it with `ulimit -r {priority}`, \
                 an rtprio line in limits.conf, or CAP_SYS_NICE"
            ));
        }
    } else {
        degraded.push("best effort: real-time scheduling was not asked for".to_string());
    }
    let mut pinned = None;
    if let Some(cpu) = request.cpu {
        let mut set = CpuSet::new();
        set.set(cpu.min(CpuSet::MAX_CPU - 1));
        match sched_setaffinity(None, &set) {
            Ok(()) => pinned = Some(cpu),
            Err(error) => degraded.push(format!("pinning to CPU {cpu} was refused ({error})")),
        }
    }
    let mut memory_locked = false;
    if request.lock_memory {
        match mlockall(MlockAllFlags::CURRENT | MlockAllFlags::FUTURE) {
            Ok(()) => memory_locked = true,
            Err(error) => degraded.push(format!(
                "mlockall was refused ({error}): raise `ulimit -l` or grant CAP_IPC_LOCK; a page fault can stall a tick"
            )),
        }
    }
    let (policy, priority) = match thread_schedule_policy_param(thread_native_id()) {
        Ok((policy, parameters)) => (policy_name(policy), parameters.sched_priority),
        Err(_) => ("unknown".to_string(), 0),
    };
    let governor = first_line(&format!(
        "/sys/devices/system/cpu/cpu{}/cpufreq/scaling_governor",
        pinned.unwrap_or(0)
    ))
    .unwrap_or_else(|| "unknown".to_string());
    if governor != "performance" && governor != "unknown" && request.fifo_priority.is_some() {
        degraded.push(format!(
            "the CPU frequency governor is `{governor}`: set `performance` (cpupower frequency-set -g performance)"
        ));
    }
    if cpus < 2 {
        degraded.push("one CPU only: camera, control and recording share it".to_string());
    }
    Conditions {
        policy,
        priority,
        cpu: pinned,
        memory_locked,
        cpus,
        kernel: kernel(),
        governor,
        isolated: first_line("/sys/devices/system/cpu/isolated").unwrap_or_default(),
        degraded,
    }
}

fn policy_name(policy: ThreadSchedulePolicy) -> String {
    match policy {
        ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo) => {
            "SCHED_FIFO".to_string()
        }
        ThreadSchedulePolicy::Normal(_) => "SCHED_OTHER".to_string(),
        other => format!("{other:?}"),
    }
}

fn kernel() -> String {
    let read = |name| first_line(&format!("/proc/sys/kernel/{name}")).unwrap_or_default();
    format!("{} {}", read("osrelease"), read("version"))
}

/// A bare absolute-sleep loop at 1 kHz on the calling thread: its wake-up latencies and the periods it missed. `woken` hears
/// how late each wake-up was, ns.
///
/// It is the yardstick for every timing of the real loop: stalls seen here are the machine's own.
pub fn bare_loop(duration: Duration, mut woken: impl FnMut(u64)) -> (Latency, u64) {
    bare_loop_while(duration, |late_ns| {
        woken(late_ns);
        true
    })
}

/// As [`bare_loop`], until `woken` says that it is enough.
pub fn bare_loop_while(duration: Duration, woken: impl FnMut(u64) -> bool) -> (Latency, u64) {
    bare_loop_at(Duration::from_millis(1), duration, woken)
}

/// As [`bare_loop_while`] at any period; one of less than a microsecond counts as that.
pub fn bare_loop_at(
    period: Duration,
    duration: Duration,
    mut woken: impl FnMut(u64) -> bool,
) -> (Latency, u64) {
    let period_ns = i64::try_from(period.as_nanos()).map_or(i64::MAX / 4, |ns| ns.max(1000));
    let mut latency = Latency::new();
    let mut missed = 0;
    let start = monotonic_ns() + period_ns;
    let ticks = i64::try_from(duration.as_nanos() / period_ns as u128).unwrap_or(i64::MAX);
    let mut tick = 0;
    while tick < ticks {
        let due = start + tick * period_ns;
        sleep_until_ns(due);
        let late = (monotonic_ns() - due).max(0);
        latency.record(late as u64, tick as u64);
        let goes_on = woken(late as u64);
        let skipped = late / period_ns;
        missed += skipped as u64;
        tick = tick.saturating_add(1 + skipped);
        if !goes_on {
            break;
        }
    }
    (latency, missed)
}

impl fmt::Display for Conditions {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "  kernel        {}", self.kernel)?;
        writeln!(
            f,
            "  policy        {} priority {}",
            self.policy, self.priority
        )?;
        match self.cpu {
            Some(cpu) => writeln!(f, "  CPU           pinned to {cpu} of {}", self.cpus)?,
            None => writeln!(f, "  CPU           not pinned, {} available", self.cpus)?,
        }
        let isolated = if self.isolated.is_empty() {
            "none"
        } else {
            &self.isolated
        };
        writeln!(f, "  isolated CPUs {isolated}")?;
        writeln!(f, "  governor      {}", self.governor)?;
        writeln!(
            f,
            "  memory        {}",
            if self.memory_locked {
                "locked"
            } else {
                "not locked"
            }
        )?;
        for line in &self.degraded {
            writeln!(f, "  DEGRADED      {line}")?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_cannot_be_granted_is_named_and_nothing_else_is_claimed() {
        let conditions = std::thread::spawn(|| {
            apply(&Request {
                fifo_priority: Some(200),
                cpu: Some(CpuSet::MAX_CPU - 1),
                lock_memory: false,
            })
        })
        .join()
        .expect("the thread ends");
        assert_eq!(conditions.priority, 0);
        assert_eq!(conditions.cpu, None);
        assert!(!conditions.memory_locked);
        let text = conditions.degraded.join("\n");
        assert!(
            text.contains("SCHED_FIFO priority 200") && text.contains("pinning"),
            "{text}"
        );
    }

    #[test]
    fn best_effort_is_always_shown_as_degraded() {
        let conditions = apply(&Request::best_effort());
        let text = conditions.to_string();
        assert!(text.contains("DEGRADED      best effort"), "{text}");
    }

    #[test]
    fn the_bare_loop_wakes_once_a_period_or_counts_it_as_missed() {
        let mut heard = 0;
        let (latency, missed) = bare_loop(Duration::from_millis(50), |_| heard += 1);
        assert_eq!(latency.count(), heard);
        // The last wake-up may be late by more periods than were left.
        assert!(heard > 0 && heard + missed >= 50, "{heard} {missed}");
        let (period, duration) = (Duration::from_micros(500), Duration::from_millis(50));
        let (latency, missed) = bare_loop_at(period, duration, |_| true);
        assert!(latency.count() + missed >= 100, "{missed}");
    }
}
