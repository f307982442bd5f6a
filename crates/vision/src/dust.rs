//! A speck beside a bead: a second source of light, fitted together with the bead.
//!
//! Light of something else in the window draws the fit to its side, and its noise counts as that of the bead. The model is a Gaussian
//! ellipse with six parameters: place, contrast, and three of width, length and direction. The fit is Gauss-Newton with
//! Levenberg's damping, in the bead's place and contrast, the level, and those six. Its covariance is that of all ten parameters.

use crate::crop::{Crop, LANES, Row, STRIDE};
use crate::fit::{FIRST_COLUMNS, Image, Pass, Weights};
use crate::fix::squared;
use crate::least_squares::{self, four};
use crate::streak::Comb;
use crate::template::Template;
use nalgebra::{SMatrix, SVector};
use wide::f32x4;

/// Standard deviations of a sum over 3 x 3 pixels from which a speck is looked for: noise makes one in 3 million so strong.
const LEAST_PEAK: f32 = 5.0;
/// Square of a standard deviation over the variance of the ellipse of its pixels above half the peak: half maximum is at 1.177
/// standard deviations, and the variance of an even ellipse is a quarter of its half axis squared.
const HALF_MAXIMUM: f32 = 2.885;
/// Farthest pixel from a peak that tells its first shape, bead radii.
const SHAPE_RADII: f64 = 3.0;
/// Variance of the narrowest speck, px^2: a pixel's own width and the sums over three pixels widen a point to this.
const NARROWEST_PX2: f32 = 0.5;
/// A speck's middle is farther from that of the bead than this, bead radii: what is on the bead is part of its picture.
const APART_RADII: f64 = 1.0;
/// The same in the speck's standard deviations: the bead has less than a seventh of the speck's light in its middle.
const APART_SIGMAS: f64 = 2.0;
/// Parameters of the speck, and of the whole fit.
const OWN: usize = 6;
const ALL: usize = 4 + OWN;
/// Parameters that the model is not linear in: the bead's place; place and shape of the speck.
const BENT: [usize; 7] = [0, 1, 5, 6, 7, 8, 9];
/// Passes of the fit, its first damping, and the misfit's relative change at rest.
const MOST_PASSES: usize = 24;
const DAMPING: f64 = 1e-2;
const MOST_DAMPING: f64 = 1e6;
const AT_REST: f64 = 1e-4;
/// Relative error of a sum of numbers of single precision over a window.
const ROUNDING: f64 = 1e-6;
/// Longest step of a shape parameter relative to the larger one, and of the place in standard deviations.
const LONGEST_STEP: f64 = 0.5;

/// A Gaussian ellipse in window coordinates: `contrast * exp(-(u^2 + v^2) / 2)` with `u = a dx + b dy` and `v = c dy`.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Speck {
    x: f64,
    y: f64,
    a: f64,
    b: f64,
    c: f64,
    contrast: f64,
}

impl Speck {
    /// Where a speck may be, by what the fit of a bead leaves of the window besides its mean all round; `noise` is the
    /// standard deviation of a pixel. `None` if nothing stands out.
    pub(crate) fn seen(
        crop: &Crop,
        left: &[Row],
        (x, y): (f64, f64),
        radius_px: f64,
        noise: f32,
    ) -> Option<Self> {
        let sum = |j: usize, i: usize| -> f32 {
            let rows = left.get(j - 1..j + 2).unwrap_or(&[]);
            let three = |row: &Row| row.get(i - 1..i + 2).unwrap_or(&[]).iter().sum::<f32>();
            rows.iter().map(three).sum()
        };
        let inside = |len: usize| 1..len.saturating_sub(1);
        let apart = APART_RADII * radius_px;
        let is_apart = |j: usize, i: usize| squared(i as f64 - x, j as f64 - y) > apart * apart;
        let (mut peak, mut at) = (LEAST_PEAK * 3.0 * noise, None);
        for (j, i) in inside(crop.height).flat_map(|j| inside(crop.width).map(move |i| (j, i))) {
            let value = sum(j, i);
            if value.abs() > peak && is_apart(j, i) {
                (peak, at) = (value.abs(), Some((j, i, value.signum())));
            }
        }
        let (j0, i0, sign) = at?;
        // Moments of the pixels above half the peak.
        let reach = (SHAPE_RADII * radius_px).ceil() as usize;
        let about = |k: usize, len: usize| {
            k.saturating_sub(reach).max(1)..(k + reach + 1).min(len.saturating_sub(1))
        };
        let (mut n, mut sx, mut sy, mut xx, mut xy, mut yy) =
            (0.0_f32, 0.0_f32, 0.0_f32, 0.0_f32, 0.0_f32, 0.0_f32);
        for (j, i) in
            about(j0, crop.height).flat_map(|j| about(i0, crop.width).map(move |i| (j, i)))
        {
            // What is left at the bead's edge is the fit's, which the speck has drawn off.
            if sign * sum(j, i) > 0.5 * peak && is_apart(j, i) {
                let (dx, dy) = (i as f32 - i0 as f32, j as f32 - j0 as f32);
                (n, sx, sy) = (n + 1.0, sx + dx, sy + dy);
                (xx, xy, yy) = (xx + dx * dx, xy + dx * dy, yy + dy * dy);
            }
        }
        let (mx, my) = (sx / n, sy / n);
        let variance = |sum: f32, mean2: f32| HALF_MAXIMUM * (sum / n - mean2);
        let (xx, yy) = (
            variance(xx, mx * mx).max(NARROWEST_PX2),
            variance(yy, my * my).max(NARROWEST_PX2),
        );
        let most = (xx * yy).sqrt() - 0.5 * NARROWEST_PX2;
        let xy = variance(xy, mx * my).clamp(-most, most);
        // The precision matrix, factored.
        let (xx, xy, yy) = (f64::from(xx), f64::from(xy), f64::from(yy));
        let a = (yy / (xx * yy - xy * xy)).sqrt();
        Some(Speck {
            x: i0 as f64 + f64::from(mx),
            y: j0 as f64 + f64::from(my),
            a,
            b: -a * xy / yy,
            c: yy.sqrt().recip(),
            contrast: 0.0,
        })
    }

    /// As large, and as wide as it is long.
    pub(crate) fn rounded(&self) -> Self {
        let width = (self.a * self.c).sqrt();
        Speck {
            a: width,
            b: 0.0,
            c: width,
            ..*self
        }
    }

    /// Standard deviation along the shortest axis, px.
    fn shortest_px(&self) -> f64 {
        let (p, q) = (self.a * self.a, self.a * self.b);
        let s = self.b * self.b + self.c * self.c;
        (0.5 * (p + s) + f64::hypot(0.5 * (p - s), q))
            .sqrt()
            .recip()
    }

    /// Whether a bead at a place of the window is beside the speck: away from its middle, and from its length.
    fn is_apart(&self, (x, y): (f64, f64), radius_px: f64) -> bool {
        let (dx, dy) = (x - self.x, y - self.y);
        let sigmas = f64::hypot(self.a * dx + self.b * dy, self.c * dy);
        f64::hypot(dx, dy) > APART_RADII * radius_px && sigmas > APART_SIGMAS
    }

    /// Largest difference that the speck makes in the window, grey levels; infinite if it is no number.
    fn brightest(&self, crop: &Crop) -> f64 {
        let mut most = f32x4::ZERO;
        for j in 0..crop.height {
            let dy = f32x4::splat(j as f32 - self.y as f32);
            let mut dx = FIRST_COLUMNS - f32x4::splat(self.x as f32);
            for _ in (0..crop.lanes_end()).step_by(LANES) {
                most = most.fast_max(self.light(dx, dy).0);
                dx += f32x4::splat(LANES as f32);
            }
        }
        let most = f64::from(most.to_array().into_iter().fold(0.0, f32::max));
        let brightest = most * self.contrast.abs();
        if brightest.is_finite() {
            brightest
        } else {
            f64::INFINITY
        }
    }

    /// Light for a contrast of 1 in four pixels, with `u` and `v`.
    #[inline(always)]
    fn light(&self, dx: f32x4, dy: f32x4) -> (f32x4, f32x4, f32x4) {
        let [a, b, c] = [self.a, self.b, self.c].map(|v| f32x4::splat(v as f32));
        let (u, v) = (a * dx + b * dy, c * dy);
        let square = (u * u + v * v).fast_min(f32x4::splat(80.0));
        ((square * f32x4::splat(-0.5)).exp(), u, v)
    }

    /// Takes the speck's light off a window.
    pub(crate) fn take_off(&self, crop: &mut Crop) {
        self.add(crop, -self.contrast);
    }

    /// Undoes [`Speck::take_off`].
    pub(crate) fn put_back(&self, crop: &mut Crop) {
        self.add(crop, self.contrast);
    }

    fn add(&self, crop: &mut Crop, contrast: f64) {
        let (lanes_end, height) = (crop.lanes_end(), crop.height);
        let contrast = f32x4::splat(contrast as f32);
        for (j, row) in crop.rows.iter_mut().enumerate().take(height) {
            let dy = f32x4::splat(j as f32 - self.y as f32);
            let mut dx = FIRST_COLUMNS - f32x4::splat(self.x as f32);
            for four in row[..lanes_end].as_chunks_mut::<LANES>().0 {
                let (light, ..) = self.light(dx, dy);
                *four = (f32x4::from(*four) + contrast * light).to_array();
                dx += f32x4::splat(LANES as f32);
            }
        }
    }

    /// The speck after a step, no longer than [`LONGEST_STEP`].
    fn after(&self, step: &SVector<f64, ALL>) -> Self {
        let contrast = step[4];
        let [dx, dy, da, db, dc] = [5, 6, 7, 8, 9].map(|k| step[k] / contrast);
        let place = f64::hypot(self.a * dx + self.b * dy, self.c * dy);
        let shape = (da / self.a)
            .abs()
            .max((dc / self.c).abs())
            .max((db / self.a.max(self.c.abs())).abs());
        let scale = (LONGEST_STEP / place.max(shape).max(1e-12)).min(1.0);
        Speck {
            x: self.x + scale * dx,
            y: self.y + scale * dy,
            a: self.a + scale * da,
            b: self.b + scale * db,
            c: self.c + scale * dc,
            contrast,
        }
    }
}

/// A bead and a speck fitted together: the bead's place, the pass there, and the speck.
pub(crate) struct Both {
    pub place_px: (f64, f64),
    pub pass: Pass,
    pub speck: Speck,
}

/// Fits both from first places on. `None` if the window does not tell them apart, or the speck is none: on the bead, or wider than it.
pub(crate) fn fit(
    crop: &Crop,
    template: &Template,
    start_px: (f64, f64),
    speck: Speck,
    weights: Weights,
) -> Option<Both> {
    let radius_px = template.radius_px();
    let reach_px = 0.4 * radius_px;
    let (mut at, mut speck) = (start_px, speck);
    let mut sums = Sums::of(crop, template, at, &speck, weights);
    let mut rest = sums.at_rest()?;
    let mut damping = DAMPING;
    for _ in 0..MOST_PASSES {
        let Some(step) = sums.step(damping) else {
            damping *= 10.0;
            if damping > MOST_DAMPING {
                break;
            }
            continue;
        };
        let (dx, dy) = (step[0] / step[2], step[1] / step[2]);
        let scale = (reach_px / f64::hypot(dx, dy).max(1e-12)).min(1.0);
        let next_at = (at.0 + scale * dx, at.1 + scale * dy);
        let next = speck.after(&step);
        let next_sums = Sums::of(crop, template, next_at, &next, weights);
        let Some(found) = next_sums.at_rest().filter(|found| found.0 < rest.0) else {
            damping *= 10.0;
            if damping > MOST_DAMPING {
                break;
            }
            continue;
        };
        let gain = rest.0 - found.0;
        (at, speck, sums, rest) = (next_at, next, next_sums, found);
        damping = (0.1 * damping).max(1e-9);
        if gain < AT_REST * rest.0 {
            break;
        }
    }
    let (chi2, linear) = rest;
    speck.contrast = linear[4];
    let inverse = sums.covariance()?;
    let amplitude = linear[2];
    let pass = Pass {
        step_x_px: 0.0,
        step_y_px: 0.0,
        amplitude,
        amplitude_variance: inverse[(2, 2)],
        background: linear[3],
        chi2,
        covariance: inverse.fixed_view::<2, 2>(0, 0) / (amplitude * amplitude),
    };
    let bead = (at.0 - crop.x0 as f64, at.1 - crop.y0 as f64);
    let is_speck = speck.is_apart(bead, radius_px)
        && speck.shortest_px() < radius_px
        // Beside something stronger there is no telling its edge from a bead.
        && speck.brightest(crop) < amplitude.abs()
        && f64::hypot(at.0 - start_px.0, at.1 - start_px.1) < radius_px;
    is_speck.then_some(Both {
        place_px: at,
        pass,
        speck,
    })
}

/// Normal equations at a place: columns are the bead's derivatives by place, its light, the level, the speck's light, and its
/// derivatives by place and shape. Nonlinear parameters are in steps times the contrast.
struct Sums {
    normal: SMatrix<f64, ALL, ALL>,
    right: SVector<f64, ALL>,
    squares: f64,
}

impl Sums {
    fn of(
        crop: &Crop,
        template: &Template,
        (x_px, y_px): (f64, f64),
        speck: &Speck,
        weights: Weights,
    ) -> Self {
        let (x, y) = (
            (x_px - crop.x0 as f64) as f32,
            (y_px - crop.y0 as f64) as f32,
        );
        let lanes_end = crop.lanes_end();
        let mut image = Image::new(lanes_end);
        let mut weight = weights.of_even(crop);
        let mut sums = least_squares::Sums::<ALL>::new();
        let [a, b, c] = [speck.a, speck.b, speck.c].map(|v| f32x4::splat(v as f32));
        for (j, pixels) in crop.rows.iter().enumerate().take(crop.height) {
            image.draw_row(template, &Comb::STILL, x, j as f32 - y);
            weights.of_shot(crop, &image.value[..lanes_end], &mut weight);
            let mut with_holes = weight;
            for column in crop.left_out(j) {
                with_holes[column.min(STRIDE - 1)] = 0.0;
            }
            let dy = f32x4::splat(j as f32 - speck.y as f32);
            let mut dx = FIRST_COLUMNS - f32x4::splat(speck.x as f32);
            for first in (0..lanes_end).step_by(LANES) {
                let four = |row: &Row| four(row, first);
                let (h, u, v) = speck.light(dx, dy);
                let (hu, hv) = (h * u, h * v);
                let columns = [
                    four(&image.by_x),
                    four(&image.by_y),
                    four(&image.value),
                    f32x4::ONE,
                    h,
                    hu * a,
                    hu * b + hv * c,
                    -(hu * dx),
                    -(hu * dy),
                    -(hv * dy),
                ];
                sums.add(&columns, four(&with_holes), four(pixels));
                dx += f32x4::splat(LANES as f32);
            }
        }
        let (normal, right, squares) = sums.equations();
        Sums {
            normal,
            right,
            squares,
        }
    }

    /// Misfit at this place, with contrasts and level free, and those.
    fn at_rest(&self) -> Option<(f64, SVector<f64, ALL>)> {
        let (mut normal, mut right) = (self.normal, self.right);
        for i in BENT {
            normal.fill_row(i, 0.0);
            normal.fill_column(i, 0.0);
            normal[(i, i)] = 1.0;
            right[i] = 0.0;
        }
        let solution = normal.cholesky()?.solve(&right);
        let misfit = self.squares - solution.dot(&right);
        misfit.is_finite().then_some((misfit, solution))
    }

    /// The damped step.
    fn step(&self, damping: f64) -> Option<SVector<f64, ALL>> {
        Some(self.damped(damping).cholesky()?.solve(&self.right))
    }

    /// Covariance of all parameters. The flank of a speck whose middle is far out of the window does not tell its shape: the equations
    /// are singular to the rounding of single precision, but the bead's place is known. The least damping that shows above it is enough.
    fn covariance(&self) -> Option<SMatrix<f64, ALL, ALL>> {
        let of = |damping| Some(self.damped(damping).cholesky()?.inverse());
        of(0.0)
            .or_else(|| of(ROUNDING))
            .or_else(|| of(100.0 * ROUNDING))
    }

    fn damped(&self, damping: f64) -> SMatrix<f64, ALL, ALL> {
        let mut normal = self.normal;
        for i in BENT {
            normal[(i, i)] *= 1.0 + damping;
        }
        normal
    }
}

/// Pixels over which what is neither noise nor the model is alike: a disc of half a bead's radius, the finest part of a picture that
/// is as sharp as the bead.
pub(crate) fn alike_px(radius_px: f64) -> f64 {
    (core::f64::consts::PI * 0.25 * radius_px * radius_px).max(1.0)
}

/// What specks explain, for the price of their parameters.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Bill {
    pub specks: usize,
    /// What they take off the sum of squares, variances of noise.
    pub gain: f64,
    /// What the fit leaves besides its mean all round, variances of noise a pixel.
    pub lopsided: f64,
    /// What other parameters would take off the sum of squares, variances of noise.
    pub other: f64,
}

impl Bill {
    /// That of these specks and one more, whose bill begins with what these leave.
    pub(crate) fn and(&self, next: &Bill) -> Self {
        Bill {
            specks: self.specks + next.specks,
            gain: self.gain + next.gain,
            lopsided: next.lopsided,
            other: self.other,
        }
    }

    /// Whether they explain enough: more than the price of their parameters, that is their number times the logarithm of the number
    /// of pixels (Schwarz 1978), and than others would. What the fit leaves beyond noise besides its mean all round is a template's
    /// error, alike over patches of half a bead radius: there a patch counts as one pixel. The mean all round is no speck's.
    pub(crate) fn is_paid(&self, crop: &Crop, radius_px: f64) -> bool {
        let pixels = (crop.width * crop.height) as f64;
        let excess = (self.lopsided - 1.0).max(0.0);
        let parameters = (self.specks * OWN) as f64;
        let price = parameters * pixels.ln() * (1.0 + alike_px(radius_px) * excess);
        self.gain > price + self.other
    }
}
