//! A script laid out in time.

mod course;
mod layout;
mod parts;
mod periodic;
mod shape;

pub use course::Periodic;
pub use parts::{ArmKind, Cycle, Mark, Motion, Plan, Segment};
pub use periodic::PeriodicReference;

use crate::error::ScriptError;
use crate::script::{Condition, Script, Stop};
use cellpos_control::Reference;
use layout::Layout;
use shape::{progress, rise, wave};

impl Plan {
    /// Lays a script out.
    ///
    /// # Errors
    /// [`ScriptError`] when it is too long, or a control arm names a label that is not above it.
    pub fn new(script: &Script) -> Result<Self, ScriptError> {
        Self::lay_out(script, false)
    }

    /// A short version with the same demands on the rig: at most three passes of each repeat, six cycles at full amplitude of
    /// each wave, and short holds.
    pub(crate) fn shortened(script: &Script) -> Result<Self, ScriptError> {
        Self::lay_out(script, true)
    }

    fn lay_out(script: &Script, short: bool) -> Result<Self, ScriptError> {
        let empty = Self {
            segments: Vec::new(),
            points: Vec::new(),
            periodic: Vec::new(),
            cycles: Vec::new(),
            marks: Vec::new(),
            waits: Vec::new(),
            stop: script.stop,
            start_um: script.start_um,
            duration_s: 0.0,
        };
        Layout::of(script, short, empty)
    }

    /// Duration without waits, s.
    pub fn total_s(&self) -> f64 {
        self.duration_s
    }

    /// Longest duration, s: each wait takes its longest time.
    pub fn longest_s(&self) -> f64 {
        let waits = self.segments.iter().map(|segment| match segment.motion {
            Motion::Wait { timeout_s, .. } => timeout_s,
            _ => 0.0,
        });
        self.duration_s + waits.sum::<f64>()
    }

    /// Position at the start, um.
    pub fn start_um(&self) -> f64 {
        self.start_um
    }

    /// The segments, in order of time.
    pub fn segments(&self) -> &[Segment] {
        &self.segments
    }

    /// The marks, in order of time.
    pub fn marks(&self) -> &[Mark] {
        &self.marks
    }

    /// The stop conditions.
    pub fn stop(&self) -> &Stop {
        &self.stop
    }

    /// Whether a wait or a stop of the script uses the length of the cell.
    pub fn needs_length(&self) -> bool {
        let waits = self.segments.iter().any(|s| {
            let condition = match &s.motion {
                Motion::Wait { condition, .. } => Some(*condition),
                _ => None,
            };
            matches!(condition, Some(Condition::CellLength { .. }))
        });
        let stop = &self.stop;
        waits
            || stop.length_change_above_um.is_some()
            || stop.stretch_down.is_some()
            || stop.rest_length_change.is_some()
            || stop.recovery_above_s.is_some()
    }

    /// Time of the next wait from a segment on, s, at which the plan's clock stops; infinity: never.
    pub(crate) fn next_wait_s(&self, segment: usize) -> f64 {
        let index = self.waits.partition_point(|(number, _)| *number < segment);
        self.waits.get(index).map_or(f64::INFINITY, |wait| wait.1)
    }

    /// Number of cycles.
    pub fn cycle_count(&self) -> u64 {
        self.cycles.last().map_or(0, |run| run.first + run.count)
    }

    /// A cycle by its number.
    pub fn cycle(&self, number: u64) -> Option<Cycle> {
        let index = self.cycles.partition_point(|run| run.first <= number);
        let run = index
            .checked_sub(1)
            .and_then(|index| self.cycles.get(index))?;
        let within = number - run.first;
        (within < run.count).then_some(Cycle {
            number,
            arm: run.arm,
            start_s: run.start_s + within as f64 * run.period_s,
            duration_s: run.period_s,
            ramp: run.ramp,
        })
    }

    /// The cycle that a time falls into.
    pub fn cycle_at(&self, time_s: f64) -> Option<Cycle> {
        let index = self.cycles.partition_point(|run| run.start_s <= time_s);
        let run = index
            .checked_sub(1)
            .and_then(|index| self.cycles.get(index))?;
        let within = ((time_s - run.start_s) / run.period_s).floor();
        (within < run.count as f64)
            .then(|| run.first + within as u64)
            .and_then(|number| self.cycle(number))
    }

    /// Cycles that have ended by a time.
    pub fn cycles_done(&self, time_s: f64) -> u64 {
        let index = self.cycles.partition_point(|run| run.start_s <= time_s);
        index
            .checked_sub(1)
            .and_then(|index| self.cycles.get(index))
            .map_or(0, |run| {
                // A time at the end of a cycle up to rounding counts as its end.
                let within = ((time_s - run.start_s) / run.period_s + 1e-9).floor();
                run.first + (within.max(0.0) as u64).min(run.count)
            })
    }

    /// The segment that a time falls into (the first after a wait; the last from the end on).
    pub fn segment_at(&self, time_s: f64) -> Option<&Segment> {
        let index = self.segments.partition_point(|s| s.start_s <= time_s);
        self.segments.get(index.saturating_sub(1))
    }

    /// Position within a segment, um. Allocates nothing.
    pub(crate) fn segment_um(&self, segment: &Segment, time_s: f64) -> f64 {
        let t = (time_s - segment.start_s).clamp(0.0, segment.duration_s);
        let from = segment.from_um;
        match segment.motion {
            Motion::Hold | Motion::Wait { .. } => from,
            Motion::Move { shape, to_um } => {
                let share = if segment.duration_s > 0.0 {
                    t / segment.duration_s
                } else {
                    1.0
                };
                from + (to_um - from) * progress(shape, share)
            }
            Motion::Wave {
                shape,
                amplitude_um,
                frequency_hz,
                ramp_in,
                ramp_out,
            } => {
                let phase = t * frequency_hz;
                let left = (segment.duration_s - t) * frequency_hz;
                from + amplitude_um
                    * rise(phase, ramp_in)
                    * rise(left, ramp_out)
                    * wave(shape, phase)
            }
            Motion::Points {
                first,
                count,
                period_s,
            } => {
                let within = if t >= segment.duration_s {
                    0.0
                } else {
                    t % period_s
                };
                from + self.points_um(first, count, within)
            }
        }
    }

    /// A waveform at a time within its cycle, um from where it starts. Allocates nothing.
    fn points_um(&self, first: usize, count: usize, within_s: f64) -> f64 {
        let points = self.points.get(first..first + count).unwrap_or(&[]);
        let next = points.partition_point(|(time, _)| *time <= within_s);
        let before = next.checked_sub(1).and_then(|index| points.get(index));
        match (before, points.get(next)) {
            (Some((t0, x0)), Some((t1, x1))) => x0 + (x1 - x0) * (within_s - t0) / (t1 - t0),
            (Some((_, x)), None) | (None, Some((_, x))) => *x,
            (None, None) => 0.0,
        }
    }
}

impl Reference for Plan {
    /// The reference at a time of the plan, um: held before the start and after the end. Allocates nothing.
    fn at_um(&self, time_s: f64) -> f64 {
        match self.segment_at(time_s) {
            Some(segment) if time_s >= 0.0 => self.segment_um(segment, time_s),
            _ => self.start_um,
        }
    }

    fn duration_s(&self) -> Option<f64> {
        Some(self.duration_s)
    }
}
