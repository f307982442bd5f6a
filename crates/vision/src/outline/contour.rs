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

/// From this share of a step on another step is like it.
const ALIKE: f32 = 0.65;

/// The best that leads to each step of a ray, with room beyond both ends, which nothing comes from.
pub(super) type Way = [f32; MAX_STEPS + 2 * MOST_BEND];
pub(super) const NO_WAY: Way = [f32::NEG_INFINITY; MAX_STEPS + 2 * MOST_BEND];

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
        self.rays = ((perimeter_px / 1.5) as usize)
            .next_multiple_of(8)
            .clamp(MIN_RAYS, MAX_RAYS);
        // It is laid through every other one where these are many, and refined with the last fit.
        let many = self.rays >= 2 * MIN_RAYS && !self.thorough;
        let every = if many { 2 } else { 1 };
        let rays = self.rays / every;
        let inward_px = (0.65 * b).max(b.min(8.0) - 1.0);
        let outward_px = 0.3 * b + 3.0;
        let step_px = ((inward_px + outward_px) / (MAX_STEPS - 1) as f64).max(STEP_PX);
        self.steps = (((inward_px + outward_px) / step_px) as usize + 1).min(MAX_STEPS);
        for ray in 0..rays {
            let (from, step) = Self::ray(start, (ray, rays), inward_px, step_px);
            let samples = self
                .samples
                .get_mut(ray)
                .and_then(|all| all.get_mut(..self.steps));
            if let Some(samples) = samples {
                contrast.along(from, step, samples);
            }
        }
        self.find_steps(rays);
        let ((dark, dark_at), (bright, bright_at)) =
            (self.potential(rays, 1.0), self.potential(rays, -1.0));
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
        self.score(rays, polarity as f32, noise as f32, step_px as f32);
        // Twice as far from ray to ray the contour bends twice as much.
        self.walk(rays, typical / every as f32);
        self.points.clear();
        for ray in 0..rays {
            let ((x, y), (dx, dy)) = Self::ray(start, (ray, rays), inward_px, step_px);
            let at = self.shifts.get(ray).copied().unwrap_or(0.0);
            self.points.push((x + at * dx, y + at * dy));
        }
        Some(polarity)
    }

    /// One ray of the given number, in steps from inside to outside.
    fn ray(start: &Start, (ray, rays): (usize, usize), inward_px: f64, step_px: f64) -> Ray {
        let (sin, cos) = (core::f64::consts::TAU * ray as f64 / rays as f64).sin_cos();
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
    fn find_steps(&mut self, rays: usize) {
        let steps = self.steps;
        for (samples, found) in self.samples.iter().zip(&mut self.scores).take(rays) {
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

    /// Means over the rays of the largest step of a sign, and of its place.
    fn potential(&self, rays: usize, sign: f32) -> (f32, f32) {
        let (mut sum, mut places) = (0.0, 0.0);
        for found in self.scores.iter().take(rays) {
            let (mut at, mut most) = (0, 0.0);
            for (k, step) in found.iter().enumerate().take(self.steps).skip(1) {
                if sign * step > most {
                    (at, most) = (k, sign * step);
                }
            }
            sum += most;
            places += at as f32;
        }
        let n = rays.max(1) as f32;
        (sum / n, places / n)
    }

    /// The evidence for the contour at each step of each ray, in place of the steps: the step there, less the contrast of the
    /// body's sign outside.
    fn score(&mut self, rays: usize, polarity: f32, noise: f32, step_px: f32) {
        let steps = self.steps;
        for (samples, scores) in self.samples.iter().zip(&mut self.scores).take(rays) {
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
    fn walk(&mut self, rays: usize, typical: f32) {
        let steps = self.steps;
        let costs: [f32; 2 * MOST_BEND + 1] =
            core::array::from_fn(|d| BEND * typical * (d.abs_diff(MOST_BEND) as f32).powi(2));
        let mut best = NO_WAY;
        best[MOST_BEND..MOST_BEND + steps].fill(0.0);
        for n in 0..rays + OVERLAP {
            let (Some(scores), Some(way)) = (self.scores.get(n % rays), self.ways.get_mut(n))
            else {
                return;
            };
            *way = best;
            let mut top = [f32::NEG_INFINITY; MAX_STEPS];
            for (d, cost) in costs.iter().enumerate() {
                for (top, before) in top.iter_mut().zip(&way[d..]) {
                    let value = before - cost;
                    *top = if value > *top { value } else { *top };
                }
            }
            for k in 0..steps {
                best[k + MOST_BEND] = top[k] + scores[k];
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
            let Some(way) = self.ways.get(n) else { return };
            let from = |d: &usize| way[k + d] - costs[*d];
            let d = (0..costs.len()).max_by(|a, b| from(a).total_cmp(&from(b)));
            k = (k + d.unwrap_or(MOST_BEND))
                .saturating_sub(MOST_BEND)
                .min(steps - 1);
        }
    }
}

const _: () = assert!(MIN_RAYS > OVERLAP && MAX_RAYS >= MIN_RAYS);
