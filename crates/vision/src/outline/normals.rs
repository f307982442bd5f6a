//! Profiles along the contour's normals, and the mean one that they are fitted by.

use super::smear::WAYS;
use super::{Contrast, FINE_PX, MAX_FINE, Outliner};
use nalgebra::{Matrix3, Vector3};

/// Values along a normal, from inside to outside.
pub(super) type Values = [f32; 2 * MAX_FINE + 1];

/// Farthest that a normal's profile is shifted in one pass, px.
const MOST_SHIFT_PX: f64 = 1.0;
/// Share of the pixels' noise variance that remains in a shift: values between the pixels are means of pixels.
const INTERPOLATED: f64 = 0.75;
/// Amplitudes of a normal's profile that count as the same rim, relative to the mean one.
pub(super) const AMPLITUDES: (f64, f64) = (0.25, 4.0);

/// The mean profile along the normals.
#[derive(Debug, Clone, Copy)]
pub(super) struct Profile {
    pub(super) values: [f64; 2 * MAX_FINE + 1],
    slopes: [f64; 2 * MAX_FINE + 1],
    /// Steps on one side.
    pub(super) half: usize,
    /// 1 for a dark rim: outside is brighter.
    pub(super) polarity: f64,
    /// Steps that the edge is wider on either side than rim and halo say: of a profile that is smeared.
    wider: usize,
}

impl Outliner {
    /// Outward normals of the contour, from neighbours two points of the full contour away on either side.
    pub(super) fn find_normals(&mut self) {
        let n = self.points.len();
        let away = if 2 * n > self.rays { 2 } else { 1 };
        self.normals.clear();
        for i in 0..n {
            let (a, b) = (self.points[(i + n - away) % n], self.points[(i + away) % n]);
            let (tx, ty) = (b.0 - a.0, b.1 - a.1);
            let length = (tx * tx + ty * ty).sqrt().max(1e-9);
            // The rays go round in the sense that has the outside on this side.
            self.normals.push((ty / length, -tx / length));
        }
    }

    pub(super) fn sample(&mut self, contrast: &Contrast, half: usize) {
        let rays = self
            .points
            .iter()
            .zip(&self.normals)
            .zip(&mut self.profiles);
        for ((p, n), values) in rays {
            let s = half as f64 * FINE_PX;
            let start = (p.0 - s * n.0, p.1 - s * n.1);
            let values = values.get_mut(..2 * half + 1).unwrap_or(&mut []);
            contrast.along(start, (FINE_PX * n.0, FINE_PX * n.1), values);
        }
    }

    /// Mean profile, and each normal's shift against it by least squares, with amplitude and offset, into `shifts`.
    pub(super) fn align(&mut self, half: usize, polarity: f64) -> Option<Profile> {
        let profile = self.mean(half, polarity);
        let mut fits = [const { None }; WAYS + 1];
        for (fit, profile) in fits.iter_mut().zip(&self.smear.profiles) {
            *fit = profile.least_squares();
        }
        let mut previous = 0.0;
        for i in 0..self.points.len() {
            let which = self.normals.get(i).map_or(0, |n| self.smear.which(n));
            let (Some(values), Some(shift), Some(amplitude)) = (
                self.profiles.get(i),
                self.shifts.get_mut(i),
                self.amplitudes.get_mut(i),
            ) else {
                break;
            };
            let fit = fits.get(which).and_then(Option::as_ref);
            let fitted = fit.and_then(|fit: &LeastSquares| fit.of(values));
            let (found, a) = fitted.unwrap_or((previous, 1.0));
            previous = found;
            (*shift, *amplitude) = (found, a);
        }
        Some(profile)
    }

    /// Moves each point by its shift, smoothed with its neighbours', and says how far (RMS, px).
    pub(super) fn shift_points(&mut self) -> f64 {
        let n = self.points.len();
        let mut squares = 0.0;
        for i in 0..n {
            let at = |k: usize| self.shifts.get(k % n).copied().unwrap_or(0.0);
            let shift = 0.25 * at(i + n - 1) + 0.5 * at(i) + 0.25 * at(i + 1);
            squares += shift * shift;
            if let (Some(p), Some(m)) = (self.points.get_mut(i), self.normals.get(i)) {
                *p = (p.0 + shift * m.0, p.1 + shift * m.1);
            }
        }
        (squares / n.max(1) as f64).sqrt()
    }

    /// Puts a point between each two of a contour that was drawn through half of them, on the cubic through four.
    pub(super) fn refine(&mut self) {
        let n = self.points.len();
        if 2 * n > self.rays {
            return;
        }
        self.sorted.clear();
        self.sorted.extend(&self.points);
        self.points.clear();
        let at = |k: usize| self.sorted.get(k % n).copied().unwrap_or_default();
        for k in 0..n {
            let ((ax, ay), (bx, by)) = (at(k + n - 1), at(k));
            let ((cx, cy), (dx, dy)) = (at(k + 1), at(k + 2));
            let middle = |a: f64, b: f64, c: f64, d: f64| (9.0 * (b + c) - a - d) / 16.0;
            self.points.push((bx, by));
            self.points
                .push((middle(ax, bx, cx, dx), middle(ay, by, cy, dy)));
        }
    }

    /// Moves all points along their normals.
    pub(super) fn shift_outwards(&mut self, shift_px: f64) {
        for (p, n) in self.points.iter_mut().zip(&self.normals) {
            *p = (p.0 + shift_px * n.0, p.1 + shift_px * n.1);
        }
    }

    /// Mean square of the normals' profiles less the mean profile, grey^2.
    pub(super) fn residual(&self) -> f64 {
        let (mut sum, mut n) = (0.0, 0.0);
        let rays = self.profiles.iter().zip(&self.shifts).zip(&self.amplitudes);
        let rays = rays.zip(&self.normals).take(self.points.len());
        for (((values, shift), a), normal) in rays {
            let which = self.smear.which(normal);
            let Some(profile) = self.smear.profiles.get(which) else {
                continue;
            };
            let (low, high) = profile.window();
            let (mut mean, mut square) = (0.0, 0.0);
            let means = profile.values.iter().zip(&profile.slopes);
            let pairs = values.iter().zip(means).take(high + 1).skip(low);
            for (v, (mean_v, slope)) in pairs {
                let left = f64::from(*v) - a * (mean_v - shift * slope);
                mean += left;
                square += left * left;
            }
            // The offset and two more are fitted.
            let count = (high - low + 1) as f64;
            sum += square - mean * mean / count;
            n += count - 3.0;
        }
        sum / f64::max(n, 1.0)
    }
}

impl Profile {
    pub(super) fn new(
        values: [f64; 2 * MAX_FINE + 1],
        half: usize,
        polarity: f64,
        wider: usize,
    ) -> Self {
        let mut slopes = [0.0; 2 * MAX_FINE + 1];
        for (k, slope) in slopes.iter_mut().enumerate().take(2 * half + 1) {
            let (a, b) = (k.saturating_sub(1), (k + 1).min(2 * half));
            *slope = (values[b] - values[a]) / ((b - a) as f64 * FINE_PX);
        }
        Profile {
            values,
            slopes,
            half,
            polarity,
            wider,
        }
    }

    /// Width of the edge, from the rim to the halo, at least a pixel.
    pub(super) fn edge_width_px(&self) -> f64 {
        (self.halo().saturating_sub(self.rim()) as f64 * FINE_PX).max(1.0)
    }

    /// Steps between which the edge lies: from the rim to the halo, and a little on either side.
    pub(super) fn window(&self) -> (usize, usize) {
        let (rim, halo) = (self.rim(), self.halo());
        let margin = (1.0 / FINE_PX) as usize + self.wider;
        let low = rim.saturating_sub(margin).min(self.half - 2);
        let high = (halo + margin).min(2 * self.half).max(self.half + 2);
        (low, high)
    }

    /// Step of the rim's largest contrast, inside the middle.
    pub(super) fn rim(&self) -> usize {
        self.extreme(0..=self.half, -self.polarity)
    }

    /// Step of the halo's largest contrast, outside the middle.
    pub(super) fn halo(&self) -> usize {
        self.extreme(self.half..=2 * self.half, self.polarity)
    }

    /// The extreme nearest to the middle: the first local one that reaches nine tenths of the largest.
    fn extreme(&self, range: core::ops::RangeInclusive<usize>, sign: f64) -> usize {
        let value = |k: usize| sign * self.values[k];
        let most = range.clone().map(value).fold(f64::NEG_INFINITY, f64::max);
        let middle = sign * self.values[self.half];
        let enough = middle + 0.9 * (most - middle);
        range
            .filter(|k| value(*k) >= enough)
            .min_by_key(|k| k.abs_diff(self.half))
            .unwrap_or(self.half)
    }

    /// The fit of a profile by this one: v(s) = a T(s - shift) + b, to first order a T - a shift T' + b.
    fn least_squares(&self) -> Option<LeastSquares> {
        let (low, high) = self.window();
        // From the edge's first step on.
        let mut shapes = [[0.0_f32; 2 * MAX_FINE + 1]; 2];
        let mut normal = Matrix3::zeros();
        for k in low..=high {
            let g = Vector3::new(self.values[k], -self.slopes[k], 1.0);
            normal += g * g.transpose();
            (shapes[0][k - low], shapes[1][k - low]) = (g[0] as f32, g[1] as f32);
        }
        // A little towards the mean profile's amplitude, so that a featureless stretch is not followed.
        let ridge = 0.05 * normal[(0, 0)];
        normal[(0, 0)] += ridge;
        Some(LeastSquares {
            shapes,
            inverse: normal.cholesky()?.inverse(),
            ridge,
            low,
            high,
        })
    }

    /// Information on a shift per px of contour, for pixels with noise of variance 1, amplitude and offset unknown.
    pub(super) fn information(&self) -> f64 {
        let (low, high) = self.window();
        let mut normal = Matrix3::zeros();
        for k in low..=high {
            let g = Vector3::new(self.values[k], -self.slopes[k], 1.0);
            normal += g * g.transpose();
        }
        let variance = normal.cholesky().map(|c| c.inverse()[(1, 1)]);
        variance.map_or(f64::MIN_POSITIVE, |v| FINE_PX / (INTERPOLATED * v))
    }
}

/// Shapes and inverse of the normal equations, the same for all normals.
struct LeastSquares {
    /// Mean profile and its slope from `low` to `high`.
    shapes: [[f32; 2 * MAX_FINE + 1]; 2],
    inverse: Matrix3<f64>,
    ridge: f64,
    low: usize,
    high: usize,
}

impl LeastSquares {
    /// Shift of a profile, px outwards, and its amplitude.
    fn of(&self, values: &Values) -> Option<(f64, f64)> {
        let values = values.get(self.low..=self.high)?;
        let all: f32 = values.iter().sum();
        let [mean, slope] = &self.shapes;
        let right = Vector3::new(
            f64::from(dot(values, mean)) + self.ridge,
            f64::from(dot(values, slope)),
            f64::from(all),
        );
        let solution = self.inverse * right;
        let amplitude = solution[0].clamp(AMPLITUDES.0, AMPLITUDES.1);
        let shift = (solution[1] / amplitude).clamp(-MOST_SHIFT_PX, MOST_SHIFT_PX);
        shift.is_finite().then_some((shift, amplitude))
    }
}

/// Sum of the products of as many as both have, in four sums side by side.
pub(super) fn dot(a: &[f32], b: &[f32]) -> f32 {
    let count = a.len().min(b.len());
    let (a, b) = (&a[..count], &b[..count]);
    let ((a, a_left), (b, b_left)) = (a.as_chunks::<4>(), b.as_chunks::<4>());
    let mut sums = [0.0_f32; 4];
    for (a, b) in a.iter().zip(b) {
        for ((sum, a), b) in sums.iter_mut().zip(a).zip(b) {
            *sum += a * b;
        }
    }
    let left: f32 = a_left.iter().zip(b_left).map(|(a, b)| a * b).sum();
    sums[0] + sums[1] + (sums[2] + sums[3]) + left
}
