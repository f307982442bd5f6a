//! The segments of an experiment: their ticks in the schedule, and their records.

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
    /// Commanded displacement per row, um; `NaN` in a row without a tick.
    pub input: Vec<f64>,
    /// Bead position per row, um; `NaN` in a row without one.
    pub output: Vec<f64>,
}
