//! How far the image of a bead reaches: what is beyond moves no fix.
//!
//! Let t be a part of the picture that the model leaves out, g its derivative by the place, and s the noise of a pixel. The fit goes
//! astray by g.t / g.g, its standard deviation is s / |g|. By the inequality of Cauchy and Schwarz the one is at most |t| / s of the
//! other. So the rest of an image may be left out where the sum of its squares is below the variance of a pixel.

use crate::fix::Fix;
use crate::objects::Flat;
use crate::template::{Template, span};
use cellpos_numeric::statistics::median;
use core::f64::consts::{PI, TAU};

/// Steps in which a profile is looked at.
const STEPS: usize = 64;
/// Directions whose median is the round part.
const DIRECTIONS: usize = 8;

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

/// As [`extent_px`], of beads in frames: `rest` are the frames without the beads' images.
///
/// An image is round, and its surroundings are not: a wall or a neighbour is on one side. So the round part is the median of the
/// directions about the beads. Each half of the beads has a median. The mean of their product is the square of the round part: noise
/// adds nothing to it. A constant is no part of the image, since each window has a level.
pub(crate) fn round_extent_px(
    rest: &[Flat],
    template: &Template,
    fits: &[(usize, Fix)],
    end_px: f64,
) -> f64 {
    let step_px = end_px / STEPS as f64;
    let mut halves = [0, 1].map(|_| [[(0.0, 0.0); DIRECTIONS]; STEPS]);
    let mut square = 0.0;
    for (k, (frame, fix)) in fits.iter().enumerate() {
        let Some(flat) = rest.get(*frame) else {
            continue;
        };
        square += fix.snr * fix.snr / fits.len() as f64;
        add(&mut halves[k % 2], flat, fix, (end_px, step_px));
    }
    let round = |half: &[[(f64, f64); DIRECTIONS]; STEPS], k: usize| {
        let r_px = (k as f64 + 0.5) * step_px;
        let seen = half[k].iter().filter(|(_, weight)| *weight > 0.0);
        let off: Vec<f64> = seen.map(|(sum, weight)| sum / weight).collect();
        let off = if off.is_empty() { 0.0 } else { median(&off) };
        off + f64::from(template.value_at_squared((r_px * r_px) as f32))
    };
    let [a, b] = &halves;
    // Only the difference from the mean of the rings beyond counts: each window has a level.
    let (mut area, mut of_a, mut of_b, mut of_both) = (0.0, 0.0, 0.0, 0.0);
    let within = (0..STEPS).rev().find(|k| {
        let ring_px2 = TAU * (*k as f64 + 0.5) * step_px * step_px;
        let (a, b) = (round(a, *k), round(b, *k));
        area += ring_px2;
        of_a += ring_px2 * a;
        of_b += ring_px2 * b;
        of_both += ring_px2 * a * b;
        (of_both - of_a * of_b / area) * square > 1.0
    });
    within.map_or(0.0, |k| (k + 1) as f64 * step_px)
}

/// Adds the pixels about a bead, in its contrasts above their median, with the weights that their noise gives them.
fn add(
    half: &mut [[(f64, f64); DIRECTIONS]; STEPS],
    flat: &Flat,
    fix: &Fix,
    (end_px, step_px): (f64, f64),
) {
    let (x0, x1) = span(fix.x_px, end_px, flat.width);
    let (y0, y1) = span(fix.y_px, end_px, flat.height);
    let places = (y0..y1).flat_map(|y| (x0..x1).map(move |x| (x, y)));
    let pixels = places.filter_map(|(x, y)| {
        let (dx, dy) = (x as f64 - fix.x_px, y as f64 - fix.y_px);
        let step = (f64::hypot(dx, dy) / step_px) as usize;
        let turn = dy.atan2(dx) / TAU + 0.5;
        let direction = (turn * DIRECTIONS as f64) as usize % DIRECTIONS;
        let value = f64::from(flat.values[y * flat.width + x]);
        (step < STEPS).then_some((step, direction, value))
    });
    let pixels: Vec<_> = pixels.collect();
    let values: Vec<f64> = pixels.iter().map(|(.., value)| *value).collect();
    let level = median(&values);
    for (step, direction, value) in pixels {
        let (sum, weight) = &mut half[step][direction];
        *sum += fix.amplitude * (value - level);
        *weight += fix.amplitude * fix.amplitude;
    }
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
