//! Whether something holds the bead, and how fast it may move while that is so and just after.

use super::{Estimator, EstimatorState};

/// Speed granted in these ticks, over that of a stuck bead.
const RELEASED_SPEED: f64 = 2.0;

impl Estimator {
    /// Sum of the logarithms of the odds that the bead does not move against that it moves half as far as predicted, never
    /// below 0. A gain of a quarter is the watershed: a bead twice as slow as the model is not taken for stuck. Nothing is
    /// forgotten, for a bead held near its target, where next to no motion is predicted, lets neutral run away slowly,
    /// and that takes as long to show. A bead that has moved, if only by its Brownian motion, is not stuck: that ends
    /// the verdict at once.
    pub(super) fn weigh_stuck(
        &self,
        state: &mut EstimatorState,
        innovation_um: f64,
        motion_um: f64,
        variance_um2: f64,
    ) {
        let still_um = if state.stuck {
            innovation_um
        } else {
            innovation_um + motion_um
        };
        let walk_um2 = 2.0 * self.config.diffusion_um2_per_s * self.model.sample_time_s;
        let noise_um2 = walk_um2 + 2.0 * variance_um2;
        let moved = still_um * still_um
            > if state.stuck {
                25.0 * variance_um2
            } else {
                9.0 * noise_um2
            };
        if state.stuck && moved {
            state.stuck_evidence = 0.0;
            state.stuck = false;
            return;
        }
        // One fix decides little: an outlier or a jolt must not make a verdict. But nothing that is held moves, however
        // badly the motion fits the prediction: an unknown lag turns a fast motion to and fro about.
        const MOST: f64 = 2.0;
        let odds = if moved {
            -MOST
        } else {
            let odds = motion_um * (0.25 * motion_um - still_um) / (2.0 * noise_um2);
            odds.clamp(-MOST, MOST)
        };
        state.stuck_evidence = (state.stuck_evidence + odds).clamp(0.0, 25.0);
        state.stuck = state.stuck_evidence > if state.stuck { 3.0 } else { 12.0 };
    }

    /// Largest distance of the command from neutral that keeps to the speed granted, um.
    pub(super) fn authority_um(&self, state: &EstimatorState) -> f64 {
        let granted_um = self.config.stuck_speed_um_per_tick;
        let speed_um = match (state.stuck, state.released_ticks) {
            (true, _) => granted_um,
            (false, 1..) => RELEASED_SPEED * granted_um,
            (false, 0) => return f64::INFINITY,
        };
        speed_um / self.tick.gain.abs().max(1e-12)
    }
}
