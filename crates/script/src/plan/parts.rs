//! Parts of a plan.

use super::course::Periodic;
use crate::script::{Condition, MoveShape, OnTimeout, Stop, WaveShape};

/// The motion of a segment, from the segment's `from_um`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Motion {
    /// Stays.
    Hold,
    /// Goes to a position over the segment's duration.
    Move {
        /// How.
        shape: MoveShape,
        /// Where to, um.
        to_um: f64,
    },
    /// Periodic motion about `from_um`.
    Wave {
        /// Shape.
        shape: WaveShape,
        /// Amplitude, um.
        amplitude_um: f64,
        /// Frequency, Hz.
        frequency_hz: f64,
        /// Cycles over which the amplitude grows.
        ramp_in: f64,
        /// Cycles over which it falls.
        ramp_out: f64,
    },
    /// Periodic motion through points of the plan.
    Points {
        /// First point.
        first: usize,
        /// Number of points.
        count: usize,
        /// Duration of one cycle, s.
        period_s: f64,
    },
    /// Stays until a condition is met; takes no time in the plan.
    Wait {
        /// The condition.
        condition: Condition,
        /// Longest time, s.
        timeout_s: f64,
        /// What then.
        on_timeout: OnTimeout,
    },
}

/// A piece of the plan.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Segment {
    /// Start, s.
    pub start_s: f64,
    /// Duration, s.
    pub duration_s: f64,
    /// Position at the start, um.
    pub from_um: f64,
    /// What it does.
    pub motion: Motion,
    /// Line of its step in the file.
    pub line: usize,
    /// Number of its periodic motion, see [`Plan::periodic`]; None: it is not periodic.
    pub periodic: Option<u16>,
}

/// A mark in the record.
#[derive(Debug, Clone, PartialEq)]
pub struct Mark {
    /// When, s.
    pub time_s: f64,
    /// Whether a wait at the same time of the plan is before it: it comes when that wait is over.
    pub after_wait: bool,
    /// What to write.
    pub text: String,
}

/// Which arm of a test a cycle belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ArmKind {
    /// The one that moves.
    #[default]
    Cyclic,
    /// Its static control arm.
    Static,
}

/// One cycle: a period of a wave, or a pass of a repeat or sweep without waves (of a sweep within a repeat: the repeat's pass).
/// In a static arm: the mean duration of a cycle of the cyclic arm.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Cycle {
    /// Number, from 0.
    pub number: u64,
    /// Its arm.
    pub arm: ArmKind,
    /// Start, s.
    pub start_s: f64,
    /// Duration, s.
    pub duration_s: f64,
    /// Whether the amplitude of its wave grows or falls over it (`ramp_in`, `ramp_out`).
    pub ramp: bool,
}

/// Equal cycles one after the other.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Cycles {
    pub(super) first: u64,
    pub(super) count: u64,
    pub(super) start_s: f64,
    pub(super) period_s: f64,
    pub(super) arm: ArmKind,
    pub(super) ramp: bool,
}

/// A script laid out in time. Waits take no time in it: a [`crate::Cursor`] stops its clock at them.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    pub(super) segments: Vec<Segment>,
    pub(super) points: Vec<(f64, f64)>,
    pub(super) periodic: Vec<Periodic>,
    pub(super) cycles: Vec<Cycles>,
    pub(super) marks: Vec<Mark>,
    /// Waits: number of the segment and its time, s.
    pub(super) waits: Vec<(usize, f64)>,
    pub(super) stop: Stop,
    pub(super) start_um: f64,
    pub(super) duration_s: f64,
}
