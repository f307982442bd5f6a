//! Learning over cycles, next to a loop: one learner for each periodic motion of its reference generator.
//!
//! Not here: how is learned, see [`cellpos_control::learning`].

use cellpos_control::{CycleLearning, Driven, LearnedTable, LearnerState};

/// The learners of a loop. A motion without one is followed without learning.
#[derive(Debug, Clone, Default)]
pub struct Learners {
    all: Vec<Option<CycleLearning>>,
    /// The motion of the last tick.
    motion: u16,
}

impl Learners {
    /// One learner for each motion by its number ([`crate::ReferenceOutput::motion`]).
    pub fn new(all: Vec<Option<CycleLearning>>) -> Self {
        Self { all, motion: 0 }
    }

    /// The addition that each learner has learned.
    pub fn tables(&self) -> Vec<Option<LearnedTable>> {
        let table = |one: &Option<CycleLearning>| one.as_ref().map(CycleLearning::table);
        self.all.iter().map(table).collect()
    }

    /// The learner of the motion of the last tick, as it stands now. Allocates nothing.
    pub fn current(&self) -> Option<(u16, LearnerState)> {
        let learning = self.all.get(usize::from(self.motion))?.as_ref()?;
        Some((self.motion, learning.state()))
    }

    fn active(&mut self) -> Option<&mut CycleLearning> {
        self.all.get_mut(usize::from(self.motion))?.as_mut()
    }

    /// Before the controller's step: the addition to the command, um; see [`CycleLearning::addition_um`].
    pub(crate) fn addition_um(
        &mut self,
        motion: u16,
        phase: Option<f64>,
        reference_um: f64,
    ) -> f64 {
        if motion != self.motion {
            // What the one that is left knows of the last ticks is of no use to it when it comes back.
            if let Some(left) = self.active() {
                left.addition_um(None, reference_um);
                left.learn(None, &Driven::default());
            }
            self.motion = motion;
        }
        self.active()
            .map_or(0.0, |learning| learning.addition_um(phase, reference_um))
    }

    /// Gain that the feed-forward is to be divided by in this tick; see [`CycleLearning::feed_forward_gain`].
    pub(crate) fn feed_forward_gain(&self) -> Option<f64> {
        // An addition is right together with the gain at which it was learned.
        let learning = self.all.get(usize::from(self.motion))?.as_ref()?;
        learning.feed_forward_gain()
    }

    /// After the controller's step: learns from the fix that was used, by what moved the bead.
    pub(crate) fn learn(&mut self, fix: Option<(f64, f64)>, driven: &Driven) {
        if let Some(learning) = self.active() {
            learning.learn(fix, driven);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_control::{HarmonicResponse, LearnConfig, Learner};
    use std::f64::consts::TAU;

    fn learning(frequency_hz: f64) -> CycleLearning {
        let response = HarmonicResponse {
            harmonic: 1,
            re_um_per_um: 1.0,
            im_um_per_um: 0.0,
            relative_uncertainty: 0.1,
        };
        let learner =
            Learner::new(LearnConfig::default(), frequency_hz, 1e-3, &[response]).unwrap();
        let state = learner.start();
        CycleLearning::new(learner, state)
    }

    /// A second of a motion whose bead answers the addition at once: error = sin + addition.
    fn follow(learners: &mut Learners, motion: u16, frequency_hz: f64) -> f64 {
        let mut last = 0.0;
        for k in 0..1000 {
            let phase = f64::from(k) * 1e-3 * frequency_hz;
            let addition = learners.addition_um(motion, Some(phase), 0.0);
            let error: f64 = (TAU * phase).sin() + addition;
            learners.learn(Some((error, 0.0)), &Driven::default());
            if k >= 900 {
                last += error * error / 100.0;
            }
        }
        last.sqrt()
    }

    #[test]
    fn each_motion_has_its_own_learner_and_keeps_what_it_knew_while_another_runs() {
        let mut learners = Learners::new(vec![Some(learning(10.0)), None, Some(learning(20.0))]);
        for _ in 0..3 {
            follow(&mut learners, 0, 10.0);
        }
        let known = learners.tables();
        let unlearned = follow(&mut learners, 1, 10.0);
        assert!((unlearned - 0.5f64.sqrt()).abs() < 1e-3, "{unlearned}");
        assert!(learners.current().is_none());
        follow(&mut learners, 2, 20.0);
        assert_eq!(learners.current().map(|one| one.0), Some(2));
        assert_eq!(learners.tables()[0], known[0], "left alone meanwhile");
        assert!(follow(&mut learners, 0, 10.0) < 0.05);
        assert!(learners.tables()[1].is_none());
        assert_eq!(
            Learners::default().addition_um(7, Some(0.2), 1.0),
            0.0,
            "nobody learns"
        );
    }
}
