//! How fast the zero flow walks: the walk whose filter predicts the bead best.
//!
//! What moves the bead beyond the commands is Brownian motion and a zero flow that walks. Of the filters for that, the one with the right
//! walk leaves the least mean square of its prediction errors, whatever their scale. One filter for each of some walks runs beside the
//! others. The likelihood of a walk is that mean square to the power of `-n/2`, for the `n` fixes of the memory. A flow that forgets
//! itself within some time (Ornstein-Uhlenbeck) is a walk to a filter that follows it within less.

use super::evidence::{FAR, MEMORY_FIXES, part};
use super::whiten::{Correction, Covariance, Track, Whitener};
use crate::error::BuildError;
use crate::estimator::{EstimatorConfig, Fix};
use crate::loop_model::LoopModel;

/// Walks that are compared, from the design's to the largest, by equal factors. A walk that is wrong by a factor of two costs 1 % of
/// the hold.
const WALKS: usize = 5;
/// Least of them, um/sqrt(s): what is slower costs the hold nothing.
const LEAST: f64 = 0.01;
/// Largest rate at which the filter follows the zero flow, times the delay. The sensitivity then peaks below 2, and a faster filter would
/// take that margin too.
const FASTEST: f64 = 0.4;

/// The filters.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct ZeroFlow {
    /// Squares of the walks, um^2/s of PZT displacement.
    walks_um2_per_s: [f64; WALKS],
    filters: [Whitener; WALKS],
}

/// What they know.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct ZeroFlowState {
    /// The disturbance in the filter of all series.
    disturbed: Track,
    tracks: [Track; WALKS],
    covariances: [Covariance; WALKS],
    /// Mean square of each filter's prediction errors, um^2, and the fixes that it is from.
    errors_um2: [f64; WALKS],
    fixes: f64,
    /// By how much the square of the walk is above the design's, um^2/s.
    pub beyond_um2_per_s: f64,
}

impl ZeroFlow {
    /// For the noise and the plant of a design.
    ///
    /// # Errors
    /// As [`Whitener::new`].
    pub(super) fn new(config: &EstimatorConfig, model: &LoopModel) -> Result<Self, BuildError> {
        let ts = model.sample_time_s;
        let walk_um2_per_s = 2.0 * config.diffusion_um2_per_s;
        let gain_per_s = model.gain_per_s.abs();
        let design = config.neutral_walk_um_per_sqrt_s.max(LEAST);
        // The filter follows the zero flow at the rate at which its walk moves the bead as far as the Brownian motion does.
        let rate_per_s = FASTEST / (model.delay_s + 0.5 * ts);
        let largest = (rate_per_s * walk_um2_per_s.sqrt() / gain_per_s).max(design);
        let factor = (largest / design).powf(1.0 / (WALKS - 1) as f64);
        let walks: [f64; WALKS] = std::array::from_fn(|k| design * factor.powi(k as i32));
        let filter = |walk: f64| {
            Whitener::new(
                walk_um2_per_s * ts,
                (walk * gain_per_s * ts).powi(2) * ts,
                config.fix_noise_um.powi(2),
                config.ticks_per_fix,
            )
        };
        let mut filters = [filter(design)?; WALKS];
        for (one, walk) in filters.iter_mut().zip(walks).skip(1) {
            *one = filter(walk)?;
        }
        Ok(Self {
            walks_um2_per_s: walks.map(|walk| walk * walk),
            filters,
        })
    }

    /// The filter for the walk of the design.
    pub(super) fn of_design(&self) -> Whitener {
        self.filters[0]
    }

    /// Nothing known.
    pub(super) fn start(&self) -> ZeroFlowState {
        ZeroFlowState {
            disturbed: Track::default(),
            tracks: [Track::default(); WALKS],
            covariances: self.filters.map(|filter| filter.settled()),
            errors_um2: self.filters.map(|filter| filter.noise_um2),
            fixes: 0.0,
            beyond_um2_per_s: 0.0,
        }
    }

    /// The series begin anew: where the bead is now is where it is.
    pub(super) fn begin(&self, state: &mut ZeroFlowState) {
        state.disturbed = Track::default();
        state.tracks = [Track::default(); WALKS];
        state.covariances = self.filters.map(|filter| filter.settled());
    }

    /// A fix whose disturbance leaves this innovation in the filter of all series, with the correction there. If it `tells` nothing of the
    /// zero flow, the filters follow it only.
    pub(super) fn learn(
        &self,
        state: &mut ZeroFlowState,
        correction: &Correction,
        innovation_um: f64,
        fix: &Fix,
        tells: bool,
    ) {
        let at_um = innovation_um - correction.innovation(&state.disturbed, 0.0);
        correction.step(&mut state.disturbed, innovation_um);
        let mut errors_um2 = state.errors_um2;
        let part = part(state.fixes + 1.0, MEMORY_FIXES);
        for (k, filter) in self.filters.iter().enumerate() {
            let own = filter.correction(
                state.covariances[k],
                correction.ticks,
                fix.variance_um2,
                filter.noise_um2,
            );
            state.covariances[k] = own.after;
            let error_um = own.innovation(&state.tracks[k], at_um);
            own.step(&mut state.tracks[k], error_um);
            let square = (own.weight * error_um).powi(2);
            let far = (square / (FAR * FAR * errors_um2[k])).sqrt().max(1.0);
            errors_um2[k] += part * (square / far - errors_um2[k]);
        }
        if tells {
            state.errors_um2 = errors_um2;
            state.fixes = (state.fixes + 1.0).min(MEMORY_FIXES);
            state.beyond_um2_per_s = self.beyond_um2_per_s(state);
        }
    }

    /// The walk, um/sqrt(s), if it is at least twice the design's.
    pub(super) fn faster(&self, state: &ZeroFlowState) -> Option<f64> {
        let [design, ..] = self.walks_um2_per_s;
        let walk_um2_per_s = design + state.beyond_um2_per_s;
        (walk_um2_per_s >= 4.0 * design).then(|| walk_um2_per_s.sqrt())
    }

    /// By how much the square of the likeliest walk is above the design's, um^2/s: the mean of the walks on a logarithmic scale.
    fn beyond_um2_per_s(&self, state: &ZeroFlowState) -> f64 {
        let least = state
            .errors_um2
            .iter()
            .copied()
            .fold(f64::INFINITY, f64::min);
        let (mut sum, mut all) = (0.0, 0.0);
        for (error, walk) in state.errors_um2.iter().zip(&self.walks_um2_per_s) {
            let likelihood = (error / least).powf(-0.5 * state.fixes);
            sum += likelihood * walk.ln();
            all += likelihood;
        }
        ((sum / all).exp() - self.walks_um2_per_s[0]).max(0.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::controller::ControllerConfig;
    use crate::design::{DesignPlant, margins};
    use crate::lqg::Lqg;
    use cellpos_numeric::Random;

    #[test]
    fn a_walk_is_found_within_a_factor_of_two_and_the_design_s_is_no_other() {
        let (config, model) = (EstimatorConfig::default(), LoopModel::eq6(2e-3));
        let zero_flow = ZeroFlow::new(&config, &model).unwrap();
        let ts = model.sample_time_s;
        let [least, .., most] = zero_flow.walks_um2_per_s;
        let fix_um2 = config.fix_noise_um.powi(2);
        for walk_um2_per_s in [0.0, least, 16.0 * least, 0.5 * most] {
            let mut random = Random::new(7);
            let mut state = zero_flow.start();
            let filter = zero_flow.filters[0];
            let (mut at, mut drift, mut seen) = (0.0, 0.0, Track::default());
            for _ in 0..6_000 {
                drift += (walk_um2_per_s * ts).sqrt() * model.gain_per_s * ts * random.normal();
                at += drift + (2.0 * config.diffusion_um2_per_s * ts).sqrt() * random.normal();
                let fix = Fix {
                    position_um: at + config.fix_noise_um * random.normal(),
                    variance_um2: fix_um2,
                    age: 0,
                    offset: 0.0,
                };
                let correction = filter.correction(filter.settled(), 1.0, fix_um2, 0.0);
                let innovation = correction.innovation(&seen, fix.position_um);
                correction.step(&mut seen, innovation);
                zero_flow.learn(&mut state, &correction, innovation, &fix, true);
            }
            let found = least + state.beyond_um2_per_s;
            let factor = (found / walk_um2_per_s.max(least)).sqrt();
            assert!((0.5..2.0).contains(&factor), "{walk_um2_per_s}: {found}");
        }
    }

    #[test]
    fn the_fastest_filter_leaves_the_loop_its_margins() {
        for fix_noise_um in [0.0006, 0.02, 0.06] {
            let model = LoopModel::eq6(2e-3);
            let config = EstimatorConfig {
                fix_noise_um,
                ..EstimatorConfig::default()
            };
            let zero_flow = ZeroFlow::new(&config, &model).unwrap();
            let [.., most] = zero_flow.walks_um2_per_s;
            let config = EstimatorConfig {
                neutral_walk_um_per_sqrt_s: most.sqrt(),
                ..config
            };
            let law = ControllerConfig::Lqg(Lqg::default())
                .linear(&config, &model)
                .unwrap();
            let margins = margins(&DesignPlant::eq6(2.5e-3), &law).unwrap();
            assert!(margins.stable && margins.ms < 2.0, "{margins:?}");
        }
    }
}
