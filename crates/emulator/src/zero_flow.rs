//! The zero flow, that is the displacement at which the flow is zero, and its changes.
//!
//! A syringe, its tubes and the levels of the reservoirs are never quite still, so the zero flow wanders about its mean
//! (Ornstein-Uhlenbeck) and drifts. A tap on the syringe makes it step.

use crate::config::WorldConfig;
use crate::imperfections::Wander;
use cellpos_numeric::Random;

/// Distance of the zero flow from [`WorldConfig::neutral_um`], um.
#[derive(Debug, Clone)]
pub(crate) struct ZeroFlow {
    wander: Wander,
    drift_um_per_s: f64,
    step_um: f64,
    drifted_um: f64,
}

impl ZeroFlow {
    /// Starts at its mean; only the wandering part starts in its stationary distribution.
    pub(crate) fn new(config: &WorldConfig) -> Self {
        let it = config.imperfections();
        let noise = Random::stream(config.seed, 31);
        Self {
            wander: Wander::new(it.zero_flow_wander_um, it.zero_flow_wander_time_s, noise),
            drift_um_per_s: it.zero_flow_drift_um_per_s,
            step_um: config.faults.flow_step_um,
            drifted_um: 0.0,
        }
    }

    /// Moves on by `dt_s`. Returns the distance from the mean now, um.
    pub(crate) fn advance(&mut self, dt_s: f64, stepped: bool) -> f64 {
        self.drifted_um += self.drift_um_per_s * dt_s;
        self.wander.advance(dt_s) + self.drifted_um + if stepped { self.step_um } else { 0.0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wandering() -> WorldConfig {
        WorldConfig {
            zero_flow_wander_um: Some(0.006),
            zero_flow_wander_time_s: Some(2.0),
            zero_flow_drift_um_per_s: Some(0.001),
            ..WorldConfig::default()
        }
    }

    #[test]
    fn the_zero_flow_wanders_as_far_and_as_fast_as_it_is_told_to() {
        let config = WorldConfig {
            zero_flow_drift_um_per_s: Some(0.0),
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
            zero_flow_wander_um: Some(0.0),
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
