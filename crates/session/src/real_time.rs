//! Real-time rights that end with the run they were asked for.
//!
//! The loop's threads ask for SCHED_FIFO themselves ([`cellpos_runtime::realtime`]) and end with the run; the thread that drives
//! the board exists for the run only, too. So the caller's thread and its later work (Parquet, a search, a second run) are never
//! changed. Locked memory belongs to the process: it is locked before the board is armed, because that takes time for a large
//! process, and released after the run.

use rustix::mm::{MlockAllFlags, mlockall, munlockall};
use std::sync::{Mutex, PoisonError};

/// Sessions that want the memory locked.
static WANTED: Mutex<usize> = Mutex::new(0);

/// All memory locked, present and future; the last one dropped lets it go. A lock that was there before stays.
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
    /// Locks it; `None` where that was refused (the conditions of the run say so) or was done before by somebody else.
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
