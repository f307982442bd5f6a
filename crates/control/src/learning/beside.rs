//! A learner attached to a loop: each fix is laid on the reference and the phase at the time of its exposure.

use super::{Driven, LearnedTable, Learner, LearnerState};
use crate::exposure;

/// References of past ticks that a [`CycleLearning`] keeps: the oldest exposure that it can learn from.
const PAST: usize = 24;

/// A learner attached to a loop: it lays each fix on the reference and the phase at the time of its exposure.
#[derive(Debug, Clone, PartialEq)]
pub struct CycleLearning {
    learner: Learner,
    state: LearnerState,
    /// References of the last ticks, newest first, and their number.
    past_um: [f64; PAST],
    /// Jumps of the path at these ticks but the newest: the first is that of the tick before.
    jumps_um: [f64; PAST],
    known: usize,
    phase: f64,
}

impl CycleLearning {
    /// Attaches a learner to a loop, with the state of [`Learner::start`] or [`Learner::resume`].
    pub fn new(learner: Learner, state: LearnerState) -> Self {
        Self {
            learner,
            state,
            past_um: [0.0; PAST],
            jumps_um: [0.0; PAST],
            known: 0,
            phase: 0.0,
        }
    }

    /// What has been learned so far.
    pub fn table(&self) -> LearnedTable {
        self.learner.table(&self.state)
    }

    /// The learner's state.
    pub fn state(&self) -> LearnerState {
        self.state
    }

    /// Before the controller's step: the addition for this tick, um of PZT; see [`crate::LoopInput::learned_um`]. `phase`
    /// is that of the reference in cycles, `None` while it is not periodic.
    pub fn addition_um(&mut self, phase: Option<f64>, reference_um: f64) -> f64 {
        let Some(phase) = phase.filter(|p| p.is_finite()) else {
            self.known = 0;
            return 0.0;
        };
        self.past_um.copy_within(0..PAST - 1, 1);
        self.past_um[0] = reference_um;
        self.known = (self.known + 1).min(PAST);
        self.phase = phase;
        self.learner.addition_um(&self.state, phase)
    }

    /// Gain that the feed-forward is to be divided by in this tick; see [`crate::LoopInput::feed_forward_gain`]. `None` where the
    /// reference is not periodic now.
    pub fn feed_forward_gain(&self) -> Option<f64> {
        self.state.feed_forward_gain().filter(|_| self.known > 0)
    }

    /// After the controller's step: learns from a fix (position um, age of its exposure in ticks) that the controller has used;
    /// `None` without a fix. `driven` is the loop's statement about the tick.
    pub fn learn(&mut self, fix: Option<(f64, f64)>, driven: &Driven) {
        let error = fix.and_then(|(position_um, age_ticks)| {
            let phase = self.phase - age_ticks * self.learner.advance;
            let path_um = |age_ticks| self.past_reference_um(age_ticks);
            let seen_um = exposure::mean(age_ticks, self.learner.exposure_ticks, path_um)?;
            Some((phase, position_um - seen_um))
        });
        self.jumps_um.copy_within(0..PAST - 1, 1);
        self.jumps_um[0] = driven.jump_um;
        let now = (self.phase, driven);
        self.learner.learn(&mut self.state, error, now);
    }

    /// The reference's path at an age in ticks, um.
    fn past_reference_um(&self, age_ticks: f64) -> Option<f64> {
        let newer = age_ticks.max(0.0).floor();
        let part = age_ticks.max(0.0) - newer;
        let newer = newer as usize;
        // Without a part the older neighbour is not needed, nor perhaps known.
        let older = if part < 1e-6 { newer } else { newer + 1 };
        if older >= self.known {
            return None;
        }
        let (a, b) = (self.past_um.get(newer)?, self.past_um.get(older)?);
        Some(a + part * (b + self.jumps_um.get(newer)? - a))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::learning::{HarmonicResponse, LearnConfig};
    use std::f64::consts::TAU;

    #[test]
    fn a_bead_that_is_on_the_reference_at_each_tick_has_nothing_to_learn_whatever_the_exposure() {
        let response = HarmonicResponse {
            harmonic: 1,
            re_um_per_um: 0.1,
            im_um_per_um: -0.2,
            relative_uncertainty: 0.1,
        };
        let reference = |k: i32| 0.5 * (TAU * 0.3 * f64::from(k)).sin();
        let path = |t: f64| {
            let k = t.floor();
            let (a, b) = (reference(k as i32), reference(k as i32 + 1));
            a + (t - k) * (b - a)
        };
        for (exposure_s, age_ticks) in [(0.0, 2.0), (0.5e-3, 2.0), (0.9e-3, 2.3), (2.5e-3, 1.6)] {
            let config = LearnConfig {
                exposure_s,
                ..LearnConfig::default()
            };
            let learner = Learner::new(config, 300.0, 1e-3, &[response]).unwrap();
            let start = learner.start();
            let mut learning = CycleLearning::new(learner, start);
            let mut largest_um = 0.0_f64;
            for k in 0..600 {
                let phase = 0.3 * f64::from(k);
                let added_um = learning.addition_um(Some(phase), reference(k));
                largest_um = largest_um.max(added_um.abs());
                // What a camera sees: the mean over the exposure, here by many points.
                let middle = f64::from(k) - age_ticks;
                let points = 2000;
                let seen_um: f64 = (0..points)
                    .map(|i| (f64::from(i) + 0.5) / f64::from(points) - 0.5)
                    .map(|x| path(middle + x * exposure_s / 1e-3))
                    .sum::<f64>()
                    / f64::from(points);
                learning.learn(Some((seen_um, age_ticks)), &Driven::default());
            }
            assert!(largest_um < 1e-4, "{exposure_s} s: {largest_um} um");
        }
    }
}
