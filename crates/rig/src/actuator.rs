//! The PZT actuator from the view of the loop's I/O thread.
//!
//! The types belong to the loop, not to one board. An analogue output card, a network controller and the project's own board all
//! report an [`ActuatorState`] and an [`ActuatorFault`].

use serde::Serialize;
use std::time::Duration;

/// Present state of an actuator. The numbers are those of a run's record.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[repr(u8)]
pub enum ActuatorState {
    /// At park or on the way there; takes no commands.
    Disarmed = 0,
    /// Holds its displacement and waits for the first command.
    Armed = 1,
    /// Follows commands.
    Running = 2,
    /// Holds the zero-flow displacement on request ([`Actuator::freeze`]); only a new session leaves this.
    Frozen = 3,
    /// Parks or is parked; latched: only a new session leaves this.
    Safe = 4,
    /// Holds the zero-flow displacement because commands stopped; continues with the next new command.
    Holding = 5,
}

impl ActuatorState {
    /// All, in the order of their numbers.
    pub const ALL: [Self; 6] = [
        Self::Disarmed,
        Self::Armed,
        Self::Running,
        Self::Frozen,
        Self::Safe,
        Self::Holding,
    ];

    /// The state of a number in a record; anything unknown is [`ActuatorState::Safe`].
    pub fn from_number(number: u8) -> Self {
        Self::ALL
            .into_iter()
            .find(|state| *state as u8 == number)
            .unwrap_or(Self::Safe)
    }

    /// Whether commands are taken.
    pub fn takes_commands(self) -> bool {
        matches!(self, Self::Armed | Self::Running | Self::Holding)
    }
}

/// Why an actuator stopped following commands without a request. The numbers are those of a run's record.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[repr(u8)]
pub enum ActuatorFault {
    /// No fault.
    None = 0,
    /// No fresh command within the watchdog time.
    CommandTimeout = 1,
    /// Nothing came to end a freeze within the hold watchdog time.
    FreezeTimeout = 2,
    /// Armed, but no first command within the hold watchdog time.
    ArmTimeout = 3,
    /// A fault of the device: temperature, current, supply, converter.
    Device = 4,
}

impl ActuatorFault {
    /// All, in the order of their numbers.
    pub const ALL: [Self; 5] = [
        Self::None,
        Self::CommandTimeout,
        Self::FreezeTimeout,
        Self::ArmTimeout,
        Self::Device,
    ];

    /// The fault of a number in a record; anything unknown is [`ActuatorFault::Device`].
    pub fn from_number(number: u8) -> Self {
        Self::ALL
            .into_iter()
            .find(|fault| *fault as u8 == number)
            .unwrap_or(Self::Device)
    }
}

/// Limits of an actuator, from its own report.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ActuatorInfo {
    /// Kind, serial number, version of its firmware.
    pub name: String,
    /// Smallest displacement, um.
    pub low_um: f64,
    /// Largest displacement, um.
    pub high_um: f64,
    /// Largest rate of displacement, um/s.
    pub slew_um_per_s: f64,
    /// One step of the converter, um; 0 if unknown.
    pub step_um: f64,
    /// Default time without a new command after which it stops following, ms.
    pub watchdog_ms: u16,
    /// Default time that it then holds before it parks, ms.
    pub hold_watchdog_ms: u16,
}

/// The newest report of an actuator.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ActuatorReport {
    /// Its present session, [`ArmRequest::session`]: a foreign number means that another host armed it.
    pub session: u16,
    /// State.
    pub state: ActuatorState,
    /// Latched fault.
    pub fault: ActuatorFault,
    /// Displacement at the output, um.
    pub applied_um: f64,
    /// Sequence number of the last command obeyed, counted from 0 at arming; `None` before the first.
    pub last_seq: Option<u32>,
    /// Host time of that command, us since arming.
    pub last_time_us: u64,
    /// The actuator's own clock at the report, us since its start: shows the spacing of commands at arrival.
    pub device_time_us: u64,
    /// Frames that it could not read.
    pub bad_frames: u32,
    /// Ignored commands: old, doubled, of another session, or in a state that accepts none.
    pub ignored: u32,
    /// Number of holds in this session because commands stopped. It also counts holds between two reports.
    pub holds: u16,
    /// When the report was read, ns of the run's clock.
    pub read_ns: i64,
}

/// The newest report of the actuator's slow partner.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PartnerReport {
    /// State.
    pub state: ActuatorState,
    /// Its position on its own scale, um.
    pub applied_um: f64,
}

/// Why the actuator refused or failed a request.
#[derive(Debug, thiserror::Error)]
pub enum ActuatorError {
    /// The line is gone or broken.
    #[error("{actuator}: {stage}: {source}")]
    Line {
        /// Which actuator.
        actuator: String,
        /// What was being done.
        stage: &'static str,
        /// What the operating system said.
        #[source]
        source: std::io::Error,
    },
    /// No answer.
    #[error(
        "{actuator} was asked {request} and did not answer within {after:?}: is it powered, is it this port?"
    )]
    Timeout {
        /// Which actuator.
        actuator: String,
        /// What was asked.
        request: &'static str,
        /// How long was waited.
        after: Duration,
    },
    /// A refusal.
    #[error("{actuator} refused {request}: {reason}")]
    Refused {
        /// Which actuator.
        actuator: String,
        /// What was asked.
        request: &'static str,
        /// The reason, and what would be right.
        reason: String,
    },
    /// A command that is not a number; nothing was sent.
    #[error("a command must be a number: displacement {command_um} um, zero flow {neutral_um} um")]
    NotANumber {
        /// Displacement asked for, um.
        command_um: f64,
        /// Estimate of the zero-flow displacement, um.
        neutral_um: f64,
    },
    /// Another version of the protocol, or another kind of device.
    #[error(
        "{actuator} speaks {received}, this program {expected}: update the firmware or the program"
    )]
    Incompatible {
        /// Which actuator.
        actuator: String,
        /// What this program speaks.
        expected: String,
        /// What the device speaks.
        received: String,
    },
}

/// Settings of a session.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ArmRequest {
    /// Number of the session, random, so that two hosts at one actuator differ.
    pub session: u16,
    /// Where a ramp to park ends, um.
    pub park_um: f64,
    /// Smallest and largest displacement (um) and slew (um/s) of this session, at most the actuator's own.
    pub limits: [f64; 3],
    /// After this time without a new command it stops following and holds the zero-flow displacement, ms; `None` leaves the
    /// actuator's own.
    pub watchdog_ms: Option<u16>,
    /// After holding for this time it parks, ms; `None` leaves the actuator's own.
    pub hold_watchdog_ms: Option<u16>,
}

/// The fate of a session's commands, from the actuator's reports.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub struct CommandAccount {
    /// Commands handed over.
    pub commands: u64,
    /// Commands that a report names as obeyed.
    pub answered: u64,
    /// Commands that the line did not take before a newer one replaced them.
    pub not_taken: u64,
    /// Commands that the reports skipped: a report named a later one, but never these.
    pub passed_over: u64,
}

impl CommandAccount {
    /// Commands known to be lost so far. Those newer than the last report may still be on their way.
    pub fn lost(&self) -> u64 {
        self.passed_over.max(self.not_taken)
    }

    /// Lost commands, once no command is on its way any more.
    pub fn lost_in_all(&self) -> u64 {
        self.commands.saturating_sub(self.answered)
    }
}

/// A PZT actuator. Called from the actuator thread only; may block.
///
/// An error of the line does not end a run: the message is lost, and the next call tries again. Only silence of the actuator ends
/// a run.
///
/// An actuator enforces range and slew of its session at its output, and reacts to silence: a killed host must end in park.
pub trait Actuator: Send {
    /// What it can do.
    fn info(&self) -> ActuatorInfo;
    /// Starts a session: the actuator holds its displacement and waits for commands.
    ///
    /// # Errors
    /// No answer, or a refusal.
    fn arm(&mut self, request: &ArmRequest) -> Result<ActuatorReport, ActuatorError>;
    /// Sends a displacement and the estimate of the zero-flow displacement, both um.
    ///
    /// # Errors
    /// The line is broken.
    fn command(
        &mut self,
        command_um: f64,
        neutral_um: f64,
        time_us: u64,
    ) -> Result<(), ActuatorError>;
    /// Slew to the last estimate of the zero-flow displacement and hold there.
    ///
    /// # Errors
    /// The line is broken.
    fn freeze(&mut self) -> Result<(), ActuatorError>;
    /// Ramp to park; only [`Actuator::arm`] ends it.
    ///
    /// # Errors
    /// The line is broken.
    fn park(&mut self) -> Result<(), ActuatorError>;
    /// End the session: ramp to park, then disarmed.
    ///
    /// # Errors
    /// The line is broken.
    fn disarm(&mut self) -> Result<(), ActuatorError>;
    /// Reads what has arrived; the newest report, if any.
    ///
    /// # Errors
    /// The line is broken.
    fn poll(&mut self) -> Result<Option<ActuatorReport>, ActuatorError>;
    /// Sends a command to the slow partner, um on the partner's scale. A failure counts as silence of the partner, not as an
    /// error of this actuator.
    fn command_partner(&mut self, _command_um: f64, _time_us: u64) {}
    /// Limits of the slow partner; `None` without one.
    fn partner_info(&self) -> Option<ActuatorInfo> {
        None
    }
    /// Reads what has arrived from the slow partner; its newest report, if any.
    fn poll_partner(&mut self) -> Option<PartnerReport> {
        None
    }
    /// The fate of this session's commands; `None` if the actuator does not report it.
    fn account(&self) -> Option<CommandAccount> {
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_of_a_record_read_back_as_what_they_were_and_unknown_ones_as_the_worst() {
        for state in ActuatorState::ALL {
            assert_eq!(ActuatorState::from_number(state as u8), state);
        }
        for fault in ActuatorFault::ALL {
            assert_eq!(ActuatorFault::from_number(fault as u8), fault);
        }
        assert_eq!(ActuatorState::from_number(200), ActuatorState::Safe);
        assert_eq!(ActuatorFault::from_number(200), ActuatorFault::Device);
    }
}
