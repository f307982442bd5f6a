//! Predicted spectrum of the measured error while holding.

use crate::design::plant::DesignPlant;
use crate::linear::LinearLaw;
use cellpos_plant::PlantError;
use nalgebra::Complex;
use std::f64::consts::TAU;

/// Amplitude spectral density (um/sqrt(Hz), one-sided) of the measured position about a target at rest, at each frequency below
/// half the sampling rate: `|S|` times the densities of Brownian motion (steps of variance `2 D Ts`) and of the fixes' noise. The
/// camera's delay changes the phase of the walk, not its density. The loop has to be stable.
///
/// # Errors
/// A sample time or delay that cannot be discretised.
pub fn predicted_density_um(
    plant: &DesignPlant,
    law: &LinearLaw,
    hz: &[f64],
) -> Result<Vec<f64>, PlantError> {
    let (measured, sample_s) = (plant.measured()?, plant.sample_time_s);
    let step_um2 = 2.0 * plant.diffusion_um2_per_s * sample_s;
    let density = |hz: &f64| {
        let z = Complex::from_polar(1.0, TAU * hz * sample_s);
        let walk_um2 = step_um2 / (Complex::new(1.0, 0.0) - z.inv()).norm_sqr();
        let white_um2 = plant.fix_noise_um * plant.fix_noise_um;
        let s = (law.at(z) * measured.at(z) + 1.0).inv().norm();
        s * (2.0 * sample_s * (walk_um2 + white_um2)).sqrt()
    };
    Ok(hz.iter().map(density).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::design::noise_figures;
    use crate::pi::Pi;

    #[test]
    fn the_density_integrates_to_the_error_that_the_impulse_responses_give() {
        let mut plant = DesignPlant::eq6(2.5e-3);
        let law = LinearLaw::Pi {
            pi: Pi::new(0.46, 19.5),
            sample_time_s: plant.sample_time_s,
        };
        // Without noise of the fixes the measured position is the true one, a delay later: both have the same variance.
        plant.fix_noise_um = 0.0;
        let hz: Vec<f64> = (0..49_999).map(|k| 0.005 + 0.01 * f64::from(k)).collect();
        let density = predicted_density_um(&plant, &law, &hz).unwrap();
        let variance: f64 = density.iter().map(|d| d * d * 0.01).sum();
        let known = noise_figures(&plant, &law).unwrap().unwrap();
        let ratio = variance.sqrt() / known.rms_um;
        assert!((ratio - 1.0).abs() < 0.01, "{ratio}");
    }
}
