//! The periodic motions of a plan, on which learning over cycles works.

use super::course::{Course, Periodic};
use super::parts::{Motion, Plan, Segment};
use super::shape::{rise, wave};
use cellpos_control::Reference;

/// A periodic motion about 0 um alone, with a ramp over [`PeriodicReference::FADE_S`].
#[derive(Debug, Clone, Copy)]
pub struct PeriodicReference<'p> {
    plan: &'p Plan,
    motion: Periodic,
}

impl PeriodicReference<'_> {
    /// Time after which it is in full swing, s.
    pub const FADE_S: f64 = 0.2;
}

impl Reference for PeriodicReference<'_> {
    fn at_um(&self, time_s: f64) -> f64 {
        let time_s = time_s.max(0.0);
        let phase = time_s * self.motion.frequency_hz;
        let um = match self.motion.course {
            Course::Wave {
                shape,
                amplitude_um,
            } => amplitude_um * wave(shape, phase),
            Course::Points { first, count } => {
                let within_s = phase.fract() / self.motion.frequency_hz;
                self.plan.points_um(first, count, within_s)
            }
        };
        um * rise(time_s, Self::FADE_S)
    }

    fn duration_s(&self) -> Option<f64> {
        None
    }
}

impl Plan {
    /// The periodic motions, at most [`Periodic::MOST`]; a segment names its own by number.
    pub fn periodic(&self) -> &[Periodic] {
        &self.periodic
    }

    /// A periodic motion alone.
    pub fn periodic_reference(&self, number: usize) -> Option<PeriodicReference<'_>> {
        self.periodic.get(number).map(|motion| PeriodicReference {
            plan: self,
            motion: *motion,
        })
    }

    /// Number of the periodic motion that is in full swing at a time within a segment, and its phase in cycles. Allocates
    /// nothing.
    pub(crate) fn swing(&self, segment: &Segment, time_s: f64) -> Option<(u16, f64)> {
        let number = segment.periodic?;
        let t = time_s - segment.start_s;
        let (frequency_hz, ramp_in, ramp_out) = match segment.motion {
            Motion::Wave {
                frequency_hz,
                ramp_in,
                ramp_out,
                ..
            } => (frequency_hz, ramp_in, ramp_out),
            Motion::Points { period_s, .. } => (1.0 / period_s, 0.0, 0.0),
            Motion::Hold | Motion::Move { .. } | Motion::Wait { .. } => return None,
        };
        let last = segment.duration_s * frequency_hz - ramp_out;
        let phase = t * frequency_hz;
        (ramp_in..last).contains(&phase).then_some((number, phase))
    }
}
