//! One Gauss-Newton pass of the radial-template fit over a window.
//!
//! The model `grey = b + A f(r)` is linear in the amplitude `A` and the background `b`, so each pass solves the linear
//! least-squares problem in (A dx, A dy, A, b) with the columns (df/dx0, df/dy0, f, 1): the Gauss-Newton step without
//! a start value for A or b. The 4x4 normal matrix of the last pass is the Fisher information of the same four
//! parameters for normal noise, and its inverse their Cramer-Rao bound.

use crate::crop::{Crop, LANES, Row, STRIDE};
use crate::streak::Comb;
use crate::template::Template;
use nalgebra::{Matrix2, Matrix3, Matrix4, Vector2, Vector3, Vector4};
use wide::f32x4;

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

/// What a pass found.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Pass {
    pub step_x_px: f64,
    pub step_y_px: f64,
    pub amplitude: f64,
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
    let mut weight: Row = crop.mask;
    if let Weights::Even { variance } = weights {
        weight.iter_mut().for_each(|w| *w /= variance);
    }
    let mut sums = Sums::default();
    for (j, pixels) in crop.rows.iter().enumerate().take(crop.height) {
        image.draw_row(template, comb, x, j as f32 - y);
        if let Weights::Shot {
            base,
            gain_times_amplitude,
            floor,
        } = weights
        {
            for ((w, m), f) in weight
                .iter_mut()
                .zip(&crop.mask)
                .zip(&image.value)
                .take(lanes_end)
            {
                *w = m / (base + gain_times_amplitude * f).max(floor);
            }
        }
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
struct Image {
    lanes_end: usize,
    entry: [u32; STRIDE],
    offset: Row,
    value: Row,
    by_x: Row,
    by_y: Row,
}

impl Image {
    fn new(lanes_end: usize) -> Self {
        Image {
            lanes_end,
            entry: [0; STRIDE],
            offset: [0.0; STRIDE],
            value: [0.0; STRIDE],
            by_x: [0.0; STRIDE],
            by_y: [0.0; STRIDE],
        }
    }

    /// The row `dy` px below the centre, which lies in the column `x`.
    #[inline(always)]
    fn draw_row(&mut self, template: &Template, comb: &Comb, x: f32, dy: f32) {
        let n = self.lanes_end;
        let mut first = true;
        for (ox, oy) in comb.offsets() {
            let (x, dy) = (x + ox, dy - oy);
            let dy2 = dy * dy;
            let rooms = self.entry.iter_mut().zip(&mut self.offset).take(n);
            for (i, (e, t)) in rooms.enumerate() {
                let dx = i as f32 - x;
                (*e, *t) = template.place(dx * dx + dy2);
            }
            let places = self.entry.iter().zip(&self.offset).take(n);
            let rows = self
                .value
                .iter_mut()
                .zip(&mut self.by_x)
                .zip(&mut self.by_y);
            for (i, (((v, gx), gy), (e, t))) in rows.zip(places).enumerate() {
                let (f, df) = template.read((*e, *t));
                // The derivative by the centre is minus twice that by the squared radius, times the distance.
                let g = -2.0 * df;
                let (fx, fy) = (g * (i as f32 - x), g * dy);
                if first {
                    (*v, *gx, *gy) = (f, fx, fy);
                } else {
                    *v += f;
                    *gx += fx;
                    *gy += fy;
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
            background: solution[3],
            chi2,
            covariance: inverse.fixed_view::<2, 2>(0, 0) / (amplitude * amplitude),
        };
        let finite =
            pass.step_x_px.is_finite() && pass.step_y_px.is_finite() && pass.chi2.is_finite();
        finite.then_some(pass)
    }
}

/// Relative change of the template's radius that fits the window best at a fixed position, beside amplitude and
/// background, and its standard deviation for an even noise `variance` (grey^2).
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
    for (j, row) in crop.rows.iter().enumerate().take(crop.height) {
        let dy = j as f32 - y;
        for (i, p) in row.iter().enumerate().take(crop.width) {
            let dx = i as f32 - x;
            let q = dx * dx + dy * dy;
            let (f, df) = template.at(q);
            // f(r / s) changes by -r f'(r) per unit of s, and r f' = 2 q df/dq.
            let g = Vector3::new(f64::from(f), 1.0, f64::from(-2.0 * q * df));
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

/// Side of the patches over which what the template leaves counts as one, px and bead radii: noise that a camera, a codec
/// or a blur has spread, and what sticks to a bead, are alike over some pixels.
const PATCH: (f64, f64) = (5.0, 0.5);
/// Share of even noise's variance that is left in a patch of values between the pixels.
const INTERPOLATED: f64 = 0.83;
/// Most patches in a window.
const MAX_PATCHES: usize = 256;

/// By how much the variance of the position is larger than from noise of the even `variance` (grey^2), judged by what the
/// template leaves of the window (a clustered sandwich): mean over the two directions. A residual that is the same all
/// round, or on opposite sides of the centre, as a template of another focus or size leaves it, does not move the position
/// and does not count. `None` for a window with the bead far off its middle.
pub(crate) fn widening(
    crop: &Crop,
    template: &Template,
    comb: &Comb,
    (x_px, y_px): (f64, f64),
    (amplitude, background): (f64, f64),
    variance: f64,
    left: &mut [Row],
) -> Option<f64> {
    let (x, y) = (
        (x_px - crop.x0 as f64) as f32,
        (y_px - crop.y0 as f64) as f32,
    );
    let (amplitude, background) = (amplitude as f32, background as f32);
    let mut image = Image::new(crop.width.next_multiple_of(LANES).min(STRIDE));
    for ((j, pixels), left) in crop
        .rows
        .iter()
        .enumerate()
        .zip(left.iter_mut())
        .take(crop.height)
    {
        image.draw_row(template, comb, x, j as f32 - y);
        for ((l, p), f) in left
            .iter_mut()
            .zip(pixels)
            .zip(&image.value)
            .take(crop.width)
        {
            *l = p - background - amplitude * f;
        }
    }
    take_off_radial_mean(crop, (x, y), left);
    // Points at whole distances from the centre: those opposite each other lie alike between the pixels.
    let reach = |c: f32, len: usize| c.min(len as f32 - 1.0 - c).floor().max(0.0) as usize;
    let (across, down) = (reach(x, crop.width), reach(y, crop.height));
    if 2 * across + 1 < crop.width / 2 || 2 * down + 1 < crop.height / 2 {
        return None;
    }
    let at = |u: f32, v: f32| -> f32 {
        let (i, j) = (u as usize, v as usize);
        let (a, b) = (u - i as f32, v - j as f32);
        let get = |j: usize, i: usize| {
            left.get(j)
                .and_then(|row| row.get(i))
                .copied()
                .unwrap_or(0.0)
        };
        let (upper, lower) = (
            get(j, i) + a * (get(j, i + 1) - get(j, i)),
            get(j + 1, i) + a * (get(j + 1, i + 1) - get(j + 1, i)),
        );
        upper + b * (lower - upper)
    };
    let side = (PATCH.0.max(PATCH.1 * template.radius_px()) as usize)
        .max((2 * across.max(down) + 1).div_ceil(15));
    let columns = (2 * across + 1).div_ceil(side);
    let mut patches = [Vector2::zeros(); MAX_PATCHES];
    let mut information = Matrix2::zeros();
    for n in 0..=2 * down {
        let dy = n as f32 - down as f32;
        image.draw_row(template, comb, across as f32, dy);
        for m in 0..=2 * across {
            let dx = m as f32 - across as f32;
            let (Some(gx), Some(gy), Some(patch)) = (
                image.by_x.get(m),
                image.by_y.get(m),
                patches.get_mut(n / side * columns + m / side),
            ) else {
                continue;
            };
            let g = Vector2::new(f64::from(*gx), f64::from(*gy));
            information += g * g.transpose();
            // Half the difference: the part that can move the position.
            *patch += g * (0.5 * f64::from(at(x + dx, y + dy) - at(x - dx, y - dy)));
        }
    }
    let mut scores = Matrix2::zeros();
    let mut strongest = 0.0_f64;
    for u in &patches {
        scores += u * u.transpose();
        strongest = strongest.max(u.norm_squared());
    }
    // Every patch has its opposite with the same score; the scores of a fit sum to zero, which takes some off.
    let effective = (scores.trace() / strongest.max(1e-12)).max(4.0);
    let scores = scores * (2.0 / INTERPOLATED * effective / (effective - 1.5));
    let inverse = information.try_inverse()?;
    let robust = inverse * scores * inverse;
    let plain = inverse * variance;
    let ratio = robust.trace() / plain.trace();
    ratio.is_finite().then_some(ratio)
}

/// Takes the mean over each ring about the centre off what the template leaves: that of a template of another focus or size,
/// which does not move the position.
fn take_off_radial_mean(crop: &Crop, (x, y): (f32, f32), left: &mut [Row]) {
    const RINGS: usize = 2 * STRIDE;
    let place = |i: usize, j: usize| {
        let u = f32::hypot(i as f32 - x, j as f32 - y);
        (u as usize, u.fract())
    };
    let (mut sums, mut weights) = ([0.0_f32; RINGS], [0.0_f32; RINGS]);
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

/// Change of the comb's length, as a fraction of it, that fits the window best at a fixed position, beside amplitude and
/// background: one secant step.
pub(crate) fn stretch(
    crop: &Crop,
    template: &Template,
    shorter: &Comb,
    longer: &Comb,
    (x_px, y_px): (f64, f64),
) -> Option<f64> {
    let (x, y) = (
        (x_px - crop.x0 as f64) as f32,
        (y_px - crop.y0 as f64) as f32,
    );
    let lanes_end = crop.width.next_multiple_of(LANES).min(STRIDE);
    let (mut a, mut b) = (Image::new(lanes_end), Image::new(lanes_end));
    let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
    for (j, row) in crop.rows.iter().enumerate().take(crop.height) {
        let dy = j as f32 - y;
        a.draw_row(template, shorter, x, dy);
        b.draw_row(template, longer, x, dy);
        for ((p, a), b) in row.iter().zip(&a.value).zip(&b.value).take(crop.width) {
            let g = Vector3::new(f64::from(0.5 * (a + b)), 1.0, f64::from(b - a));
            normal += g * g.transpose();
            right += g * f64::from(*p);
        }
    }
    let solution = normal.cholesky()?.inverse() * right;
    let change = solution[2] / solution[0];
    change.is_finite().then_some(change)
}
