//! What a wrong gain may cause, how well the present position is known, and a zero flow that is believed instead of the estimate.

use super::{Estimator, EstimatorState, HISTORY};

/// Ticks over which the fastest motion is looked for.
const FASTEST_TICKS: usize = 6;

impl Estimator {
    /// Root of the mean square per tick that the net motion of the last ticks up to the one `back` ago amounts to, um.
    /// A wrong gain errs in proportion to where the bead went, not to the way it made: motion to and fro, summed tick by
    /// tick as if each erred on its own, would hide neutral and let it drift.
    pub(super) fn net_motion(&self, state: &EstimatorState, back: usize, neutral_um: f64) -> f64 {
        const MOST: usize = 4;
        let first = back.max(1);
        let ticks = MOST.min((HISTORY + 1).saturating_sub(first)).max(1);
        let sum: f64 = (first..first + ticks)
            .map(|ago| self.tick.gain * (Self::command(state, ago) - neutral_um))
            .sum();
        sum / (ticks as f64).sqrt()
    }

    /// The furthest that the model says the bead has gone in one of the last ticks, um.
    pub(super) fn fastest_motion(&self, state: &EstimatorState) -> f64 {
        let motion_um = |command: &f64| (self.tick.gain * (command - state.neutral_um)).abs();
        let newest = state.history_um.iter().take(FASTEST_TICKS);
        newest.map(motion_um).fold(0.0, f64::max)
    }

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
