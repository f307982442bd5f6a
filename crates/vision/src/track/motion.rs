//! Predicted motion of one object: commanded flow plus an unexplained velocity, with Brownian motion.

use super::config::TrackerConfig;
use crate::fix::Fix;

/// The least standard deviation granted to a fix, px: a template is never exact.
const LEAST_FIX_SD_PX: f64 = 0.02;
/// Standard deviation of the unexplained velocity at the start, px/s.
const START_VELOCITY_SD: f64 = 300.0;

/// Largest squared distance that counts in a comparison of readings.
const MOST_DISTANCE2: f64 = 16.0;

/// Random parts of the motion.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Randomness {
    pub diffusion_px2_per_s: f64,
    /// Random walk of the unexplained velocity: px/s per square root of a second.
    pub velocity_walk: f64,
    /// Share of the commanded displacement that may be wrong.
    pub flow_error: f64,
}

impl Randomness {
    pub fn of(config: &TrackerConfig) -> Self {
        Randomness {
            diffusion_px2_per_s: config.diffusion_px2_per_s,
            velocity_walk: config.velocity_walk_px_per_s15,
            flow_error: config.flow_error,
        }
    }
}

/// Position and unexplained velocity along one axis, with covariance (Kalman filter).
#[derive(Debug, Clone, Copy)]
struct Axis {
    p: f64,
    v: f64,
    pp: f64,
    pv: f64,
    vv: f64,
}

impl Axis {
    fn new(p: f64, var: f64) -> Self {
        Axis {
            p,
            v: 0.0,
            pp: var,
            pv: 0.0,
            vv: START_VELOCITY_SD * START_VELOCITY_SD,
        }
    }

    fn predict(&mut self, dt_s: f64, flow: f64, r: &Randomness) {
        self.p += dt_s * (self.v + flow);
        let flow_sd = r.flow_error * flow * dt_s;
        self.pp += dt_s * (2.0 * self.pv + dt_s * self.vv)
            + 2.0 * r.diffusion_px2_per_s * dt_s
            + flow_sd * flow_sd;
        self.pv += dt_s * self.vv;
        self.vv += r.velocity_walk * r.velocity_walk * dt_s;
    }

    fn update(&mut self, innovation: f64, fix_var: f64) {
        let s = self.pp + fix_var;
        let (kp, kv) = (self.pp / s, self.pv / s);
        self.p += kp * innovation;
        self.v += kv * innovation;
        self.vv -= kv * self.pv;
        self.pv *= 1.0 - kp;
        self.pp *= 1.0 - kp;
    }
}

/// Motion in the plane. The axes are filtered apart: the fit's cross covariance is small.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Motion {
    x: Axis,
    y: Axis,
}

impl Motion {
    pub fn new(fix: &Fix) -> Self {
        let (rx, ry) = variances(fix);
        Motion {
            x: Axis::new(fix.x_px, rx),
            y: Axis::new(fix.y_px, ry),
        }
    }

    pub fn predict(&mut self, dt_s: f64, (flow_x, flow_y): (f64, f64), randomness: &Randomness) {
        self.x.predict(dt_s, flow_x, randomness);
        self.y.predict(dt_s, flow_y, randomness);
    }

    pub fn position(&self) -> (f64, f64) {
        (self.x.p, self.y.p)
    }

    /// Standard deviation of the predicted position, the larger axis, px.
    pub fn sd_px(&self) -> f64 {
        self.x.pp.max(self.y.pp).sqrt()
    }

    /// Squared innovation over its variance, both axes.
    pub fn distance2(&self, fix: &Fix) -> f64 {
        let (rx, ry) = variances(fix);
        (fix.x_px - self.x.p).powi(2) / (self.x.pp + rx)
            + (fix.y_px - self.y.p).powi(2) / (self.y.pp + ry)
    }

    /// Minus twice the logarithm of the density of the fix under the prediction, up to a constant. The distance counts
    /// only up to four standard deviations: beyond that the model of the motion is the likelier culprit, and no single
    /// bead's prediction may decide alone.
    pub fn surprise(&self, fix: &Fix) -> f64 {
        let (rx, ry) = variances(fix);
        self.distance2(fix).min(MOST_DISTANCE2) + ((self.x.pp + rx) * (self.y.pp + ry)).ln()
    }

    pub fn update(&mut self, fix: &Fix) {
        let (rx, ry) = variances(fix);
        self.x.update(fix.x_px - self.x.p, rx);
        self.y.update(fix.y_px - self.y.p, ry);
    }
}

fn variances(fix: &Fix) -> (f64, f64) {
    let least = LEAST_FIX_SD_PX * LEAST_FIX_SD_PX;
    (fix.var_x_px2 + least, fix.var_y_px2 + least)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fix::FixQuality;

    fn fix(x_px: f64) -> Fix {
        Fix {
            x_px,
            var_x_px2: 1e-4,
            var_y_px2: 1e-4,
            ..Fix::none(0.0, 5.0, FixQuality::Good)
        }
    }

    #[test]
    fn a_steady_drift_beside_the_flow_is_learnt_and_carried_on() {
        let randomness = Randomness {
            diffusion_px2_per_s: 0.01,
            velocity_walk: 10.0,
            flow_error: 0.1,
        };
        let mut motion = Motion::new(&fix(0.0));
        // 100 px/s commanded, 40 px/s that nobody commanded.
        for n in 1..=200 {
            motion.predict(1e-3, (100.0, 0.0), &randomness);
            motion.update(&fix(0.14 * f64::from(n)));
        }
        let sd = motion.sd_px();
        motion.predict(0.05, (100.0, 0.0), &randomness);
        let (x, y) = motion.position();
        assert!((x - 35.0).abs() < 0.3 && (y - 5.0).abs() < 0.01, "{x} {y}");
        assert!(
            motion.sd_px() > 3.0 * sd && motion.sd_px() > 0.3,
            "the window must grow: {}",
            motion.sd_px()
        );
    }

    #[test]
    fn innovations_of_matching_noise_have_unit_distance() {
        // A random walk of the assumed diffusion, exactly: mean squared distance over two axes is 2.
        let randomness = Randomness {
            diffusion_px2_per_s: 30.0,
            velocity_walk: 0.0,
            flow_error: 0.0,
        };
        let mut motion = Motion::new(&fix(0.0));
        let (mut state, mut x, mut y, mut sum) = (9_u64, 0.0, 5.0, 0.0);
        let mut uniform = move || {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1_u64 << 53) as f64 - 0.5
        };
        let n = 20_000;
        for k in 0..n {
            // Uniform steps of variance 2 D dt.
            let width = (12.0 * 2.0 * 30.0 * 1e-3_f64).sqrt();
            x += width * uniform();
            y += width * uniform();
            motion.predict(1e-3, (0.0, 0.0), &randomness);
            let f = Fix { y_px: y, ..fix(x) };
            if k >= 1000 {
                sum += motion.distance2(&f) / f64::from(n - 1000);
            }
            motion.update(&f);
        }
        assert!((sum - 2.0).abs() < 0.1, "{sum}");
    }
}
