//! How well the present position is known, and a zero flow that is believed instead of the estimate.

use super::{Estimator, EstimatorState, HISTORY};

impl Estimator {
    /// Standard deviation of the position `back` ticks after the filter's time: what is not known of the bead and of neutral then, and
    /// both their walks since, um.
    pub(super) fn present_sd_um(&self, state: &EstimatorState, back: usize) -> f64 {
        let [mut p11, mut p12, mut p22] = state.covariance_um2;
        if state.stuck {
            return p11.max(0.0).sqrt();
        }
        let (g, ts) = (self.tick.gain, self.model.sample_time_s);
        let walk_um2 = 2.0 * self.config.diffusion_um2_per_s * ts + state.spread_um2;
        let neutral_walk_um2 = self.config.neutral_walk_um_per_sqrt_s.powi(2) * ts;
        for _ in 0..back {
            p11 += g * (g * p22 - 2.0 * p12) + walk_um2;
            p12 -= g * p22;
            p22 += neutral_walk_um2;
        }
        p11.max(0.0).sqrt()
    }

    /// Believes this zero flow, and that the PZT has been there since the newest fix.
    pub(crate) fn rest_at(&self, state: &mut EstimatorState, neutral_um: f64) {
        state.neutral_um = neutral_um;
        state.history_um = [neutral_um; HISTORY];
        state.modes = Default::default();
        state.covariance_um2[1] = 0.0;
    }
}
