//! The PZT actuator as the loop's I/O thread sees it.

use cellpos_link::{BoardState, Fault, Refusal, Request};
use serde::Serialize;
use std::time::Duration;

/// What an actuator can do, as it says itself.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ActuatorInfo {
    /// Smallest displacement, um.
    pub low_um: f64,
    /// Largest displacement, um.
    pub high_um: f64,
    /// Largest rate of displacement, um/s.
    pub slew_um_per_s: f64,
    /// One step of the converter, um.
    pub step_um: f64,
    /// Watchdog on missing commands, ms.
    pub watchdog_ms: u16,
    /// Serial number.
    pub serial: u32,
    /// Firmware version.
    pub firmware: [u8; 3],
}

/// The newest that the actuator has said.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BoardReport {
    /// State.
    pub state: BoardState,
    /// Latched fault.
    pub fault: Fault,
    /// Displacement at the converter's output, um.
    pub applied_um: f64,
    /// Sequence number of the last command obeyed.
    pub last_seq: Option<u32>,
    /// Host time of that command, us since arming.
    pub last_time_us: u64,
    /// Frames that the board could not read.
    pub bad_frames: u32,
    /// When the report was read, ns of the run's clock.
    pub read_ns: i64,
}

/// Why the actuator did not do what it was asked.
#[derive(Debug, thiserror::Error)]
pub enum ActuatorError {
    /// The line is gone or broken.
    #[error("PZT board on {port}: {stage}")]
    Line {
        /// Name of the port.
        port: String,
        /// What was being done.
        stage: &'static str,
        /// What the operating system said.
        #[source]
        source: std::io::Error,
    },
    /// No answer.
    #[error(
        "PZT board on {port}: no answer to {request:?} within {after:?}: is it powered, is it this port?"
    )]
    Timeout {
        /// Name of the port.
        port: String,
        /// What was asked.
        request: Request,
        /// How long was waited.
        after: Duration,
    },
    /// A refusal.
    #[error("PZT board on {port} refused {request:?}: {refusal:?}")]
    Refused {
        /// Name of the port.
        port: String,
        /// What was asked.
        request: Request,
        /// Why not.
        refusal: Refusal,
    },
    /// A command that is not a number; nothing was sent.
    #[error("a command must be a number: displacement {command_um} um, neutral {neutral_um} um")]
    NotANumber {
        /// Displacement asked for, um.
        command_um: f64,
        /// Estimate of neutral, um.
        neutral_um: f64,
    },
    /// Another protocol version.
    #[error(
        "PZT board on {port} speaks protocol {received}, this program {expected}: update the firmware or the program"
    )]
    Protocol {
        /// Name of the port.
        port: String,
        /// This program's version.
        expected: u16,
        /// The board's.
        received: u16,
    },
}

/// How a session is to be run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Session {
    /// Number of the session.
    pub id: u16,
    /// Where a ramp to park ends, um.
    pub park_um: f64,
    /// Limits tighter than the board's own: smallest, largest displacement (um) and slew (um/s).
    pub limits: [f64; 3],
    /// Watchdog on missing commands, ms; `None` leaves the board's.
    pub watchdog_ms: Option<u16>,
}

/// A PZT actuator. Called from the actuator thread only; may block.
pub trait Actuator: Send {
    /// What it can do.
    fn info(&self) -> ActuatorInfo;
    /// Starts a session: the board holds its displacement and waits for commands.
    ///
    /// # Errors
    /// No answer, or a refusal.
    fn arm(&mut self, session: &Session) -> Result<BoardReport, ActuatorError>;
    /// Hands over a displacement and the estimate of neutral, both um.
    ///
    /// # Errors
    /// The line is broken.
    fn command(
        &mut self,
        command_um: f64,
        neutral_um: f64,
        time_us: u64,
    ) -> Result<(), ActuatorError>;
    /// Slew to the last estimate of neutral and hold there.
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
    fn poll(&mut self) -> Result<Option<BoardReport>, ActuatorError>;
}
