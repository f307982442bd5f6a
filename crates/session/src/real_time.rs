//! Real-time rights that end with the run that requested them.
//!
//! The loop's threads request SCHED_FIFO themselves ([`cellpos_runtime::realtime`]) and end with the run, as does the thread that
//! drives the board. So the caller's thread and its later work (Parquet, a search, a second run) keep their priority. Locked
//! memory belongs to the process. The session locks it before it arms the board, because that takes time in a large process, and
//! releases it after the run.

use rustix::mm::{MlockAllFlags, mlockall, munlockall};
use std::sync::{Mutex, PoisonError};

/// Number of sessions that need locked memory.
static WANTED: Mutex<usize> = Mutex::new(0);

/// Keeps all present and future memory locked; the last one dropped releases it. An earlier lock remains.
#[derive(Debug)]
pub(crate) struct LockedMemory {
    _private: (),
}

/// Locked memory of this process, kB.
pub(crate) fn locked_kb() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    status
        .lines()
        .find_map(|line| line.strip_prefix("VmLck:"))
        .and_then(|rest| rest.split_whitespace().next()?.parse().ok())
        .unwrap_or(0)
}

impl LockedMemory {
    /// Locks it; `None` if the system refused (the conditions of the run say so) or if the memory was locked before by other
    /// code.
    pub(crate) fn lock() -> Option<Self> {
        let mut wanted = WANTED.lock().unwrap_or_else(PoisonError::into_inner);
        if *wanted == 0 && locked_kb() > 0 {
            return None;
        }
        mlockall(MlockAllFlags::CURRENT | MlockAllFlags::FUTURE).ok()?;
        *wanted += 1;
        Some(Self { _private: () })
    }
}

impl Drop for LockedMemory {
    fn drop(&mut self) {
        let mut wanted = WANTED.lock().unwrap_or_else(PoisonError::into_inner);
        *wanted = wanted.saturating_sub(1);
        if *wanted == 0 {
            let _ = munlockall();
        }
    }
}
