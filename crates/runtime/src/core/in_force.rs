//! The displacement in force: what stands at the PZT while the line to its board is silent.
//!
//! A board that hears nothing keeps its last displacement, and after its watchdog's time goes to the zero flow that it was told
//! last. A loop that went on as if its commands were obeyed would learn a zero flow that is none. What is used here is in the
//! record of a run (time, whether the board was heard, its state and output), so that a replay sees the same.

use super::Core;
use cellpos_control::InForce;
use cellpos_rig::{ActuatorReport, ActuatorState};

/// Silence after which nothing is taken to reach the board, ns: a board answers each command.
const SILENT_NS: i64 = 10_000_000;
/// The longest pause between two reports that counts as usual, ns.
const LONGEST_PAUSE_NS: i64 = 20_000_000;
/// Watchdog's time of a board that nobody asked for another, ns.
const WATCHDOG_NS: i64 = 20_000_000;
/// What a longest usual pause between reports keeps of itself from report to report: it halves in 700.
const KEPT: f64 = 0.999;

/// What the board was last known to do.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Board {
    heard_ns: i64,
    applied_um: f64,
    holding: bool,
    /// Zero flow that it had been told when it was heard, um.
    zero_flow_um: f64,
    /// Longest usual pause between its reports, ns: some lines deliver them in bursts.
    pause_ns: f64,
    silent: bool,
    /// Silence after which it holds, ns.
    watchdog_ns: i64,
}

impl Board {
    pub(super) fn new(displacement_um: f64, zero_flow_um: f64) -> Self {
        Self {
            heard_ns: 0,
            applied_um: displacement_um,
            holding: false,
            zero_flow_um,
            pause_ns: 0.0,
            silent: false,
            watchdog_ns: WATCHDOG_NS,
        }
    }

    /// The first tick: the board was heard when it was armed.
    pub(super) fn start(&mut self, now_ns: i64) {
        self.heard_ns = now_ns;
    }

    /// Takes in what was heard by `now_ns`; `told_um` is the zero flow that went with the last command. Gives what stood at the
    /// PZT where it was not what was commanded, for ticks of `period_ns`.
    pub(super) fn step(
        &mut self,
        now_ns: i64,
        report: Option<&ActuatorReport>,
        told_um: f64,
        period_ns: i64,
    ) -> Option<InForce> {
        // A loop slower than a board's answers hears one in a tick at best.
        let least_ns = SILENT_NS.max(3 * period_ns);
        let longest_ns = LONGEST_PAUSE_NS.max(2 * least_ns);
        let since_ns = now_ns - self.heard_ns;
        let ticks = |ns: i64| usize::try_from(ns / period_ns).unwrap_or(1);
        // Silent until now, it stood where it was, and held from its watchdog's time on.
        let held = ticks(since_ns - self.watchdog_ns).max(1);
        let before = (self.applied_um, ticks(since_ns).saturating_sub(held));
        if let Some(report) = report {
            let pause_ns = since_ns.min(longest_ns) as f64;
            self.pause_ns = (KEPT * self.pause_ns).max(pause_ns);
            self.heard_ns = now_ns;
            self.applied_um = report.applied_um;
            let held_before = self.holding || self.silent;
            self.holding = report.state == ActuatorState::Holding;
            self.zero_flow_um = told_um;
            self.silent = false;
            return self.holding.then_some(InForce {
                displacement_um: report.applied_um,
                ticks: if held_before { 1 } else { held },
                before: if held_before { (0.0, 0) } else { before },
            });
        }
        let allowed_ns = (1.5 * self.pause_ns).clamp(least_ns as f64, longest_ns as f64);
        if since_ns as f64 <= allowed_ns {
            return None;
        }
        let stands = InForce {
            displacement_um: self.applied_um,
            ticks: if self.silent { 1 } else { ticks(since_ns) },
            before: (0.0, 0),
        };
        let was_silent = std::mem::replace(&mut self.silent, true);
        if self.holding || since_ns <= self.watchdog_ns {
            return Some(stands);
        }
        let holds = InForce {
            displacement_um: self.zero_flow_um,
            ticks: 1,
            ..stands
        };
        Some(if was_silent {
            holds
        } else {
            InForce {
                ticks: held,
                before,
                ..holds
            }
        })
    }
}

impl<R> Core<R> {
    /// The same loop with a board that holds zero flow after a silence of this time, ms.
    #[must_use]
    pub fn with_watchdog_ms(mut self, watchdog_ms: u16) -> Self {
        self.state.in_force.watchdog_ns = i64::from(watchdog_ms) * 1_000_000;
        self
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_rig::ActuatorFault;

    const MS: i64 = 1_000_000;

    fn report(applied_um: f64, state: ActuatorState) -> ActuatorReport {
        ActuatorReport {
            session: 0,
            state,
            fault: ActuatorFault::None,
            applied_um,
            last_seq: None,
            last_time_us: 0,
            device_time_us: 0,
            bad_frames: 0,
            ignored: 0,
            holds: 0,
            read_ns: 0,
        }
    }

    #[test]
    fn a_silent_board_stands_and_then_holds_the_zero_flow_that_it_was_told() {
        let mut board = Board::new(20.0, 20.0);
        for k in 1..=100 {
            let heard = report(21.0, ActuatorState::Running);
            assert_eq!(board.step(k * MS, Some(&heard), 19.9, MS), None);
        }
        for k in 1..=10 {
            assert_eq!(board.step((100 + k) * MS, None, 18.0, MS), None);
        }
        let stands = board.step(111 * MS, None, 18.0, MS).unwrap();
        assert_eq!((stands.displacement_um, stands.ticks), (21.0, 11));
        let stands = board.step(112 * MS, None, 18.0, MS).unwrap();
        assert_eq!((stands.displacement_um, stands.ticks), (21.0, 1));
        let holds = board.step(121 * MS, None, 18.0, MS).unwrap();
        assert_eq!((holds.displacement_um, holds.ticks), (19.9, 1));
        // Heard again: it still holds, then obeys.
        let holding = report(19.9, ActuatorState::Holding);
        assert!(board.step(122 * MS, Some(&holding), 19.9, MS).is_some());
        let obeys = report(19.95, ActuatorState::Running);
        assert_eq!(board.step(123 * MS, Some(&obeys), 19.9, MS), None);
    }

    #[test]
    fn a_line_that_delivers_in_bursts_is_not_silent() {
        let mut board = Board::new(20.0, 20.0);
        let heard = report(21.0, ActuatorState::Running);
        for k in 1..=1000 {
            let burst = (k % 12 == 0).then_some(&heard);
            let stood = board.step(k * MS, burst, 20.0, MS);
            assert!(stood.is_none() || k < 24, "{k}: {stood:?}");
        }
    }
}
