//! What a wrong gain may cause, how well the present position is known, and a zero flow that is believed instead of the estimate.

use super::covariance::{ZERO_FLOW_WALK_UM_PER_SQRT_S, advanced};
use super::{Estimator, EstimatorState, HISTORY};

/// Uncertainty of neutral after a bead came free, um: it may have drifted meanwhile, or the verdict may have been
/// wrong because neutral was.
const RELEASED_NEUTRAL_UM: f64 = 0.5;

impl EstimatorState {
    /// Neutral may be anywhere near.
    pub(super) fn doubt_neutral(&mut self) {
        for covariance_um2 in [&mut self.covariance_um2, &mut self.stated_um2] {
            covariance_um2[2] = covariance_um2[2].max(RELEASED_NEUTRAL_UM * RELEASED_NEUTRAL_UM);
        }
    }
}

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
        let mut stated_um2 = state.stated_um2;
        if state.stuck {
            return stated_um2[0].max(0.0).sqrt();
        }
        let (g, ts) = (self.tick.gain, self.model.sample_time_s);
        let walk_um2 = 2.0 * self.config.diffusion_um2_per_s * ts + state.spread_um2;
        let walk_um2_per_s = ZERO_FLOW_WALK_UM_PER_SQRT_S.powi(2) + state.beyond_walk_um2_per_s;
        let flow_um2 = walk_um2_per_s * ts;
        for _ in 0..back {
            stated_um2 = advanced(stated_um2, g, walk_um2, flow_um2);
        }
        stated_um2[0].max(0.0).sqrt()
    }

    /// Believes this zero flow, known with this variance, and that the PZT has been there since the newest fix.
    pub(crate) fn rest_at(&self, state: &mut EstimatorState, neutral_um: f64, variance_um2: f64) {
        state.neutral_um = neutral_um;
        state.stated_um2[2] = variance_um2;
        state.history_um = [neutral_um; HISTORY];
        state.modes = Default::default();
        (state.covariance_um2[1], state.stated_um2[1]) = (0.0, 0.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimator::{EstimatorConfig, Fix};
    use crate::loop_model::LoopModel;

    /// Square of the error over the stated variance, of a bead that is held for 2.5 s and not seen for 0.5 s.
    fn squared(seed: u64) -> f64 {
        let mut random = cellpos_numeric::Random::new(seed);
        let (gain, dt) = (380.0, 1e-3);
        let config = EstimatorConfig::default();
        let estimator = Estimator::new(config, LoopModel::integrator(gain, 2e-3)).unwrap();
        let mut state = estimator.start(20.0, 20.0);
        let (mut bead_um, mut zero_um, mut command_um) = (0.0, 20.0, 20.0);
        let mut path = [0.0; 3];
        for k in 0..3000 {
            path = [bead_um, path[0], path[1]];
            let fix = Fix {
                position_um: path[2] + 0.015 * random.normal(),
                variance_um2: 0.015 * 0.015,
                age: 0,
                offset: 0.0,
            };
            let estimate = estimator.step(&mut state, (k < 2500).then_some(fix));
            if k == 2999 {
                let off_um: f64 = estimate.position_um - bead_um;
                return (off_um / estimate.position_sd_um).powi(2);
            }
            command_um = if k < 2500 {
                estimate.neutral_um - 0.4 * estimate.position_um
            } else {
                estimate.neutral_um
            };
            estimator.push(&mut state, command_um);
            bead_um += gain * dt * (command_um - zero_um)
                + (2.0 * config.diffusion_um2_per_s * dt).sqrt() * random.normal();
            zero_um += ZERO_FLOW_WALK_UM_PER_SQRT_S * dt.sqrt() * random.normal();
        }
        unreachable!("the last tick returns from {command_um} um")
    }

    #[test]
    fn the_stated_uncertainty_of_a_bead_that_is_not_seen_is_its_error() {
        let runs = 400_u32;
        let mean = (1..=u64::from(runs)).map(squared).sum::<f64>() / f64::from(runs);
        // The mean of so many squares is within 3 standard errors, sqrt(2 / 400) each.
        assert!((mean - 1.0).abs() < 0.21, "{mean}");
    }
}
