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
            let (from, step) = self.ray(start, ray, inward_px, step_px);
            let samples = self
                .samples
                .get_mut(ray)
                .and_then(|all| all.get_mut(..self.steps));
            if let Some(samples) = samples {
                contrast.along(from, step, samples);
            }
        }
        self.find_steps();
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

    /// Steps of the contrast at each place of each ray, going out, into `scores`.
    fn find_steps(&mut self) {
        let steps = self.steps;
        for (samples, found) in self.samples.iter().zip(&mut self.scores).take(self.rays) {
            // The ends go on as they are.
            let mut padded = [samples[steps - 1]; MAX_STEPS + 2 * REACH];
            padded[..REACH].fill(samples[0]);
            padded[REACH..REACH + steps].copy_from_slice(&samples[..steps]);
            for (k, step) in found.iter_mut().enumerate() {
                let (mut out, mut inside) = (0.0, 0.0);
                for j in 0..REACH {
                    inside += padded[k + j];
                    out += padded[k + REACH + j];
                }
                *step = (out - inside) / REACH as f32;
            }
        }
    }

    /// Means over the rays of the largest step of a sign, and of where it is.
    fn potential(&self, sign: f32) -> (f32, f32) {
        let (mut sum, mut places) = (0.0, 0.0);
        for found in self.scores.iter().take(self.rays) {
            let (mut at, mut most) = (0, 0.0);
            for (k, step) in found.iter().enumerate().take(self.steps).skip(1) {
                if sign * step > most {
                    (at, most) = (k, sign * step);
                }
            }
            sum += most;
            places += at as f32;
        }
        let n = self.rays.max(1) as f32;
        (sum / n, places / n)
    }

    /// What speaks for the contour at each step of each ray, in the place of the steps: the step there, less what of the body's sign lies outside.
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
                *score = polarity * *score - OUTSIDE * beyond;
            }
        }
    }

    /// The best closed contour through the scores, into `shifts`.
    fn walk(&mut self, typical: f32) {
        let (rays, steps) = (self.rays, self.steps);
        let bend = BEND * typical;
        // With room for steps beyond both ends, which nothing comes from.
        let mut best = [f32::NEG_INFINITY; MAX_STEPS + 2 * MOST_BEND];
        best[MOST_BEND..MOST_BEND + steps].fill(0.0);
        for n in 0..rays + OVERLAP {
            let Some(scores) = self.scores.get(n % rays) else {
                return;
            };
            let Some(from) = self.from.get_mut(n) else {
                return;
            };
            let (mut top, mut at) = ([f32::NEG_INFINITY; MAX_STEPS], [0_i32; MAX_STEPS]);
            for d in 0..=2 * MOST_BEND {
                let off = d.abs_diff(MOST_BEND) as f32;
                let cost = bend * off * off;
                for k in 0..MAX_STEPS {
                    let value = best[k + d] - cost;
                    let better = value > top[k];
                    top[k] = if better { value } else { top[k] };
                    at[k] = if better { d as i32 } else { at[k] };
                }
            }
            for k in 0..steps {
                best[k + MOST_BEND] = top[k] + scores[k];
                from[k] = (k + at[k] as usize).saturating_sub(MOST_BEND) as u8;
            }
        }
        let mut k = (0..steps)
            .max_by(|a, b| best[*a + MOST_BEND].total_cmp(&best[*b + MOST_BEND]))
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
