//! One Gauss-Newton pass of the radial-template fit over a window.
//!
//! The model `grey = b + A f(r)` is linear in the amplitude `A` and the background `b`, so each pass solves the linear
//! least-squares problem in (A dx, A dy, A, b) with the columns (df/dx0, df/dy0, f, 1): the Gauss-Newton step without
//! a start value for A or b. The 4x4 normal matrix of the last pass is the Fisher information of the same four
//! parameters for normal noise, and its inverse their Cramer-Rao bound.

use crate::crop::{Crop, LANES, Row, STRIDE};
use crate::streak::Comb;
use crate::template::Template;
use nalgebra::{Matrix2, Matrix3, Matrix4, Vector3, Vector4};
use wide::f32x4;

/// Numbers of the first columns of a row.
pub(crate) const FIRST_COLUMNS: f32x4 = f32x4::new([0.0, 1.0, 2.0, 3.0]);

/// How the noise of a pixel depends on its grey level.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Weights {
    /// The same variance everywhere, grey^2.
    Even { variance: f32 },
    /// `base + gain * (amplitude f(r))`, at least `floor`, with the model of the pass before (grey^2).
    Shot {
        base: f32,
        gain_times_amplitude: f32,
        floor: f32,
    },
}

impl Weights {
    /// Weights of a row if they are the same everywhere.
    pub(crate) fn of_even(self, crop: &Crop) -> Row {
        let mut weight = crop.mask;
        if let Weights::Even { variance } = self {
            weight.iter_mut().for_each(|w| *w /= variance);
        }
        weight
    }

    /// Weights of a row where they depend on its light.
    #[inline(always)]
    pub(crate) fn of_shot(self, crop: &Crop, value: &[f32], weight: &mut Row) {
        if let Weights::Shot {
            base,
            gain_times_amplitude,
            floor,
        } = self
        {
            for ((w, m), f) in weight.iter_mut().zip(&crop.mask).zip(value) {
                *w = m / (base + gain_times_amplitude * f).max(floor);
            }
        }
    }
}

/// What a pass found.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Pass {
    pub step_x_px: f64,
    pub step_y_px: f64,
    pub amplitude: f64,
    /// In the units of the weights.
    pub amplitude_variance: f64,
    /// Above the crop's pedestal.
    pub background: f64,
    /// Weighted residual sum of squares after the step.
    pub chi2: f64,
    /// Covariance of the position, px^2.
    pub covariance: Matrix2<f64>,
}

/// Sums over the window, lane by lane.
#[derive(Clone, Copy, Default)]
struct Sums {
    w: f32x4,
    wf: f32x4,
    wx: f32x4,
    wy: f32x4,
    wff: f32x4,
    wxf: f32x4,
    wyf: f32x4,
    wxx: f32x4,
    wxy: f32x4,
    wyy: f32x4,
    wp: f32x4,
    wfp: f32x4,
    wxp: f32x4,
    wyp: f32x4,
    wpp: f32x4,
}

/// One pass at the position (`x_px`, `y_px`), frame coordinates, of a bead that went along `comb` while the shutter was
/// open. `None` when the normal matrix is singular.
pub(crate) fn pass(
    crop: &Crop,
    template: &Template,
    comb: &Comb,
    (x_px, y_px): (f64, f64),
    weights: Weights,
) -> Option<Pass> {
    let x = (x_px - crop.x0 as f64) as f32;
    let y = (y_px - crop.y0 as f64) as f32;
    let lanes_end = crop.width.next_multiple_of(LANES).min(STRIDE);
    let mut image = Image::new(lanes_end);
    let mut weight = weights.of_even(crop);
    let mut sums = Sums::default();
    for (j, pixels) in crop.rows.iter().enumerate().take(crop.height) {
        image.draw_row(template, comb, x, j as f32 - y);
        weights.of_shot(crop, &image.value[..lanes_end], &mut weight);
        let mut with_holes: Row;
        let weight = if crop.has_holes() {
            with_holes = weight;
            for column in crop.left_out(j) {
                with_holes[column.min(STRIDE - 1)] = 0.0;
            }
            &with_holes
        } else {
            &weight
        };
        sums.add_row(
            &weight[..lanes_end],
            &image.value[..lanes_end],
            &image.by_x[..lanes_end],
            &image.by_y,
            pixels,
        );
    }
    sums.solve()
}

/// One row of the model's image and its derivatives by the centre.
pub(crate) struct Image {
    lanes_end: usize,
    pub value: Row,
    pub by_x: Row,
    pub by_y: Row,
}

impl Image {
    pub(crate) fn new(lanes_end: usize) -> Self {
        Image {
            lanes_end,
            value: [0.0; STRIDE],
            by_x: [0.0; STRIDE],
            by_y: [0.0; STRIDE],
        }
    }

    /// Draws the row `dy` px below the centre, in the column `x`.
    #[inline(always)]
    pub(crate) fn draw_row(&mut self, template: &Template, comb: &Comb, x: f32, dy: f32) {
        let n = self.lanes_end.min(STRIDE);
        let factor = f32x4::splat(-2.0 * template.slope_factor());
        let mut first = true;
        for (ox, oy) in comb.offsets() {
            let (x, dy) = (f32x4::splat(x + ox), f32x4::splat(dy - oy));
            let dy2 = dy * dy;
            let mut column = FIRST_COLUMNS;
            let rows = (self.value[..n].as_chunks_mut::<LANES>().0.iter_mut())
                .zip(self.by_x[..n].as_chunks_mut::<LANES>().0)
                .zip(self.by_y[..n].as_chunks_mut::<LANES>().0);
            for ((value, by_x), by_y) in rows {
                let dx = column - x;
                column += f32x4::splat(LANES as f32);
                let (f, df) = template.at_lanes(dx * dx + dy2);
                // The derivative by the centre is minus twice that by the squared radius, times the distance.
                let g = factor * df;
                let (fx, fy) = (g * dx, g * dy);
                for (to, new) in [(value, f), (by_x, fx), (by_y, fy)] {
                    *to = if first {
                        new.to_array()
                    } else {
                        (f32x4::from(*to) + new).to_array()
                    };
                }
            }
            first = false;
        }
        if !comb.is_still() {
            let share = comb.share();
            for row in [&mut self.value, &mut self.by_x, &mut self.by_y] {
                row[..n].iter_mut().for_each(|v| *v *= share);
            }
        }
    }
}

impl Sums {
    #[inline(always)]
    fn add_row(&mut self, weight: &[f32], value: &[f32], by_x: &[f32], by_y: &Row, pixels: &Row) {
        let chunks = weight
            .as_chunks::<LANES>()
            .0
            .iter()
            .zip(value.as_chunks::<LANES>().0);
        let chunks = chunks
            .zip(by_x.as_chunks::<LANES>().0)
            .zip(by_y.as_chunks::<LANES>().0);
        let mut s = *self;
        for ((((w, f), fx), fy), p) in chunks.zip(pixels.as_chunks::<LANES>().0) {
            let [w, f, fx, fy, p] = [w, f, fx, fy, p].map(|lanes| f32x4::from(*lanes));
            let (wf, wx, wy, wp) = (w * f, w * fx, w * fy, w * p);
            s.w += w;
            s.wf += wf;
            s.wx += wx;
            s.wy += wy;
            s.wff += wf * f;
            s.wxf += wx * f;
            s.wyf += wy * f;
            s.wxx += wx * fx;
            s.wxy += wx * fy;
            s.wyy += wy * fy;
            s.wp += wp;
            s.wfp += wf * p;
            s.wxp += wx * p;
            s.wyp += wy * p;
            s.wpp += wp * p;
        }
        *self = s;
    }

    fn solve(&self) -> Option<Pass> {
        let t = |lanes: &f32x4| lanes.to_array().iter().map(|v| f64::from(*v)).sum::<f64>();
        let normal = Matrix4::new(
            t(&self.wxx),
            t(&self.wxy),
            t(&self.wxf),
            t(&self.wx), //
            t(&self.wxy),
            t(&self.wyy),
            t(&self.wyf),
            t(&self.wy), //
            t(&self.wxf),
            t(&self.wyf),
            t(&self.wff),
            t(&self.wf), //
            t(&self.wx),
            t(&self.wy),
            t(&self.wf),
            t(&self.w),
        );
        let right = Vector4::new(t(&self.wxp), t(&self.wyp), t(&self.wfp), t(&self.wp));
        let inverse = normal.cholesky()?.inverse();
        let solution = inverse * right;
        let amplitude = solution[2];
        let chi2 = t(&self.wpp) - solution.dot(&right);
        let pass = Pass {
            step_x_px: solution[0] / amplitude,
            step_y_px: solution[1] / amplitude,
            amplitude,
            amplitude_variance: inverse[(2, 2)],
            background: solution[3],
            chi2,
            covariance: inverse.fixed_view::<2, 2>(0, 0) / (amplitude * amplitude),
        };
        let finite =
            pass.step_x_px.is_finite() && pass.step_y_px.is_finite() && pass.chi2.is_finite();
        finite.then_some(pass)
    }
}

/// Relative change of the template's radius that fits the window best at a fixed position, with free amplitude and background, and
/// its standard deviation for an even noise `variance` (grey^2).
pub(crate) fn scale(
    crop: &Crop,
    template: &Template,
    x_px: f64,
    y_px: f64,
    variance: f64,
) -> Option<(f64, f64)> {
    let (x, y) = (
        (x_px - crop.x0 as f64) as f32,
        (y_px - crop.y0 as f64) as f32,
    );
    let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
    let factor = -2.0 * template.slope_factor();
    for (j, row) in crop.rows.iter().enumerate().take(crop.height) {
        let dy = j as f32 - y;
        for (i, p) in row.iter().enumerate().take(crop.width) {
            let dx = i as f32 - x;
            let q = dx * dx + dy * dy;
            let (f, df) = template.at(q);
            // f(r / s) changes by -r f'(r) per unit of s, and r f' = 2 q df/dq.
            let g = Vector3::new(f64::from(f), 1.0, f64::from(factor * q * df));
            normal += g * g.transpose();
            right += g * f64::from(*p);
        }
    }
    let inverse = normal.cholesky()?.inverse();
    let solution = inverse * right;
    let change = solution[2] / solution[0];
    let sd = (inverse[(2, 2)] * variance).sqrt() / solution[0].abs();
    (change.is_finite() && sd.is_finite()).then_some((change, sd))
}

/// Change of the comb's length, as a fraction of it, that fits the window best: one secant step. Positions and relative contrasts
/// of the beads are fixed (x and y in px, contrast), all in the same flow. A common contrast and background are free.
pub(crate) fn stretch(
    crop: &Crop,
    template: &Template,
    shorter: &Comb,
    longer: &Comb,
    beads: impl Iterator<Item = (f64, f64, f64)> + Clone,
) -> Option<f64> {
    let lanes_end = crop.width.next_multiple_of(LANES).min(STRIDE);
    let mut image = Image::new(lanes_end);
    let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
    for (j, row) in crop.rows.iter().enumerate().take(crop.height) {
        let mut models = [[0.0_f32; STRIDE]; 2];
        for (x_px, y_px, contrast) in beads.clone() {
            let (x, y) = (
                (x_px - crop.x0 as f64) as f32,
                (y_px - crop.y0 as f64) as f32,
            );
            for (comb, model) in [shorter, longer].into_iter().zip(&mut models) {
                image.draw_row(template, comb, x, j as f32 - y);
                for (m, f) in model.iter_mut().zip(&image.value).take(lanes_end) {
                    *m += contrast as f32 * f;
                }
            }
        }
        let [a, b] = &models;
        for ((p, a), b) in row.iter().zip(a).zip(b).take(crop.width) {
            let g = Vector3::new(f64::from(0.5 * (a + b)), 1.0, f64::from(b - a));
            normal += g * g.transpose();
            right += g * f64::from(*p);
        }
    }
    let solution = normal.cholesky()?.inverse() * right;
    let change = solution[2] / solution[0];
    change.is_finite().then_some(change)
}
