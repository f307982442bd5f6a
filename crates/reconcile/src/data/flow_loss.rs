//! The loss of a slow flow in the chip.
//!
//! A zero flow that enters ahead of the chip passes through it as the command does. A leak lets all of it go in time, a wall that relaxes lets
//! a part of it go. A noise model without this loss takes the filtered zero flow for a part of another effect.

use cellpos_plant::Effect;
use cellpos_plant::effects::{Action, Place};
use nalgebra::{Matrix2, Matrix3};

/// The loss of a constant flow in the chip, by a first-order response.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct FlowLoss {
    /// Part that is lost in the end: 1 by a leak.
    pub part: f64,
    /// Share of the way to that in a row.
    pub share: f64,
}

impl FlowLoss {
    /// Of the effects in the chip, with rows of `sample_s`; `None` if slow and fast flow pass alike. Of several effects, the one with the
    /// largest loss.
    pub(crate) fn of(effects: &[Effect], sample_s: f64) -> Option<Self> {
        let in_chip = effects
            .iter()
            .filter(|e| e.kind().spec().place == Place::Chip);
        in_chip
            .filter_map(|e| {
                // `(s + z)/(s + p)`. A gain of fast motion is a part of the size of the zero flow.
                let Action::Linear(response) = e.act() else {
                    return None;
                };
                let ([zero], [pole]) = (response.zeros.as_slice(), response.poles.as_slice())
                else {
                    return None;
                };
                let rate = -pole.re;
                (rate > 0.0).then(|| Self {
                    part: 1.0 + zero.re / rate,
                    share: -(-rate * sample_s).exp_m1(),
                })
            })
            .max_by(|a, b| a.part.abs().total_cmp(&b.part.abs()))
    }

    /// Transition from row to row of walk, zero flow (of which `keep` remains), and the low-pass filtered zero flow.
    pub(super) fn step(&self, keep: f64) -> Matrix3<f64> {
        let Self { part, share } = *self;
        Matrix3::new(1.0, 1.0, -part, 0.0, keep, 0.0, 0.0, share, 1.0 - share)
    }

    /// Covariance of the zero flow, of this variance, and of the filtered one, long after the start.
    pub(super) fn at_rest(&self, variance: f64, keep: f64) -> Matrix2<f64> {
        let (b, a) = (self.share, 1.0 - self.share);
        let both = keep * b * variance / (1.0 - keep * a);
        let filtered = (b * b * variance + 2.0 * a * b * both) / (1.0 - a * a);
        Matrix2::new(variance, both, both, filtered)
    }

    /// The transpose of what it does to a flow in rows: from what each row's flow behind it adds to a sum, to what that before it adds.
    pub(super) fn transpose(&self, behind: &mut [f64]) {
        let mut later = 0.0;
        for s in behind.iter_mut().rev() {
            let own = *s;
            *s += self.share * later;
            later = (1.0 - self.share) * later - self.part * own;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_plant::effects::{leak, pdms_relaxation, pdms_relaxation_of_fast_gain};

    #[test]
    fn a_leak_takes_all_and_a_wall_its_strength() {
        let of = |effect| FlowLoss::of(&[effect], 1e-3).expect("a loss");
        let (all, slow) = (of(leak(2.0)), of(pdms_relaxation_of_fast_gain(0.5, 1.0)));
        assert!(
            (all.part - 1.0).abs() < 1e-12 && (all.share - 2e-3).abs() < 3e-6,
            "{all:?}"
        );
        assert!(
            (slow.part - 0.5).abs() < 1e-12 && (slow.share - 2e-3).abs() < 3e-6,
            "{slow:?}"
        );
        assert_eq!(of(pdms_relaxation(0.5, 1.0)), slow);
        assert_eq!(
            FlowLoss::of(&[cellpos_plant::effects::gain_error(0.8)], 1e-3),
            None
        );
    }
}
