//! The mean that a fix shows of a path that bends during the exposure.

use super::{Estimator, EstimatorState};

impl Estimator {
    /// Mean over an exposure less the position at its middle, um. The middle is `fraction` of a tick after the time at which the
    /// command `back` ticks ago took effect.
    pub(super) fn exposed_um(&self, state: &EstimatorState, fraction: f64, back: usize) -> f64 {
        let half = self.half_exposure();
        if state.stuck || half <= 0.0 {
            return 0.0;
        }
        // Every command that took effect while the frame was exposed.
        let reach = (half + 1.0) as usize;
        let first = back.saturating_sub(reach).max(1);
        (first..=back + reach)
            .map(|ago| {
                let bend_um = Self::command(state, ago) - Self::command(state, ago + 1);
                self.bent_um(fraction + ago as f64 - back as f64, bend_um)
            })
            .sum()
    }

    fn half_exposure(&self) -> f64 {
        0.5e-3 * self.config.exposure_ms / self.model.sample_time_s
    }

    /// Mean over an exposure of what a change of the command by `bend_um` does to the path, less what it has done at the
    /// middle, um. The change takes effect `after` ticks before the middle.
    fn bent_um(&self, after: f64, bend_um: f64) -> f64 {
        let half = self.half_exposure();
        if half <= after.abs() {
            return 0.0;
        }
        // (t + after)+ and the step there, in the mean over -half..half, less their values at 0.
        let (ramp, step) = (
            (half + after).powi(2) / (4.0 * half),
            (half + after) / (2.0 * half),
        );
        let (ramp_now, step_now) = (after.max(0.0), if after > 0.0 { 1.0 } else { 0.0 });
        let gain = self.model.fast_gain_per_s() * self.model.sample_time_s;
        bend_um * (gain * (ramp - ramp_now) + self.model.feedthrough * (step - step_now))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimator::EstimatorConfig;
    use crate::loop_model::LoopModel;

    #[test]
    fn a_bend_within_an_exposure_shows_as_the_mean_of_the_path_over_it() {
        let model = LoopModel::eq6(2e-3);
        for exposure_ms in [0.0, 0.2, 0.5, 1.0] {
            let config = EstimatorConfig {
                exposure_ms,
                ..EstimatorConfig::default()
            };
            let estimator = Estimator::new(config, model).unwrap();
            for after in [-0.6, -0.1, 0.0, 0.2, 0.45] {
                // The path of eq6 after a step of 2 um, without its slow pole: a jump and a ramp.
                let path = |t: f64| {
                    if t + after > 0.0 {
                        2.0 * (0.01872 + model.fast_gain_per_s() * 1e-3 * (t + after))
                    } else {
                        0.0
                    }
                };
                let points = 100_000;
                let mean: f64 = (0..points)
                    .map(|i| (f64::from(i) + 0.5) / f64::from(points) - 0.5)
                    .map(|x| path(x * exposure_ms))
                    .sum::<f64>()
                    / f64::from(points);
                let found = estimator.bent_um(after, 2.0);
                let expected = mean - path(0.0);
                assert!(
                    (found - expected).abs() < 1e-5,
                    "{exposure_ms} ms, {after} ticks: {found} against {expected}"
                );
            }
        }
    }
}
