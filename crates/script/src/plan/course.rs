//! A periodic motion of a plan.

use crate::script::WaveShape;
use std::ops::Range;

/// A periodic motion. Steps with the same motion share one, wherever they begin.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Periodic {
    /// Frequency of its cycles, Hz.
    pub frequency_hz: f64,
    /// Its cycles at full amplitude, in the whole plan.
    pub cycles: u64,
    pub(super) course: Course,
}

/// The shape of a periodic motion.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Course {
    Wave { shape: WaveShape, amplitude_um: f64 },
    Points { first: usize, count: usize },
}

impl Periodic {
    /// Most motions that a plan distinguishes.
    pub const MOST: usize = 64;

    pub(super) fn wave(shape: WaveShape, amplitude_um: f64, frequency_hz: f64) -> Self {
        Self {
            frequency_hz,
            cycles: 0,
            course: Course::Wave {
                shape,
                amplitude_um,
            },
        }
    }

    pub(super) fn points(first: usize, count: usize, period_s: f64) -> Self {
        Self {
            frequency_hz: 1.0 / period_s,
            cycles: 0,
            course: Course::Points { first, count },
        }
    }

    /// Harmonics worth learning: only nonlinearities give a sine more than its first.
    pub fn harmonics(&self) -> u32 {
        match self.course {
            Course::Wave {
                shape: WaveShape::Sine,
                ..
            } => 3,
            Course::Wave { .. } | Course::Points { .. } => 8,
        }
    }

    /// Whether two motions are the same.
    pub(super) fn moves_as(&self, other: &Self) -> bool {
        self.course == other.course && self.frequency_hz == other.frequency_hz
    }

    /// Place of a waveform's points in the plan.
    pub(super) fn span(&self) -> Option<Range<usize>> {
        match self.course {
            Course::Points { first, count } => Some(first..first + count),
            Course::Wave { .. } => None,
        }
    }

    /// In words; the same motion has the same name in every run of a script.
    pub fn name(&self) -> String {
        let frequency_hz = self.frequency_hz;
        match self.course {
            Course::Wave {
                shape,
                amplitude_um,
            } => format!("{} of {amplitude_um} um at {frequency_hz} Hz", shape.name()),
            Course::Points { first, count } => {
                format!("waveform of {count} points (from {first}) at {frequency_hz} Hz")
            }
        }
    }
}
