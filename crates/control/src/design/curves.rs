//! Curves of a design, to be drawn.

use crate::controller::{ControllerConfig, LoopConfig};
use crate::design::plant::DesignPlant;
use crate::design::report::DesignReport;
use crate::design::step::{SetUpError, noise_free};
use crate::linear::LinearLaw;
use cellpos_plant::PlantError;
use nalgebra::Complex;
use std::f64::consts::TAU;

/// Loop gain (real and imaginary part) at each frequency, Hz, below half the sampling rate.
///
/// # Errors
/// A sample time or delay that cannot be discretised.
pub fn loop_response(
    plant: &DesignPlant,
    law: &LinearLaw,
    hz: &[f64],
) -> Result<Vec<[f64; 2]>, PlantError> {
    let measured = plant.measured()?;
    let gain = |hz: &f64| {
        let z = Complex::from_polar(1.0, TAU * hz * plant.sample_time_s);
        let l = law.at(z) * measured.at(z);
        [l.re, l.im]
    };
    Ok(hz.iter().map(gain).collect())
}

/// True position, um, at each tick after an unannounced step of the reference: noise-free, through the loop's limits, two thousand
/// ticks.
///
/// # Errors
/// A plant or a loop that cannot be built.
pub fn step_response(
    plant: &DesignPlant,
    config: &LoopConfig,
    size_um: f64,
) -> Result<Vec<f64>, SetUpError> {
    noise_free(plant, config, 2000, 0.0, |_| size_um).map(|run| run.position_um)
}

impl DesignReport {
    /// The controller's linear law on its plant; `None` where the running loop cannot hold the plant.
    pub fn law(&self, plant: &DesignPlant) -> Option<LinearLaw> {
        match self.controller {
            ControllerConfig::Pi(pi) => Some(LinearLaw::Pi {
                pi,
                sample_time_s: plant.sample_time_s,
            }),
            other => {
                let config = self.config.as_ref()?;
                other
                    .linear(&config.estimator, &plant.loop_model().ok()?)
                    .ok()
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::design::margins;
    use crate::pi::Pi;

    #[test]
    fn the_curve_passes_minus_one_at_the_distance_that_the_margins_say() {
        let plant = DesignPlant::eq6(2.5e-3);
        let law = LinearLaw::Pi {
            pi: Pi::new(0.46, 19.5),
            sample_time_s: plant.sample_time_s,
        };
        let hz: Vec<f64> = (1..50_000).map(|k| f64::from(k) * 0.01).collect();
        let curve = loop_response(&plant, &law, &hz).unwrap();
        let closest = curve
            .iter()
            .map(|[re, im]| (re + 1.0).hypot(*im))
            .fold(9.0, f64::min);
        let known = margins(&plant, &law).unwrap();
        assert!(
            (closest * known.ms - 1.0).abs() < 1e-3,
            "{closest} {}",
            known.ms
        );
    }
}
