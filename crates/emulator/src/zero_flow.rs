//! The zero flow: the displacement at which the flow stands still, and how it moves.
//!
//! A syringe, its tubes and the heights of the reservoirs never stand still: the zero flow wanders about its mean
//! (Ornstein-Uhlenbeck) and drifts. A tap on the syringe makes it step.

use crate::config::WorldConfig;
use cellpos_numeric::Random;

/// Distance of the zero flow from [`WorldConfig::neutral_um`], um.
#[derive(Debug, Clone)]
pub(crate) struct ZeroFlow {
    wander_um: f64,
    time_s: f64,
    drift_um_per_s: f64,
    step_um: f64,
    wandered_um: f64,
    drifted_um: f64,
    noise: Random,
}

impl ZeroFlow {
    /// At its mean, but for the part that wanders, which starts where it would be after a long time.
    pub fn new(config: &WorldConfig) -> Self {
        let mut noise = Random::stream(config.seed, 30);
        Self {
            wander_um: config.zero_flow_wander_um,
            time_s: config.zero_flow_wander_time_s,
            drift_um_per_s: config.zero_flow_drift_um_per_s,
            step_um: config.faults.flow_step_um,
            wandered_um: config.zero_flow_wander_um * noise.normal(),
            drifted_um: 0.0,
            noise,
        }
    }

    /// Moves on by `dt_s`. Returns the distance from the mean now, um.
    pub fn advance(&mut self, dt_s: f64, stepped: bool) -> f64 {
        self.drifted_um += self.drift_um_per_s * dt_s;
        if self.wander_um > 0.0 {
            // Exact for any step, so that the wandering does not depend on who asks how often.
            let kept = (-dt_s / self.time_s).exp();
            let fresh = (1.0 - kept * kept).sqrt();
            self.wandered_um =
                kept * self.wandered_um + fresh * self.wander_um * self.noise.normal();
        }
        self.wandered_um + self.drifted_um + if stepped { self.step_um } else { 0.0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wandering() -> WorldConfig {
        WorldConfig {
            zero_flow_wander_um: 0.006,
            zero_flow_wander_time_s: 2.0,
            zero_flow_drift_um_per_s: 0.001,
            ..WorldConfig::default()
        }
    }

    #[test]
    fn the_zero_flow_wanders_as_far_and_as_fast_as_it_is_told_to() {
        let config = WorldConfig {
            zero_flow_drift_um_per_s: 0.0,
            ..wandering()
        };
        let mut zero = ZeroFlow::new(&config);
        let lag = 20;
        let path: Vec<f64> = (0..200_000).map(|_| zero.advance(0.1, false)).collect();
        let n = path.len() as f64;
        let variance = path.iter().map(|um| um * um).sum::<f64>() / n;
        let together = path.windows(lag + 1).map(|w| w[0] * w[lag]).sum::<f64>() / n;
        // 20,000 s hold 5,000 independent stretches: 2 % of the variance, five times that allowed.
        assert!((variance.sqrt() / 0.006 - 1.0).abs() < 0.05, "{variance}");
        assert!(
            (together / variance - (-1.0_f64).exp()).abs() < 0.08,
            "{together}"
        );
    }

    #[test]
    fn it_drifts_and_steps() {
        let config = WorldConfig {
            zero_flow_wander_um: 0.0,
            faults: crate::Faults {
                flow_step_um: -0.3,
                ..crate::Faults::default()
            },
            ..wandering()
        };
        let mut zero = ZeroFlow::new(&config);
        assert!((zero.advance(10.0, false) - 0.01).abs() < 1e-12);
        assert!((zero.advance(10.0, true) - (0.02 - 0.3)).abs() < 1e-12);
    }
}
