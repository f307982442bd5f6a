//! The mean all round of what a template leaves of a window.

use crate::crop::{Crop, Row, STRIDE};

/// Whole distances from a bead that a window holds.
pub(crate) const RINGS: usize = 2 * STRIDE;

/// Takes the mean over each ring about the centre off what the template leaves: that of a template of another focus or size,
/// which does not move the position.
pub(crate) fn take_off_radial_mean(
    crop: &Crop,
    (x, y): (f32, f32),
    left: &mut [Row],
    sums: &mut [f32; RINGS],
) {
    let place = |i: usize, j: usize| {
        // Neither `hypot` nor `fract`: both are calls of a library.
        let (dx, dy) = (i as f32 - x, j as f32 - y);
        let u = (dx * dx + dy * dy).sqrt();
        let whole = u as usize;
        (whole, u - whole as f32)
    };
    *sums = [0.0; RINGS];
    let mut weights = [0.0_f32; RINGS];
    for (j, row) in left.iter().enumerate().take(crop.height) {
        for (i, v) in row.iter().enumerate().take(crop.width) {
            let (k, t) = place(i, j);
            if k + 1 < RINGS {
                sums[k] += (1.0 - t) * v;
                weights[k] += 1.0 - t;
                sums[k + 1] += t * v;
                weights[k + 1] += t;
            }
        }
    }
    for (sum, weight) in sums.iter_mut().zip(&weights) {
        // A ring of few pixels would take their own noise off.
        *sum = if *weight > 6.0 { *sum / weight } else { 0.0 };
    }
    for (j, row) in left.iter_mut().enumerate().take(crop.height) {
        for (i, v) in row.iter_mut().enumerate().take(crop.width) {
            let (k, t) = place(i, j);
            if k + 1 < RINGS {
                *v -= sums[k] + t * (sums[k + 1] - sums[k]);
            }
        }
    }
}
