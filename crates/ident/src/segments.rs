//! The segments of an experiment: their ticks in the schedule, their records, and what a run or an analysis of them gives.

use crate::error::IdentError;
use crate::frequency_response::{FrequencyPoint, SegmentResponse};
use crate::noise::NoiseModel;

/// Segments laid end to end.
#[derive(Debug, Clone, PartialEq)]
pub struct Schedule {
    /// What to add to the command, um, one value per tick.
    pub excitation_um: Vec<f64>,
    /// Where each segment lies.
    pub spans: Vec<Span>,
}

/// The ticks of a segment in a [`Schedule`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Span {
    /// The segment's place in the plan.
    pub index: usize,
    /// Its first tick.
    pub start: usize,
    /// Ticks of settling, not used.
    pub settle: usize,
    /// Ticks in all, with settling and without fading out.
    pub rows: usize,
}

/// Mean age of the frames of all segments, s; `None` if one of the segments does not know it.
pub fn common_age_s(records: &[RecordedSegment]) -> Option<f64> {
    let (mut sum, mut rows) = (0.0, 0.0);
    for record in records {
        let used = record.input.len().saturating_sub(record.from) as f64;
        sum += used * record.age_s?;
        rows += used;
    }
    (rows > 0.0).then(|| sum / rows)
}

/// What a segment recorded.
#[derive(Debug, Clone, PartialEq)]
pub struct RecordedSegment {
    /// Its place in the plan.
    pub index: usize,
    /// First row after settling.
    pub from: usize,
    /// Mean time from the middle of an exposure to the tick that used it, s, by the frames' own stamps; `None`: not known.
    pub age_s: Option<f64>,
    /// Commanded displacement per row, um; in a row without a tick the command before it, which was held.
    pub input: Vec<f64>,
    /// Bead position per row, um; `NaN` in a row without one.
    pub output: Vec<f64>,
}

/// The finished segments of a run that ended early, and the cause.
#[derive(Debug, Clone, PartialEq)]
pub struct Stopped<E> {
    /// Segments finished before.
    pub done: Vec<RecordedSegment>,
    /// What happened.
    pub cause: Cause<E>,
}

/// The cause of an early end.
#[derive(Debug, Clone, PartialEq)]
pub enum Cause<E> {
    /// The rig failed.
    Rig(E),
    /// [`IdentError::BeadLost`]; resume at the segment that it names.
    BeadLost(IdentError),
}

/// A measured frequency response.
#[derive(Debug, Clone, PartialEq)]
pub struct Measured {
    /// Driven lines in order of frequency.
    pub points: Vec<FrequencyPoint>,
    /// The noise model, if there were enough lines.
    pub noise: Option<NoiseModel>,
    /// Per segment, detection lines included.
    pub segments: Vec<SegmentResponse>,
}
