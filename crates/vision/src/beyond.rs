//! What a fit of place, contrast and level leaves out of a window: light that rises across it, and a bead out of focus, whose
//! image is larger or smaller than the template.
//!
//! Light that rises draws the fit to its side. A template of another size weights the pixels wrongly, and between the pixels
//! it is off its own centre. Both are nuisance parameters, and a window that does not need them would lose certainty by
//! them: they are fitted where a score test finds them.

use crate::crop::{Crop, LANES, Row, STRIDE};
use crate::fit::{Image, Pass, Weights};
use crate::offsets::Lines;
use crate::streak::Comb;
use crate::template::Template;
use nalgebra::{SMatrix, SVector};
use wide::f32x4;

/// Standard deviations from which the light's slope is fitted, and the size. What is missed below moves the bead by 2.5 of them
/// times its correlation with the place, which is 0.27 in the narrowest default window: by less than one standard deviation.
const LEAST_SLOPE: f64 = 2.5;
const LEAST_SIZE: f64 = 3.0;
/// Largest size that another focus makes of a bead, and its inverse the smallest. Farther off the rest of the picture has
/// changed, too, and beads of other sizes are others.
const MOST_SIZE: f64 = 1.25;
/// Share of what a fit leaves beyond noise that the parameters must explain: where something else is wrong they bend to it.
const LEAST_EXPLAINED: f64 = 0.3;
/// Steps of the fit, and when it is at rest: place in px, size as a fraction.
const MOST_STEPS: usize = 4;
const AT_REST: (f64, f64) = (0.01, 0.005);
/// Parameters: x, y, contrast, level, slopes of the light along row and column, size.
const ALL: usize = 7;

const NONE: Asked = Asked {
    slopes: false,
    size: false,
};

/// What a fit leaves of a window.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Left {
    /// Largest difference, grey levels.
    pub strongest: f32,
    /// Score tests, in standard deviations of noise of variance 1 grey^2: slope along the row, along the column, size.
    scores: [f64; 3],
    /// Variance of a pixel where the place is read off: weighted by the squares of the template's derivatives, grey^2.
    pub local_variance: f64,
    /// Of rows and of columns.
    pub lines: [Lines; 2],
}

impl Left {
    /// What the window asks for besides place, contrast and level, where noise of a variance is all that is left.
    pub(crate) fn asks(&self, variance: f64) -> Asked {
        let [along, down, size] = self.scores.map(|z| z * z / variance);
        Asked {
            slopes: along.max(down) > LEAST_SLOPE * LEAST_SLOPE,
            size: size > LEAST_SIZE * LEAST_SIZE,
        }
    }
}

/// Nuisance parameters to fit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Asked {
    pub slopes: bool,
    pub size: bool,
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
            row.add(r, u, f, (fx, fy), (u + (u0 - x), dy), four(&away));
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

/// Sums over pixels, lane by lane: r is what is left, u and v the distance from the middle, s the derivative by size.
#[derive(Clone, Copy, Default)]
struct Moments {
    r: f32x4,
    ur: f32x4,
    vr: f32x4,
    sr: f32x4,
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
        u: f32x4,
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
        self.count += f32x4::ONE;
    }

    /// A row at a distance from the middle one.
    fn take_row(&mut self, row: &Moments, v: f32) {
        let v = f32x4::splat(v);
        self.ur += row.ur;
        self.vr += v * row.r;
        self.sr += row.sr;
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

/// The fit of all parameters, from one of place, contrast and level on. Leaves the window without the slope and the template at
/// the size found, and gives the slope; `None` where the window does not tell the parameters apart, or they explain too little: then both are as
/// before. `start` is the place, and how much of the sum of squares is more than noise.
pub(crate) fn fit(
    crop: &mut Crop,
    template: &mut Template,
    comb: &Comb,
    start: ((f64, f64), f64),
    weights: Weights,
    asked: Asked,
) -> Option<(f64, f64, Pass, (f64, f64))> {
    let (at, misfit) = start;
    let before = pass(crop, template, comb, at, weights, NONE)?.0.chi2;
    let size_before = template.size();
    let reach_px = 0.4 * template.radius_px();
    let mut taken = (0.0, 0.0);
    let mut asked = asked;
    let (mut x_px, mut y_px) = at;
    let mut found = None;
    for n in 0..MOST_STEPS {
        let Some((pass, slope, size)) = pass(crop, template, comb, (x_px, y_px), weights, asked)
        else {
            found = None;
            break;
        };
        let step = f64::hypot(pass.step_x_px, pass.step_y_px);
        if step > reach_px {
            found = None;
            break;
        }
        (x_px, y_px) = (x_px + pass.step_x_px, y_px + pass.step_y_px);
        taken = (taken.0 + slope.0, taken.1 + slope.1);
        crop.take_off_slope(middle(crop), (slope.0 as f32, slope.1 as f32));
        let wanted = template.size() * (1.0 + size.clamp(-0.2, 0.2));
        let size = wanted.clamp(1.0 / MOST_SIZE, MOST_SIZE);
        let moved = (size / template.size() - 1.0).abs();
        // At the end of the range the size is no longer free.
        asked.size &= size == wanted;
        template.stretch_to(size);
        found = Some((x_px, y_px, pass));
        if step < AT_REST.0 && moved < AT_REST.1 && n > 0 {
            break;
        }
    }
    found = found.filter(|(_, _, pass)| before - pass.chi2 >= LEAST_EXPLAINED * misfit);
    if found.is_none() {
        crop.take_off_slope(middle(crop), (-taken.0 as f32, -taken.1 as f32));
        template.stretch_to(size_before);
    }
    found.map(|(x_px, y_px, pass)| (x_px, y_px, pass, taken))
}

/// One pass in all parameters: step and figures, change of the slopes, relative change of the size.
fn pass(
    crop: &Crop,
    template: &Template,
    comb: &Comb,
    (x_px, y_px): (f64, f64),
    weights: Weights,
    asked: Asked,
) -> Option<(Pass, (f64, f64), f64)> {
    let (x, y) = (
        (x_px - crop.x0 as f64) as f32,
        (y_px - crop.y0 as f64) as f32,
    );
    let (u0, v0) = middle(crop);
    let lanes_end = crop.width.next_multiple_of(LANES).min(STRIDE);
    let mut image = Image::new(lanes_end);
    let mut weight = weights.of_even(crop);
    let with_size = asked.size && comb.is_still();
    let slopes = f32::from(u8::from(asked.slopes));
    // The lower triangle, row by row, the right side, and the pixels' square.
    let (mut normal, mut right, mut square) = ([[0.0_f64; ALL]; ALL], [0.0_f64; ALL], 0.0_f64);
    for (j, pixels) in crop.rows.iter().enumerate().take(crop.height) {
        let dy = j as f32 - y;
        image.draw_row(template, comb, x, dy);
        weights.of_shot(crop, &image.value[..lanes_end], &mut weight);
        let mut with_holes = weight;
        for column in crop.left_out(j) {
            with_holes[column.min(STRIDE - 1)] = 0.0;
        }
        let (mut row, mut row_right, mut row_square) =
            ([[0.0_f32; ALL]; ALL], [0.0_f32; ALL], 0.0_f32);
        let parts = pixels.iter().zip(&with_holes).zip(&image.value);
        let parts = parts
            .zip(image.by_x.iter().zip(&image.by_y))
            .take(crop.width);
        for (i, (((p, w), f), (fx, fy))) in parts.enumerate() {
            let size = if with_size {
                (i as f32 - x) * fx + dy * fy
            } else {
                0.0
            };
            let g = [
                *fx,
                *fy,
                *f,
                1.0,
                slopes * (i as f32 - u0),
                slopes * (j as f32 - v0),
                size,
            ];
            for a in 0..ALL {
                let wg = w * g[a];
                for b in 0..=a {
                    row[a][b] += wg * g[b];
                }
                row_right[a] += wg * p;
            }
            row_square += w * p * p;
        }
        for a in 0..ALL {
            for b in 0..=a {
                normal[a][b] += f64::from(row[a][b]);
            }
            right[a] += f64::from(row_right[a]);
        }
        square += f64::from(row_square);
    }
    let mut matrix = SMatrix::<f64, ALL, ALL>::from_fn(|a, b| normal[a.max(b)][a.min(b)]);
    for k in 4..ALL {
        // A column that is not asked for.
        if matrix[(k, k)] == 0.0 {
            matrix[(k, k)] = 1.0;
        }
    }
    let right = SVector::<f64, ALL>::from(right);
    let inverse = matrix.cholesky()?.inverse();
    let solution = inverse * right;
    let amplitude = solution[2];
    let pass = Pass {
        step_x_px: solution[0] / amplitude,
        step_y_px: solution[1] / amplitude,
        amplitude,
        amplitude_variance: inverse[(2, 2)],
        // At the middle of the window.
        background: solution[3],
        chi2: square - solution.dot(&right),
        covariance: inverse.fixed_view::<2, 2>(0, 0) / (amplitude * amplitude),
    };
    let size = solution[6] / amplitude;
    let finite = pass.step_x_px.is_finite() && pass.step_y_px.is_finite() && pass.chi2.is_finite();
    (finite && size.is_finite()).then_some((pass, (solution[4], solution[5]), size))
}

fn middle(crop: &Crop) -> (f32, f32) {
    (
        0.5 * (crop.width as f32 - 1.0),
        0.5 * (crop.height as f32 - 1.0),
    )
}
