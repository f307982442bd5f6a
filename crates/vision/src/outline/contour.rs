//! The first contour: along the strongest consistent step from inside to outside.

use super::{BEND, Contrast, MAX_RAYS, MAX_STEPS, MIN_RAYS, OUTSIDE, OVERLAP, Outliner, Start};

/// Least distance of the steps along a ray, px.
const STEP_PX: f64 = 0.75;
/// Steps that a step of the contrast is measured over, on either side.
const REACH: usize = 3;
/// Most steps from ray to ray.
const MOST_BEND: usize = 3;
/// Standard deviations of the noise that the step must have on average.
const LEAST_STEP: f32 = 1.0;

/// A step is like another from this share of it on.
const ALIKE: f32 = 0.65;

/// A ray: where it begins, and its step (px).
type Ray = ((f64, f64), (f64, f64));

impl Outliner {
    /// Lays the contour: 1 for a step from dark to bright going out, -1 for one from bright to dark. `None` where there is
    /// no step worth the name.
    pub(super) fn lay(&mut self, contrast: &Contrast, start: &Start, noise: f64) -> Option<f64> {
        let (a, b) = (start.long_px, start.short_px);
        if !(a.is_finite() && b >= 2.0) {
            return None;
        }
        // Ramanujan's first approximation of the perimeter would be finer than is of use here.
        let perimeter_px = core::f64::consts::PI * (1.5 * (a + b) - (a * b).sqrt());
        self.rays = (((perimeter_px / 1.5) as usize).next_multiple_of(8)).clamp(MIN_RAYS, MAX_RAYS);
        let inward_px = (0.65 * b).max(b.min(8.0) - 1.0);
        let outward_px = 0.3 * b + 3.0;
        let step_px = ((inward_px + outward_px) / (MAX_STEPS - 1) as f64).max(STEP_PX);
        self.steps = (((inward_px + outward_px) / step_px) as usize + 1).min(MAX_STEPS);
        for ray in 0..self.rays {
            let ((mut x, mut y), (dx, dy)) = self.ray(start, ray, inward_px, step_px);
            let Some(samples) = self.samples.get_mut(ray) else {
                continue;
            };
            for value in samples.iter_mut().take(self.steps) {
                *value = contrast.at(x, y);
                (x, y) = (x + dx, y + dy);
            }
        }
        let ((dark, dark_at), (bright, bright_at)) = (self.potential(1.0), self.potential(-1.0));
        // Of two steps nearly alike it is the outer one: the inner one is that from the rim to the body.
        let outer = if dark_at >= bright_at { 1.0 } else { -1.0 };
        let polarity = if dark.min(bright) > ALIKE * dark.max(bright) {
            outer
        } else if dark >= bright {
            1.0
        } else {
            -1.0
        };
        let typical = if polarity > 0.0 { dark } else { bright };
        if typical < LEAST_STEP * noise as f32 {
            return None;
        }
        self.score(polarity as f32, noise as f32, step_px as f32);
        self.walk(typical);
        self.points.clear();
        for ray in 0..self.rays {
            let ((x, y), (dx, dy)) = self.ray(start, ray, inward_px, step_px);
            let at = self.shifts.get(ray).copied().unwrap_or(0.0);
            self.points.push((x + at * dx, y + at * dy));
        }
        Some(polarity)
    }

    fn ray(&self, start: &Start, ray: usize, inward_px: f64, step_px: f64) -> Ray {
        let (sin, cos) = (core::f64::consts::TAU * ray as f64 / self.rays as f64).sin_cos();
        let (s, c) = start.angle_rad.sin_cos();
        // Both axes grow by the step: the rays never cross.
        let (u, v) = (
            (start.long_px - inward_px) * cos,
            (start.short_px - inward_px) * sin,
        );
        let turned = |u: f64, v: f64| (c * u - s * v, s * u + c * v);
        let (x, y) = turned(u, v);
        let (dx, dy) = turned(step_px * cos, step_px * sin);
        ((start.x_px + x, start.y_px + y), (dx, dy))
    }

    /// Step of the contrast at `k`, going out.
    #[inline(always)]
    fn step(samples: &[f32; MAX_STEPS], k: usize, steps: usize) -> f32 {
        let (mut out, mut inside) = (0.0, 0.0);
        for j in 0..REACH {
            inside += samples[k.saturating_sub(j + 1)];
            out += samples[(k + j).min(steps - 1)];
        }
        (out - inside) / REACH as f32
    }

    /// Means over the rays of the largest step of a sign, and of where it is.
    fn potential(&self, sign: f32) -> (f32, f32) {
        let (mut sum, mut places) = (0.0, 0.0);
        for samples in self.samples.iter().take(self.rays) {
            let steps = (1..self.steps).map(|k| (k, sign * Self::step(samples, k, self.steps)));
            let (at, most) = steps.fold(
                (0, 0.0),
                |best, next| if next.1 > best.1 { next } else { best },
            );
            sum += most;
            places += at as f32;
        }
        let n = self.rays.max(1) as f32;
        (sum / n, places / n)
    }

    /// What speaks for the contour at each step of each ray: the step there, less what of the body's sign lies outside.
    fn score(&mut self, polarity: f32, noise: f32, step_px: f32) {
        let steps = self.steps;
        for (samples, scores) in self.samples.iter().zip(&mut self.scores).take(self.rays) {
            let mut outside = 0.0;
            let mut behind = [0.0_f32; MAX_STEPS];
            for k in (0..steps).rev() {
                behind[k] = outside;
                outside += (-polarity * samples[k] - 2.0 * noise).max(0.0) * step_px;
            }
            for (k, score) in scores.iter_mut().enumerate().take(steps) {
                let beyond = behind[(k + REACH - 1).min(steps - 1)];
                *score = polarity * Self::step(samples, k, steps) - OUTSIDE * beyond;
            }
        }
    }

    /// The best closed contour through the scores, into `shifts`.
    fn walk(&mut self, typical: f32) {
        let (rays, steps) = (self.rays, self.steps);
        let bend = BEND * typical;
        let mut best = [0.0_f32; MAX_STEPS];
        for n in 0..rays + OVERLAP {
            let Some(scores) = self.scores.get(n % rays).copied() else {
                return;
            };
            let Some(from) = self.from.get_mut(n) else {
                return;
            };
            let before = best;
            for k in 0..steps {
                let (low, high) = (k.saturating_sub(MOST_BEND), (k + MOST_BEND + 1).min(steps));
                let (mut top, mut at) = (f32::NEG_INFINITY, k);
                for (j, value) in before.iter().enumerate().take(high).skip(low) {
                    let d = j.abs_diff(k) as f32;
                    let value = value - bend * d * d;
                    if value > top {
                        (top, at) = (value, j);
                    }
                }
                best[k] = top + scores[k];
                from[k] = at as u8;
            }
        }
        let mut k = (0..steps)
            .max_by(|a, b| best[*a].total_cmp(&best[*b]))
            .unwrap_or(0);
        for n in (0..rays + OVERLAP).rev() {
            // The first and the last of the way round are only there to close it.
            if n >= OVERLAP / 2
                && n < rays + OVERLAP / 2
                && let Some(shift) = self.shifts.get_mut(n % rays)
            {
                *shift = k as f64 - 0.5;
            }
            k = self.from.get(n).map_or(0, |from| usize::from(from[k]));
        }
    }
}

const _: () = assert!(MAX_STEPS <= u8::MAX as usize && MIN_RAYS > OVERLAP && MAX_RAYS >= MIN_RAYS);
