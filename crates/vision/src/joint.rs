//! Beads whose images overlap, fitted together.
//!
//! The model is `grey = b + sum_k A_k f(r_k)`. Like the fit of one bead it is linear in the contrasts and the background. A
//! Gauss-Newton pass solves one linear problem with the columns (df/dx, df/dy, f) of each bead and 1. The inverse of the normal
//! matrix is the covariance: overlap makes it larger.

use crate::crop::{Crop, LANES, Row, STRIDE};
use crate::fit::{Image, Weights};
use crate::least_squares::{Sums, four};
use crate::streak::Comb;
use crate::template::Template;
use nalgebra::{Matrix2, SMatrix, SVector};
use wide::f32x4;

/// Most beads fitted together.
pub(crate) const MOST_TOGETHER: usize = 4;

/// One bead of a joint fit.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Bead {
    pub x_px: f64,
    pub y_px: f64,
    pub step_px: (f64, f64),
    /// What is known of its contrast before the fit: mean and standard deviation, grey levels.
    pub contrast: Option<(f64, f64)>,
    pub amplitude: f64,
    /// In the units of the weights.
    pub amplitude_variance: f64,
    /// Covariance of the position in the units of the weights, px^2.
    pub covariance: Matrix2<f64>,
}

/// What a pass found besides the beads.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Rest {
    /// Above the crop's pedestal.
    pub background: f64,
    /// Weighted residual sum of squares after the step.
    pub chi2: f64,
    /// The same before it.
    pub at_rest: f64,
}

/// One pass at the beads' positions; `unit` is the noise variance that a weight of 1 stands for. Fills the beads' steps, contrasts and covariances. `None` if the normal matrix is singular.
pub(crate) fn pass(
    crop: &Crop,
    template: &Template,
    comb: &Comb,
    beads: &mut [Bead],
    (weights, unit): (Weights, f64),
) -> Option<Rest> {
    match beads.len() {
        1 => pass_of::<1, 4>(crop, template, comb, beads, (weights, unit)),
        2 => pass_of::<2, 7>(crop, template, comb, beads, (weights, unit)),
        3 => pass_of::<3, 10>(crop, template, comb, beads, (weights, unit)),
        4 => pass_of::<4, 13>(crop, template, comb, beads, (weights, unit)),
        _ => None,
    }
}

/// `N` beads with `P = 3 N + 1` parameters.
fn pass_of<const N: usize, const P: usize>(
    crop: &Crop,
    template: &Template,
    comb: &Comb,
    beads: &mut [Bead],
    (weights, unit): (Weights, f64),
) -> Option<Rest> {
    let lanes_end = crop.lanes_end();
    let mut images: [Image; N] = std::array::from_fn(|_| Image::new(lanes_end));
    let mut weight = weights.of_even(crop);
    let mut model: Row = [0.0; STRIDE];
    let mut sums = Sums::<P>::new();
    for (j, pixels) in crop.rows.iter().enumerate().take(crop.height) {
        for (image, bead) in images.iter_mut().zip(beads.iter()) {
            let (x, y) = (bead.x_px - crop.x0 as f64, bead.y_px - crop.y0 as f64);
            image.draw_row(template, comb, x as f32, j as f32 - y as f32);
        }
        if let Weights::Shot { .. } = weights {
            model = [0.0; STRIDE];
            for (image, bead) in images.iter().zip(beads.iter()) {
                let amplitude = bead.amplitude as f32;
                for (m, f) in model.iter_mut().zip(&image.value).take(lanes_end) {
                    *m += amplitude * f;
                }
            }
        }
        weights.of_shot(crop, &model[..lanes_end], &mut weight);
        for first in (0..lanes_end).step_by(LANES) {
            let four = |row: &Row| four(row, first);
            let mut columns = [f32x4::ONE; P];
            for (three, image) in columns.chunks_exact_mut(3).zip(&images) {
                three.copy_from_slice(&[four(&image.by_x), four(&image.by_y), four(&image.value)]);
            }
            sums.add(&columns, four(&weight), four(pixels));
        }
    }
    let (mut normal, mut right, mut squares) = sums.equations();
    for (k, bead) in beads.iter().enumerate() {
        if let Some((mean, sd)) = bead.contrast {
            let information = unit / (sd * sd);
            normal[(3 * k + 2, 3 * k + 2)] += information;
            right[3 * k + 2] += information * mean;
            squares += information * mean * mean;
        }
    }
    let at_rest = misfit_at_rest(normal, right, squares)?;
    let inverse = normal.cholesky()?.inverse();
    let solution = inverse * right;
    for (k, bead) in beads.iter_mut().enumerate() {
        let amplitude = solution[3 * k + 2];
        bead.amplitude = amplitude;
        bead.amplitude_variance = inverse[(3 * k + 2, 3 * k + 2)];
        bead.step_px = (solution[3 * k] / amplitude, solution[3 * k + 1] / amplitude);
        bead.covariance = inverse.fixed_view::<2, 2>(3 * k, 3 * k) / (amplitude * amplitude);
    }
    let chi2 = squares - solution.dot(&right);
    let finite = solution.iter().all(|v| v.is_finite()) && chi2.is_finite();
    finite.then_some(Rest {
        background: solution[P - 1],
        chi2,
        at_rest,
    })
}

/// Weighted residual sum of squares at the present places: only contrasts and background are free.
fn misfit_at_rest<const P: usize>(
    mut normal: SMatrix<f64, P, P>,
    mut right: SVector<f64, P>,
    squares: f64,
) -> Option<f64> {
    for i in (0..P - 1).filter(|i| i % 3 != 2) {
        normal.fill_row(i, 0.0);
        normal.fill_column(i, 0.0);
        normal[(i, i)] = 1.0;
        right[i] = 0.0;
    }
    Some(squares - normal.cholesky()?.solve(&right).dot(&right))
}
