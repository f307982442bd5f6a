//! Input, output and account of a tick.

use crate::board_watch::BoardTrouble;
use crate::frames::FrameTally;
use crate::life::{Event, EventKind, Events, Request};
use crate::tick_record::{TickFlags, TickRecord};
use cellpos_control::SolverTerms;
use cellpos_rig::{ActuatorReport, CommandAccount, Measurement, PartnerReport};
use serde::Serialize;

/// Input of a tick, from its driver.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TickInput {
    /// Start of the tick since the start of the run, ns.
    pub time_ns: i64,
    /// The newest new measurement; `None` on a timer tick. Its times, too, count from the start of the run.
    pub measurement: Option<Measurement>,
    /// All frames that came since the previous tick.
    pub frames: FrameTally,
    /// How long the previous tick took, ns, if it was late.
    pub previous_late_ns: Option<u32>,
    /// The previous tick's command found the actuator ring full.
    pub previous_refused: bool,
    /// Since the previous tick it became known that a command was lost on the way to the board.
    pub command_lost: bool,
    /// The newest report of the board, if one came since the previous tick.
    pub board: Option<ActuatorReport>,
    /// The newest report of the slow partner, if one came since the previous tick.
    pub partner: Option<PartnerReport>,
    /// What is wrong with a board that talks, if anything is.
    pub board_trouble: Option<BoardTrouble>,
    /// What the operator asks for.
    pub request: Request,
    /// Where the operator wants the bead, um, for a reference that can be steered; a number, or `None`.
    pub target_um: Option<f64>,
    /// How long vision takes for a frame, ns, while it is slower than the camera.
    pub slow_vision_ns: Option<u32>,
    /// How long an optimising controller may take, or how it ended when this tick was recorded.
    pub solver: SolverTerms,
}

/// Reports of the actuator thread to the loop.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Heard {
    /// The newest report, if one came.
    pub report: Option<ActuatorReport>,
    /// The newest report of the slow partner, if one came.
    pub partner: Option<PartnerReport>,
    /// The fate of the commands so far, if the actuator reports it.
    pub account: CommandAccount,
}

/// Order for the actuator thread.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Action {
    /// Hand this command to the board.
    Command {
        /// PZT displacement, um: finite, within range and slew.
        command_um: f64,
        /// Estimate of neutral, um: where the board would freeze.
        neutral_um: f64,
    },
    /// Tell the board to ramp to park.
    Park,
    /// Nothing.
    None,
}

/// What a tick gives.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TickOutput {
    /// What to do.
    pub action: Action,
    /// Command for the slow partner, um on the partner's scale, if one is due.
    pub partner_um: Option<f64>,
    /// The record, less what only the driver knows (wake-up, compute time, late, ring full).
    pub record: TickRecord,
    /// What happened.
    pub events: Events,
}

/// What went wrong so far, by kind.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub struct Counts {
    /// Ticks.
    pub ticks: u64,
    /// Ticks started by the timer: no new frame came.
    pub timer: u64,
    /// Commands handed over late.
    pub late: u64,
    /// Ticks that never came.
    pub skipped: u64,
    /// Frames that were repeated, out of order, older than allowed, or stamped with a time that had not come.
    pub stale: u64,
    /// Of these: frames that came twice.
    pub doubled: u64,
    /// Of these: frames that came after their successor.
    pub reordered: u64,
    /// Of these: frames stamped with a time that had not come.
    pub future: u64,
    /// Frames that came earlier than expected by more than half a tick.
    pub early: u64,
    /// How often the camera restarted its count of frames.
    pub camera_restarts: u64,
    /// Frames that never came, each counted once.
    pub frames_lost: u64,
    /// Frames that arrived behind a newer one and were not used.
    pub superseded: u64,
    /// Frames without a valid bead position.
    pub fixes_lost: u64,
    /// Positions refused as too far from the prediction.
    pub gated: u64,
    /// Times that vision took a bead again after it had been lost.
    pub reacquired: u64,
    /// Ticks on prediction alone.
    pub coasted: u64,
    /// Ticks frozen.
    pub frozen: u64,
    /// Commands clipped to the range.
    pub range_limited: u64,
    /// Commands clipped to the slew limit.
    pub slew_limited: u64,
    /// Ticks without the slow partner, of a loop that has one.
    pub partner_lost: u64,
    /// Ticks with the slow partner at an end of its range.
    pub partner_limited: u64,
    /// Commands that found the actuator ring full.
    pub refused: u64,
    /// Ticks in which the optimiser ran out of time, and its best feasible point was followed.
    pub plans_stopped: u64,
    /// Ticks in which the optimiser found nothing, and its previous plan went on.
    pub plans_reused: u64,
    /// Ticks in which no plan was left, and PI stood in.
    pub solver_fallbacks: u64,
}

/// A tick under way.
pub(crate) struct Tick {
    pub(crate) seq: u64,
    pub(crate) time_ns: i64,
    /// Its number on the clock's grid, and how many steps of the grid have passed since the tick before.
    pub(crate) index: u64,
    pub(crate) steps: u64,
    /// Periods that have passed since the tick before, and by how much it is late, periods ([`crate::grid::Beat`]).
    pub(crate) periods: u64,
    pub(crate) late: f64,
    pub(crate) flags: TickFlags,
    pub(crate) events: Events,
    /// Whether its frame is late, missing or old.
    pub(crate) frames_disturbed: bool,
    /// Whether a command did not come into force when it was due: ticks skipped, a command late or lost.
    pub(crate) commands_disturbed: bool,
}

impl Tick {
    /// Whether time did not pass as planned up to this tick.
    pub(crate) fn disturbed(&self) -> bool {
        self.frames_disturbed || self.commands_disturbed
    }

    pub(crate) fn event(&mut self, kind: EventKind) {
        self.events.push(Event {
            seq: self.seq,
            time_ns: self.time_ns,
            kind,
        });
    }

    /// Start and end of a condition as a pair of events.
    pub(crate) fn span(
        &mut self,
        since_ns: &mut Option<i64>,
        holds: bool,
        started: EventKind,
        ended: impl Fn(f64) -> EventKind,
    ) {
        match (*since_ns, holds) {
            (None, true) => {
                *since_ns = Some(self.time_ns);
                self.event(started);
            }
            (Some(from_ns), false) => {
                *since_ns = None;
                self.event(ended((self.time_ns - from_ns) as f64 * 1e-6));
            }
            _ => {}
        }
    }
}
