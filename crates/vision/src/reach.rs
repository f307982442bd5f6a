//! How far the image of a bead reaches: what is beyond moves no fix.
//!
//! Let t be a part of the picture that the model leaves out, g its derivative by the place, and s the noise of a pixel. The fit goes
//! astray by g.t / g.g, its standard deviation is s / |g|. By the inequality of Cauchy and Schwarz the one is at most |t| / s of the
//! other. So the rest of an image may be left out where the sum of its squares is below the variance of a pixel.

use crate::objects::{Bead, Flat};
use core::f64::consts::PI;

/// Steps in which a profile is looked at.
const STEPS: usize = 64;
/// Variance of the median of normal values over that of their mean, and the median of absolute deviations over the standard deviation.
const OF_MEDIAN: f64 = 0.5 * PI;
const OF_DEVIATIONS: f64 = 0.6745;
/// Share of the rings looked at, from outside, whose mean is a bead's level.
const LEVEL: f64 = 1.0 / 3.0;

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

/// The same for the beads of a recording, whose profile is known as far as it has been learnt: by the median over the beads of
/// the mean grey value of rings of one pixel. With each bead goes its contrast.
pub(crate) fn of_beads<'a>(
    flats: &[Flat],
    beads: impl Iterator<Item = (&'a Bead, f64)>,
    end_px: usize,
    snr: f64,
) -> f64 {
    let mut rings: Vec<Vec<f64>> = vec![Vec::new(); end_px];
    for (bead, contrast) in beads {
        let Some(pixels) = bead.pixels(flats, end_px as f64) else {
            continue;
        };
        let mut means = vec![(0.0, 0.0); end_px];
        for (r_px, grey) in pixels {
            if let Some((sum, n)) = means.get_mut(r_px as usize) {
                *sum += grey;
                *n += 1.0;
            }
        }
        let outer = (end_px as f64 * (1.0 - LEVEL)) as usize;
        let add = |a: (f64, f64), b: &(f64, f64)| (a.0 + b.0, a.1 + b.1);
        let (sum, n) = means.iter().skip(outer).fold((0.0, 0.0), add);
        for (ring, (s, m)) in rings.iter_mut().zip(&means).filter(|(_, (_, m))| *m > 0.0) {
            ring.push((s / m - sum / n.max(1.0)) / contrast);
        }
    }
    let energy = rings.iter_mut().enumerate().map(|(k, values)| {
        let middle = median(values);
        values.iter_mut().for_each(|v| *v = (*v - middle).abs());
        let sd = median(values) / OF_DEVIATIONS;
        let by_noise = OF_MEDIAN * sd * sd / values.len().max(1) as f64;
        2.0 * PI * (k as f64 + 0.5) * snr * snr * (middle * middle - by_noise)
    });
    edge(energy) as f64
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

fn median(values: &mut [f64]) -> f64 {
    values.sort_unstable_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(0.0)
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
