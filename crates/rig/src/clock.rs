//! The clock of a run: the machine's monotonic clock, or a virtual one that advances only by calls.
//!
//! Real-time stamps of cellpos are nanoseconds of `CLOCK_MONOTONIC`. A step of the calendar clock does not change them, and other
//! processes on the machine (a camera server, the rig in a box) share them.

use rustix::thread::clock_nanosleep_absolute;
use rustix::time::{ClockId, Timespec, clock_gettime};
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};
use std::time::Duration;

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

/// The source of a run's time.
#[derive(Debug, Clone)]
pub enum Clock {
    /// `CLOCK_MONOTONIC`.
    Real,
    /// A number of nanoseconds that only [`Clock::sleep_until_ns`] and [`Clock::sleep`] advance.
    Virtual(Arc<AtomicI64>),
}

impl Clock {
    /// A virtual clock that reads `start_ns`.
    pub fn virtual_at(start_ns: i64) -> Self {
        Self::Virtual(Arc::new(AtomicI64::new(start_ns)))
    }

    /// Whether time advances only by calls.
    pub fn is_virtual(&self) -> bool {
        matches!(self, Self::Virtual(_))
    }

    /// The time, ns.
    pub fn now_ns(&self) -> i64 {
        match self {
            Self::Real => monotonic_ns(),
            Self::Virtual(now) => now.load(Ordering::Acquire),
        }
    }

    /// Waits until the clock reads `deadline_ns`: sleeps, or moves the virtual clock there (never back).
    pub fn sleep_until_ns(&self, deadline_ns: i64) {
        match self {
            Self::Real => sleep_until_ns(deadline_ns),
            Self::Virtual(now) => {
                now.fetch_max(deadline_ns, Ordering::AcqRel);
            }
        }
    }

    /// Waits for a time span.
    pub fn sleep(&self, span: Duration) {
        let span_ns = i64::try_from(span.as_nanos()).unwrap_or(i64::MAX / 4);
        self.sleep_until_ns(self.now_ns().saturating_add(span_ns));
    }
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

    #[test]
    fn a_virtual_clock_moves_forward_only_and_at_once() {
        let clock = Clock::virtual_at(5);
        clock.sleep_until_ns(1_000_000_000_000);
        clock.sleep_until_ns(7);
        clock.sleep(Duration::from_nanos(3));
        assert_eq!(clock.now_ns(), 1_000_000_000_003);
        assert!(clock.clone().is_virtual());
    }
}
