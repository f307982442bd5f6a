//! What a fit of place, contrast and level leaves of a window, and what it says: score tests of what was not fitted, and of what else
//! may be there instead of a bead.

use crate::beyond::{Asked, middle};
use crate::crop::{Crop, LANES, Row, STRIDE};
use crate::fibre;
use crate::fit::Image;
use crate::offsets::Lines;
use crate::streak::Comb;
use crate::template::Template;
use wide::f32x4;

/// Standard deviations from which the light's slope is fitted, and the size. What is missed below moves the bead by 2.5 of them
/// times its correlation with the place, which is 0.27 in the narrowest default window: by less than one standard deviation.
const LEAST_SLOPE: f64 = 2.5;
const LEAST_SIZE: f64 = 3.0;
/// Chi-square of a contrast from which the score of a stretch shows any fibre. The score of a fibre twice as long as the bead and 1.3 times
/// as wide has 0.03 of that chi-square: it is 5.5 standard deviations. Noise takes one of 700 below [`LEAST_SLOPE`].
const SHOWS_A_STRETCH: f64 = 1000.0;
/// Light of a bead's core, over its contrast.
const CORE: f32 = 0.3;

/// What a fit leaves of a window.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Left {
    /// Largest difference, grey levels.
    pub strongest: f32,
    /// Score tests, in standard deviations of noise of variance 1 grey^2: slope along the row, along the column, size.
    scores: [f64; 3],
    /// Scores of a stretch along the row and along the diagonal, and square of that of the bead's contrast, as a chi-square of noise of
    /// variance 1 grey^2.
    stretch: [f64; 2],
    contrast: f64,
    /// Contrast of the bead's brightest pixel, grey levels.
    brightest: f64,
    /// Variance of a pixel where the place is read off: weighted by the squares of the template's derivatives, grey^2.
    pub local_variance: f64,
    /// Of rows and of columns.
    pub lines: [Lines; 2],
}

impl Left {
    /// Whether a bright pixel, a fibre or an edge explains more than the bead does, for noise of a variance. A fibre or an edge is about
    /// twice as long one way as the other.
    pub(crate) fn has_rival(
        &self,
        crop: &Crop,
        at: (f64, f64),
        radius_px: f64,
        sign: f64,
        variance: f64,
    ) -> bool {
        if self.brightest.powi(2) > self.contrast {
            return true;
        }
        let [along, diagonal] = self.stretch.map(|score| sign * score);
        let stretch = along * along + diagonal * diagonal;
        if stretch < LEAST_SLOPE * LEAST_SLOPE * variance
            && self.contrast > SHOWS_A_STRETCH * variance
        {
            return false;
        }
        // The scores are proportional to the cosine and the sine of twice the fibre's angle.
        let (sin, cos) = (0.5 * diagonal.atan2(along)).sin_cos();
        fibre::explains(crop, at, radius_px, (cos, sin), sign) > self.contrast
    }

    /// Scores of a stretch along row and diagonal, relative to a contrast.
    pub(crate) fn bends(&self, contrast: f64) -> [f64; 2] {
        self.stretch.map(|score| score / contrast)
    }

    /// What light that rises and another size would take off the sum of squares, grey^2.
    pub(crate) fn explained_by_slope_and_size(&self) -> f64 {
        self.scores.iter().map(|score| score * score).sum()
    }

    /// What the window asks for besides place, contrast and level, where noise of a variance is all that is left.
    pub(crate) fn asks(&self, variance: f64) -> Asked {
        let [along, down, size] = self.scores.map(|z| z * z / variance);
        Asked {
            slopes: along.max(down) > LEAST_SLOPE * LEAST_SLOPE,
            size: size > LEAST_SIZE * LEAST_SIZE,
        }
    }
}

/// Distance from the centre beyond which a pixel is beside the bead, bead radii.
const BESIDE_RADII: f64 = 0.8;

/// Fills `left` with what a fit leaves, and tests it.
pub(crate) fn examine(
    crop: &Crop,
    template: &Template,
    comb: &Comb,
    (x_px, y_px): (f64, f64),
    (amplitude, background): (f64, f64),
    left: &mut [Row],
) -> Left {
    let (x, y) = (
        (x_px - crop.x0 as f64) as f32,
        (y_px - crop.y0 as f64) as f32,
    );
    let (amplitude, background) = (amplitude as f32, background as f32);
    let beside = (BESIDE_RADII * template.radius_px()) as f32;
    let (u0, v0) = middle(crop);
    let lanes_end = crop.width.next_multiple_of(LANES).min(STRIDE);
    let mut image = Image::new(lanes_end);
    // Distances along the row from the middle, and 1 for what is beside the bead.
    let (mut across, mut away) = ([0.0_f32; STRIDE], [0.0_f32; STRIDE]);
    for (i, (u, a)) in across
        .iter_mut()
        .zip(&mut away)
        .enumerate()
        .take(crop.width)
    {
        *u = i as f32 - u0;
        *a = f32::from(u8::from((i as f32 - x).abs() > beside));
    }
    let beside_in_row: f32 = away.iter().sum();
    let (mut row_sums, mut row_derivatives) = ([0.0_f32; STRIDE], [0.0_f32; STRIDE]);
    let (mut column_sums, mut column_derivatives) = ([0.0_f32; STRIDE], [0.0_f32; STRIDE]);
    let (mut total, mut strongest, mut rows_beside) = (Moments::default(), f32x4::ZERO, 0.0_f32);
    let mut brightest = f32x4::ZERO;
    let rows = crop.rows.iter().enumerate().zip(left.iter_mut());
    for ((j, pixels), left) in rows.take(crop.height) {
        let dy = j as f32 - y;
        image.draw_row(template, comb, x, dy);
        for ((l, p), f) in left
            .iter_mut()
            .zip(pixels)
            .zip(&image.value)
            .take(lanes_end)
        {
            *l = p - background - amplitude * f;
        }
        for column in crop.left_out(j) {
            left[column.min(STRIDE - 1)] = 0.0;
        }
        let is_beside = dy.abs() > beside;
        rows_beside += f32::from(u8::from(is_beside));
        let mut row = Moments::default();
        let chunks = (0..lanes_end).step_by(LANES);
        for k in chunks {
            let four = |from: &[f32]| {
                f32x4::from(<[f32; LANES]>::try_from(&from[k..k + LANES]).unwrap_or_default())
            };
            let m = four(&crop.mask);
            let (r, u) = (m * four(left), four(&across));
            let (f, fx, fy) = (
                m * four(&image.value),
                m * four(&image.by_x),
                m * four(&image.by_y),
            );
            strongest = strongest.max(r.abs());
            brightest = brightest.max(in_core(f) * (r + f * amplitude).abs());
            row.add(r, (u, m), f, (fx, fy), (u + (u0 - x), dy), four(&away));
            let columns = column_sums.iter_mut().zip(&mut column_derivatives).skip(k);
            for ((sum, derivative), (r, fx)) in
                columns.zip(r.to_array().into_iter().zip(fx.to_array()))
            {
                *sum += if is_beside { r } else { 0.0 };
                *derivative += fx;
            }
        }
        row_sums[j] = row.beside.reduce_add();
        row_derivatives[j] = row.fy.reduce_add();
        total.take_row(&row, j as f32 - v0);
    }
    let n = (crop.width * crop.height) as f64;
    let sums = total.sums();
    let (height, width) = (crop.height, crop.width);
    Left {
        stretch: total.stretch(),
        brightest: f64::from(brightest.to_array().into_iter().fold(0.0, f32::max)),
        contrast: f64::from(amplitude).powi(2) * (sums.ff - sums.f * sums.f / n),
        strongest: strongest.to_array().into_iter().fold(0.0, f32::max),
        scores: sums.scores(n),
        local_variance: sums.weighted / (sums.xx + sums.yy).max(1e-12),
        lines: [
            Lines::of(
                &row_sums[..height],
                &[beside_in_row; STRIDE][..height],
                &row_derivatives[..height],
                sums.yy,
                amplitude,
            ),
            Lines::of(
                &column_sums[..width],
                &[rows_beside; STRIDE][..width],
                &column_derivatives[..width],
                sums.xx,
                amplitude,
            ),
        ],
    }
}

/// 1 in the bead's core, 0 elsewhere.
fn in_core(light: f32x4) -> f32x4 {
    let sharp = (light - f32x4::splat(CORE)) * f32x4::splat(1e6);
    sharp.max(f32x4::ZERO).min(f32x4::ONE)
}

/// Sums over pixels, lane by lane: r is what is left, u and v the distance from the middle, s the derivative by size.
#[derive(Clone, Copy, Default)]
struct Moments {
    r: f32x4,
    ur: f32x4,
    vr: f32x4,
    sr: f32x4,
    /// Derivatives by a stretch along row and column, and along the diagonals.
    pr: f32x4,
    qr: f32x4,
    pp: f32x4,
    qq: f32x4,
    fy: f32x4,
    ux: f32x4,
    vy: f32x4,
    xx: f32x4,
    yy: f32x4,
    ss: f32x4,
    sf: f32x4,
    f: f32x4,
    ff: f32x4,
    s: f32x4,
    uu: f32x4,
    vv: f32x4,
    weighted: f32x4,
    beside: f32x4,
    count: f32x4,
}

/// The same summed up.
struct Sums {
    ur: f64,
    vr: f64,
    sr: f64,
    ux: f64,
    vy: f64,
    xx: f64,
    yy: f64,
    ss: f64,
    sf: f64,
    f: f64,
    ff: f64,
    s: f64,
    uu: f64,
    vv: f64,
    weighted: f64,
}

impl Moments {
    #[inline(always)]
    fn add(
        &mut self,
        r: f32x4,
        (u, m): (f32x4, f32x4),
        f: f32x4,
        (fx, fy): (f32x4, f32x4),
        (dx, dy): (f32x4, f32),
        away: f32x4,
    ) {
        let s = dx * fx + f32x4::splat(dy) * fy;
        let (xx, yy) = (fx * fx, fy * fy);
        self.r += r;
        self.ur += u * r;
        self.sr += s * r;
        let p = dx * fx - f32x4::splat(dy) * fy;
        let q = dx * fy + f32x4::splat(dy) * fx;
        self.pr += p * r;
        self.qr += q * r;
        self.pp += p * p;
        self.qq += q * q;
        self.fy += fy;
        self.ux += u * fx;
        self.xx += xx;
        self.yy += yy;
        self.ss += s * s;
        self.sf += s * f;
        self.f += f;
        self.ff += f * f;
        self.s += s;
        self.uu += u * u;
        self.weighted += (xx + yy) * r * r;
        self.beside += away * r;
        self.count += m;
    }

    /// A row at a distance from the middle one.
    fn take_row(&mut self, row: &Moments, v: f32) {
        let v = f32x4::splat(v);
        self.ur += row.ur;
        self.vr += v * row.r;
        self.sr += row.sr;
        self.pr += row.pr;
        self.qr += row.qr;
        self.pp += row.pp;
        self.qq += row.qq;
        self.ux += row.ux;
        self.vy += v * row.fy;
        self.xx += row.xx;
        self.yy += row.yy;
        self.ss += row.ss;
        self.sf += row.sf;
        self.f += row.f;
        self.ff += row.ff;
        self.s += row.s;
        self.uu += row.uu;
        self.vv += v * v * row.count;
        self.weighted += row.weighted;
    }

    /// Scores of a stretch along the row and across the column, and of one along the diagonals.
    fn stretch(&self) -> [f64; 2] {
        let t = |lanes: f32x4| f64::from(lanes.reduce_add());
        let score = |sum: f32x4, own: f32x4| t(sum) / t(own).max(1e-12).sqrt();
        [score(self.pr, self.pp), score(self.qr, self.qq)]
    }

    fn sums(&self) -> Sums {
        let t = |lanes: f32x4| f64::from(lanes.reduce_add());
        Sums {
            ur: t(self.ur),
            vr: t(self.vr),
            sr: t(self.sr),
            ux: t(self.ux),
            vy: t(self.vy),
            xx: t(self.xx),
            yy: t(self.yy),
            ss: t(self.ss),
            sf: t(self.sf),
            f: t(self.f),
            ff: t(self.ff),
            s: t(self.s),
            uu: t(self.uu),
            vv: t(self.vv),
            weighted: t(self.weighted),
        }
    }
}

impl Sums {
    /// Slopes and size, each beside what the fit had: the place for the slopes, contrast and level for the size.
    fn scores(&self, n: f64) -> [f64; 3] {
        let slope = |score: f64, own: f64, mixed: f64, place: f64| {
            score / (own - mixed * mixed / place.max(1e-12)).max(1e-12).sqrt()
        };
        let (ss, sf, ff) = (
            self.ss - self.s * self.s / n,
            self.sf - self.s * self.f / n,
            self.ff - self.f * self.f / n,
        );
        [
            slope(self.ur, self.uu, self.ux, self.xx),
            slope(self.vr, self.vv, self.vy, self.yy),
            slope(self.sr, ss, sf, ff),
        ]
    }
}
