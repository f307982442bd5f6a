//! How far the image of a bead reaches: what is beyond moves no fix.
//!
//! Let t be a part of the picture that the model leaves out, g its derivative by the place, and s the noise of a pixel. The fit goes
//! astray by g.t / g.g, its standard deviation is s / |g|. By the inequality of Cauchy and Schwarz the one is at most |t| / s of the
//! other. So the rest of an image may be left out where the sum of its squares is below the variance of a pixel.

use core::f64::consts::PI;

/// Steps in which a profile is looked at.
const STEPS: usize = 64;

/// Distance from its centre beyond which the image of a bead of a contrast over the noise of a pixel may be left out, px. `profile`
/// is 1 at its extreme and 0 beyond `end_px`.
pub(crate) fn extent_px(profile: impl Fn(f64) -> f64, end_px: f64, snr: f64) -> f64 {
    let step_px = end_px / STEPS as f64;
    let ring = |k: usize| {
        let r_px = (k as f64 + 0.5) * step_px;
        2.0 * PI * r_px * step_px * (profile(r_px) * snr).powi(2)
    };
    edge((0..STEPS).map(ring)) as f64 * step_px
}

/// First ring from which on the sum is below 1.
fn edge(rings: impl DoubleEndedIterator<Item = f64> + ExactSizeIterator) -> usize {
    let mut beyond = 0.0;
    let count = rings.len();
    let inside = rings.rev().position(|ring| {
        beyond += ring;
        beyond > 1.0
    });
    inside.map_or(0, |k| count - k)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rest_of_a_gaussian_has_the_energy_of_one_pixels_noise() {
        // Integral of 2 pi r exp(-r^2/s^2) beyond R is pi s^2 exp(-R^2/s^2).
        let (sigma_px, snr) = (2.0_f64, 40.0_f64);
        let found = extent_px(
            |r| (-0.5 * (r / sigma_px).powi(2)).exp(),
            5.0 * sigma_px,
            snr,
        );
        let expected = sigma_px * (PI * sigma_px * sigma_px * snr * snr).ln().sqrt();
        assert!((found - expected).abs() < 0.2, "{found} {expected}");
    }
}
