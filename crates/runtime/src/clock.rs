//! The machine's monotonic clock and absolute sleeps.
//!
//! All real-time stamps of cellpos are nanoseconds of `CLOCK_MONOTONIC`: a step of the calendar clock cannot touch
//! them, and other processes on the machine (a camera server, the rig in a box) share them.

use rustix::thread::clock_nanosleep_absolute;
use rustix::time::{ClockId, Timespec, clock_gettime};

/// Nanoseconds of `CLOCK_MONOTONIC`.
pub fn monotonic_ns() -> i64 {
    let now = clock_gettime(ClockId::Monotonic);
    now.tv_sec * 1_000_000_000 + now.tv_nsec
}

/// Sleeps until `CLOCK_MONOTONIC` reads `deadline_ns`; returns at once when that is past.
///
/// Interrupted sleeps are resumed. An absolute sleep does not add up its own wake-up latency as a relative one does.
pub fn sleep_until_ns(deadline_ns: i64) {
    let request = Timespec {
        tv_sec: deadline_ns.div_euclid(1_000_000_000),
        tv_nsec: deadline_ns.rem_euclid(1_000_000_000),
    };
    while clock_nanosleep_absolute(ClockId::Monotonic, &request) == Err(rustix::io::Errno::INTR) {}
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sleep_never_ends_before_its_deadline() {
        for delay in [-1_000_000, 0, 200_000, 2_000_000] {
            let deadline = monotonic_ns() + delay;
            sleep_until_ns(deadline);
            assert!(monotonic_ns() >= deadline);
        }
    }
}
