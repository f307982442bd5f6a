//! The vocabulary: every message that crosses the wire.
//!
//! All numbers are whole, so that a message means the same bits on every machine and none is "not a number".

use serde::{Deserialize, Serialize};

/// Version of the protocol, exchanged in [`ToBoard::Hello`] and [`Identity`]. A board refuses to be armed by a host of
/// another version.
pub const PROTOCOL_VERSION: u16 = 2;

/// A message from the host to the board.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum ToBoard {
    /// Opens the conversation; answered by [`ToHost::Identity`].
    Hello {
        /// The host's [`PROTOCOL_VERSION`].
        protocol: u16,
    },
    /// Starts a session: clears a latched fault, holds the present displacement, waits for commands.
    Arm(Arm),
    /// The displacement of the PZT from now on.
    Command(Command),
    /// Slew to the last zero-flow estimate and hold it there: the bead almost stops.
    Freeze,
    /// Slew-limited ramp to the park displacement; latched until the next [`ToBoard::Arm`].
    Park,
    /// Ends the session: ramp to the park displacement, then disarmed.
    Disarm,
    /// Switches the LED in front of the camera (measurement of the camera's delay).
    Led {
        /// Lit or dark.
        on: bool,
    },
    /// Asks for one [`ToHost::Status`].
    StatusRequest,
    /// Asks for a [`ToHost::Pong`] (round-trip time; does not feed the watchdog).
    Ping {
        /// Comes back unchanged.
        token: u32,
    },
}

/// Settings of a session.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Arm {
    /// Random number of the session, chosen by the host so that two hosts differ. The board ignores and counts commands of
    /// another session.
    pub session: u16,
    /// After this time without a new command while running, the board moves to the last zero-flow estimate and holds it. `None`:
    /// the board's default.
    pub watchdog_ms: Option<u16>,
    /// After holding for this time (holding, frozen, or armed without a first command) the board ramps to park. `None`: the
    /// board's default.
    pub hold_watchdog_ms: Option<u16>,
    /// Displacement at the end of a ramp to park. `None`: the board's default.
    pub park_pm: Option<i32>,
    /// Limits tighter than the board's own.
    pub limits: Option<Limits>,
    /// Draw a straight line between commands instead of a step (costs half a command period of delay).
    pub interpolate: bool,
    /// Send a [`ToHost::Status`] after this number of accepted commands; 0: only on request or on a change of state.
    pub status_every: u16,
}

impl Arm {
    /// A session with the board's defaults and a status after each command.
    pub const fn session(session: u16) -> Self {
        Self {
            session,
            watchdog_ms: None,
            hold_watchdog_ms: None,
            park_pm: None,
            limits: None,
            interpolate: false,
            status_every: 1,
        }
    }
}

/// Limits of displacement and slew.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Limits {
    /// Smallest displacement, pm.
    pub low_pm: i32,
    /// Largest displacement, pm.
    pub high_pm: i32,
    /// Largest rate of displacement, nm/s (a rate of 1 um/ms is 1 000 000).
    pub slew_nm_per_s: u32,
}

/// One command of the loop.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Command {
    /// Session it belongs to.
    pub session: u16,
    /// Sequence number, rising by one (wraps around; compared with [`crate::order`]).
    pub seq: u32,
    /// Host time of its hand-over, us since arming: shows commands that were delayed on their way.
    pub time_us: u64,
    /// Commanded PZT displacement, pm.
    pub displacement_pm: i32,
    /// The host's running estimate of the zero-flow displacement, at which the bead is at rest, pm. It is the target of a freeze,
    /// and of a board without further commands.
    pub neutral_pm: i32,
}

/// A message from the board to the host.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum ToHost {
    /// Answer to [`ToBoard::Hello`].
    Identity(Identity),
    /// The request was carried out.
    Ack {
        /// Which.
        request: Request,
    },
    /// The request was not carried out.
    Refused {
        /// Which.
        request: Request,
        /// Why.
        refusal: Refusal,
    },
    /// How things stand.
    Status(Status),
    /// Sent once, when the board stops following commands without a request; every later status repeats it.
    Fault {
        /// Which.
        fault: Fault,
        /// Board time, us since its start.
        board_time_us: u64,
    },
    /// Answer to [`ToBoard::Ping`].
    Pong {
        /// As it came.
        token: u32,
        /// Board time, us since its start.
        board_time_us: u64,
    },
}

/// Identity and limits of the board.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Identity {
    /// The board's [`PROTOCOL_VERSION`].
    pub protocol: u16,
    /// Firmware version: major, minor, patch.
    pub firmware: [u8; 3],
    /// Serial number.
    pub serial: u32,
    /// Range and slew that the board enforces.
    pub limits: Limits,
    /// Rate of a ramp to park, nm/s.
    pub ramp_nm_per_s: u32,
    /// Default park displacement, pm.
    pub park_pm: i32,
    /// Bits of the digital-to-analogue converter over the range.
    pub dac_bits: u8,
    /// Default watchdog while running, ms.
    pub watchdog_ms: u16,
    /// Default watchdog while holding, frozen or armed, ms.
    pub hold_watchdog_ms: u16,
}

/// Kinds of requests, as named in answers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Request {
    /// [`ToBoard::Hello`].
    Hello,
    /// [`ToBoard::Arm`].
    Arm,
    /// [`ToBoard::Command`].
    Command,
    /// [`ToBoard::Freeze`].
    Freeze,
    /// [`ToBoard::Park`].
    Park,
    /// [`ToBoard::Disarm`].
    Disarm,
    /// [`ToBoard::Led`].
    Led,
}

/// The reason for refusing a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Refusal {
    /// Host and board speak different versions of the protocol, or no hello came first.
    Protocol,
    /// Limits that are empty or wider than the board's own, or no slew at all.
    Limits,
    /// A park displacement outside the limits.
    Park,
    /// A watchdog time of zero, or longer than the board allows.
    Watchdog,
    /// Not possible in the present state.
    State,
    /// Another session is running, and its commands are fresh.
    Busy,
}

/// State of the board.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[repr(u8)]
pub enum BoardState {
    /// At park or on the way there; commands are ignored.
    Disarmed = 0,
    /// Holding, waiting for the first command.
    Armed = 1,
    /// Following commands.
    Running = 2,
    /// Holding the zero-flow estimate on the host's request; only arm, park and disarm leave this state.
    Frozen = 3,
    /// Ramping to park or there; latched: only arm and disarm leave this state.
    Safe = 4,
    /// Holding the zero-flow estimate because commands stopped; a new command resumes.
    Holding = 5,
}

/// The reason why the board stopped following commands without a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[repr(u8)]
pub enum Fault {
    /// No fault.
    None = 0,
    /// No fresh command within the watchdog time while running; ends with the next fresh command, or with the next arming.
    CommandTimeout = 1,
    /// Nothing came to end a freeze within the hold watchdog time.
    FreezeTimeout = 2,
    /// Armed, but no first command within the hold watchdog time.
    ArmTimeout = 3,
}

/// State of the board.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Status {
    /// Session of the last [`ToBoard::Arm`].
    pub session: u16,
    /// Sequence number of the last command accepted in this session, if any.
    pub last_seq: Option<u32>,
    /// The `time_us` of that command, so that the host can tell the round-trip time.
    pub last_time_us: u64,
    /// State.
    pub state: BoardState,
    /// Displacement at the converter's output, pm.
    pub applied_pm: i32,
    /// Last zero-flow estimate, pm.
    pub neutral_pm: i32,
    /// Board time, us since its start.
    pub board_time_us: u64,
    /// Fault in force.
    pub fault: Fault,
    /// Whether the LED is lit.
    pub led: bool,
    /// Frames that failed the length, COBS, CRC or content check.
    pub bad_frames: u32,
    /// Ignored commands: old, doubled, reordered, of another session, or in a state that accepts none.
    pub ignored: u32,
    /// Commands delayed on their way by more than the board's allowance; the board still obeys them.
    pub late: u32,
    /// Commands clipped to the range.
    pub clipped: u32,
    /// Messages to the host dropped because they were not collected.
    pub unsent: u32,
    /// Number of holds in this session because commands stopped.
    pub holds: u16,
}
