//! What a tick is given and gives, and its account.

use crate::life::{Event, EventKind, Events, Request};
use crate::tick_record::{TickFlags, TickRecord};
use cellpos_control::SolverTerms;
use cellpos_rig::{BoardReport, Measurement};
use serde::Serialize;

/// What a tick is given by its driver.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TickInput {
    /// Start of the tick since the start of the run, ns.
    pub time_ns: i64,
    /// The newest measurement in the ring; `None` on a timer tick. Its times, too, count from the start of the run.
    pub measurement: Option<Measurement>,
    /// Measurements found in the ring.
    pub drained: u32,
    /// How long the previous tick took, ns, if it was late.
    pub previous_late_ns: Option<u32>,
    /// The previous tick's command found the actuator ring full.
    pub previous_refused: bool,
    /// The newest report of the board, if one came since the previous tick.
    pub board: Option<BoardReport>,
    /// What the operator asks for.
    pub request: Request,
    /// How long an optimising controller may take, or how it ended when this tick was recorded.
    pub solver: SolverTerms,
}

/// What the actuator thread is to do.
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
    /// Ticks started by the timer: no frame came.
    pub timer: u64,
    /// Commands handed over late.
    pub late: u64,
    /// Ticks that never came.
    pub skipped: u64,
    /// Frames that were repeated, out of order, or older than allowed.
    pub stale: u64,
    /// Frame ids missing.
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
    /// Commands that found the actuator ring full.
    pub refused: u64,
    /// Ticks in which the optimiser ran out of time or found nothing, and its previous plan went on.
    pub plans_reused: u64,
    /// Ticks in which no plan was left, and PI stood in.
    pub solver_fallbacks: u64,
}

/// A tick under way.
pub(crate) struct Tick {
    pub(crate) seq: u64,
    pub(crate) time_ns: i64,
    pub(crate) flags: TickFlags,
    pub(crate) events: Events,
    /// Whether time did not pass as planned up to this tick: ticks skipped, its frame late, missing or old, a late command.
    pub(crate) disturbed: bool,
}

impl Tick {
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
        since: &mut Option<u64>,
        holds: bool,
        period_us: f64,
        started: EventKind,
        ended: impl Fn(f64) -> EventKind,
    ) {
        match (*since, holds) {
            (None, true) => {
                *since = Some(self.seq);
                self.event(started);
            }
            (Some(from), false) => {
                *since = None;
                self.event(ended((self.seq - from) as f64 * period_us * 1e-3));
            }
            _ => {}
        }
    }
}
