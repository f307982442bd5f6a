//! Moves the PZT by hand: within the rig file's limits, at the user's speed. The board is parked on success, error and panic.

use crate::bench::Board;
use cellpos_control::Limits;
use cellpos_rig::{Actuator, ActuatorReport, ActuatorState, ArmRequest, Clock};
use cellpos_runtime::live::Operator;
use cellpos_session::signals::{self, Place};
use cellpos_session::{Failure, RigFile};
use std::hash::{BuildHasher, Hasher};
use std::sync::Arc;

/// Between two commands, ns.
const PERIOD_NS: i64 = 1_000_000;

/// An armed board that follows commands; parked on drop.
pub struct Mover {
    board: Board,
    limits: Limits,
    clock: Clock,
    start_ns: i64,
    due_ns: i64,
    /// Displacement commanded last, um.
    at_um: f64,
    session: u16,
    newest: ActuatorReport,
    /// While this is held, a signal parks the board before it ends the program.
    _place: Place,
}

impl Mover {
    /// Arms a board with the limits of a rig file. Nothing moves: it continues from its present displacement.
    ///
    /// # Errors
    /// No answer, a refusal, or limits that do not meet the board's.
    pub fn arm(mut board: Board, file: &RigFile) -> Result<Self, Failure> {
        let place = signals::hold(&Arc::new(Operator::default())).map_err(Failure::failed)?;
        let info = board.info();
        let limits = Limits {
            low_um: file.limits.low_um.max(info.low_um),
            high_um: file.limits.high_um.min(info.high_um),
            slew_um_per_s: file.limits.slew_um_per_s.min(info.slew_um_per_s),
            park_um: file.limits.park_um,
        };
        let [watchdog_ms, hold_watchdog_ms] = file.watchdogs_ms();
        let session = std::hash::RandomState::new().build_hasher().finish() as u16;
        let newest = board
            .arm(&ArmRequest {
                session,
                park_um: limits.park_um,
                limits: [limits.low_um, limits.high_um, limits.slew_um_per_s],
                watchdog_ms,
                hold_watchdog_ms,
            })
            .map_err(Failure::failed)?;
        if limits.low_um >= limits.high_um {
            return Err(Failure::bad_input(
                format!(
                    "[limits] of rig.toml ({} to {} um) and the board's range ({} to {} um) do not meet",
                    file.limits.low_um, file.limits.high_um, info.low_um, info.high_um
                ),
                "change low_um and high_um in [limits]",
            ));
        }
        let clock = Clock::Real;
        let now_ns = clock.now_ns();
        Ok(Self {
            board,
            limits,
            clock,
            start_ns: now_ns,
            due_ns: now_ns,
            // The PZT may rest outside the limits: by a step of the converter, or at a park displacement that the limits exclude.
            // The board accepts no command there.
            at_um: newest.applied_um.clamp(limits.low_um, limits.high_um),
            session,
            newest,
            _place: place,
        })
    }

    /// Limits in force.
    pub fn limits(&self) -> &Limits {
        &self.limits
    }

    /// Displacement commanded last, um.
    pub fn at_um(&self) -> f64 {
        self.at_um
    }

    /// The board's newest status.
    pub fn newest(&self) -> &ActuatorReport {
        &self.newest
    }

    /// Runs one millisecond: waits for its beginning, steps towards `to_um` at no more than `speed_um_per_s`, and reads the
    /// board's messages. Returns whether the PZT has arrived.
    ///
    /// # Errors
    /// A displacement outside the limits, a signal to end, a broken line, or a board that is safe or belongs to another host.
    pub fn step(&mut self, to_um: f64, speed_um_per_s: f64) -> Result<bool, Failure> {
        if !(self.limits.low_um..=self.limits.high_um).contains(&to_um) {
            return Err(Failure::bad_input(
                format!("{to_um} um: outside the limits"),
                format!(
                    "[limits] of rig.toml and the board allow {} to {} um",
                    self.limits.low_um, self.limits.high_um
                ),
            ));
        }
        if let Some(signal) = signals::stopped_by() {
            return Err(stopped(signal));
        }
        self.clock.sleep_until_ns(self.due_ns);
        let now_ns = self.clock.now_ns();
        // Steps that a stall has cost are skipped.
        self.due_ns = (self.due_ns + PERIOD_NS).max(now_ns);
        let reach_um = speed_um_per_s.min(self.limits.slew_um_per_s) * PERIOD_NS as f64 * 1e-9;
        self.at_um += (to_um - self.at_um).clamp(-reach_um, reach_um);
        let time_us = u64::try_from((now_ns - self.start_ns) / 1000).unwrap_or(0);
        // No bead is followed, so the best to hold is the present displacement.
        self.board
            .command(self.at_um, self.at_um, time_us)
            .map_err(Failure::failed)?;
        if let Some(report) = self.board.poll().map_err(Failure::failed)? {
            self.newest = report;
        }
        let report = &self.newest;
        if report.session != self.session {
            return Err(Failure::bad_input(
                "another program has armed the board",
                "end it, and begin again",
            ));
        }
        if matches!(report.state, ActuatorState::Safe | ActuatorState::Disarmed) {
            return Err(Failure::bad_input(
                format!(
                    "the board went to park ({:?}, {:?})",
                    report.state, report.fault
                ),
                "no command came within both its watchdog times: is the machine overloaded?",
            ));
        }
        Ok(self.at_um == to_um)
    }
}

impl Drop for Mover {
    fn drop(&mut self) {
        // If this fails, the board's own watchdog parks.
        let _ = self.board.disarm();
    }
}

/// The end that a signal asks for.
pub(crate) fn stopped(signal: &str) -> Failure {
    let stopped = format!("stopped by {signal}: the PZT is parked");
    Failure::failed(std::io::Error::other(stopped))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Bench;

    #[test]
    fn a_pzt_that_rests_a_converter_step_outside_the_limits_is_moved() {
        let mut file = RigFile::default();
        file.board.power_up_um = 20.0;
        // Codes are 0.6 nm apart: the board is at 20.0003 um.
        file.limits.low_um = 20.0008;
        file.limits.park_um = 20.0;
        let bench = Bench::of(file).expect("a bench");
        let mut mover = Mover::arm(bench.board().expect("a board"), bench.file()).expect("armed");
        assert!(mover.newest().applied_um < 20.0008);
        let rests_um = mover.at_um();
        mover.step(rests_um, 100.0).expect("it may rest");
        while !mover.step(20.5, 1000.0).expect("it may move") {}
        assert!(mover.step(19.9, 1000.0).is_err());
    }
}
