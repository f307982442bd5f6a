//! Predicted motion of one object: commanded flow, as far as it acts, plus an unexplained velocity, with Brownian motion.
//!
//! Two hypotheses stand beside each other in every frame. In the quiet one the unexplained velocity walks. In the other the
//! flow has stepped since the last fix: a tap on the syringe, a valve. How fast it is then is known to the order of magnitude
//! only, up to what the whole stroke of the actuator drives. A fix is worth what the likelier of the two says.

use super::config::TrackerConfig;
use crate::fix::Fix;
use std::f64::consts::TAU;

/// The least standard deviation granted to a fix, px: a template is never exact.
const LEAST_FIX_SD_PX: f64 = 0.02;
/// Standard deviation of the unexplained velocity at the start, px/s.
const START_VELOCITY_SD: f64 = 300.0;

/// Steps of the flow that are expected in a second. A tap or a valve comes a few times in a minute; ten times more or less
/// change the cost of a step by 4.6, a third of the certainty that is asked for.
const STEPS_PER_S: f64 = 1.0;
/// Natural logarithm of the fastest step over the slowest that is told from the quiet walk: 400, from half a pixel a frame to
/// the whole stroke. Any speed in between is as likely as any other on a logarithmic scale.
const LOG_RANGE: f64 = 6.0;
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
    /// Of what stands on the glass: a stage drifts and trembles by some tenths of a pixel in a second.
    pub(super) const GLASS: Self = Randomness {
        diffusion_px2_per_s: 0.05,
        velocity_walk: 0.0,
        flow_error: 0.0,
    };

    pub(super) fn of(config: &TrackerConfig) -> Self {
        Randomness {
            diffusion_px2_per_s: config.diffusion_px2_per_s,
            velocity_walk: config.velocity_walk_px_per_s15,
            flow_error: config.flow_error,
        }
    }

    /// Of the way between two beads: both walk, and a flow carries both.
    pub(super) fn between(&self) -> Self {
        Randomness {
            diffusion_px2_per_s: 2.0 * self.diffusion_px2_per_s,
            ..*self
        }
    }
}

/// Time in which what was learnt of the commanded flow is forgotten, s: a few frames of a piezo in motion teach it anew.
const FLOW_MEMORY_S: f64 = 0.05;

/// Position, unexplained velocity and relative error of the commanded flow along one axis, with covariance (Kalman filter). An
/// actuator that is clipped or whose sign is wrong has an error of -1 or -2.
#[derive(Debug, Clone, Copy)]
struct Axis {
    p: f64,
    v: f64,
    e: f64,
    pp: f64,
    pv: f64,
    vv: f64,
    pe: f64,
    ve: f64,
    ee: f64,
    /// Commanded flow of the frame before, px/s.
    flow: f64,
}

impl Axis {
    fn new(p: f64, var: f64) -> Self {
        Axis {
            p,
            v: 0.0,
            e: 0.0,
            pp: var,
            pv: 0.0,
            vv: START_VELOCITY_SD * START_VELOCITY_SD,
            pe: 0.0,
            ve: 0.0,
            ee: 0.0,
            flow: 0.0,
        }
    }

    fn predict(&mut self, dt_s: f64, flow: f64, r: &Randomness) {
        // Half of the error's variance is of the flow and stays from frame to frame (gain), half is of its changes (delay).
        let half = 0.5 * r.flow_error * r.flow_error;
        let kept = (-dt_s / FLOW_MEMORY_S).exp();
        self.e *= kept;
        self.pe *= kept;
        self.ve *= kept;
        self.ee = kept * kept * self.ee + (1.0 - kept * kept) * half;
        let way = dt_s * flow;
        let change = dt_s * (flow - std::mem::replace(&mut self.flow, flow));
        self.p += dt_s * self.v + way * (1.0 + self.e);
        let wrong =
            way * (2.0 * self.pe + 2.0 * dt_s * self.ve + way * self.ee) + half * change * change;
        self.pp +=
            dt_s * (2.0 * self.pv + dt_s * self.vv) + 2.0 * r.diffusion_px2_per_s * dt_s + wrong;
        self.pv += dt_s * self.vv + way * self.ve;
        self.pe += dt_s * self.ve + way * self.ee;
        self.vv += r.velocity_walk * r.velocity_walk * dt_s;
    }

    /// Moves on with the flow that has carried it by `way` in `since_s`. The step came at any time in between: half of the variance of
    /// the speed is told by the way, and half is that of the time.
    fn carry(&mut self, way: f64, since_s: f64) {
        let (way2, speed) = (way * way, way / since_s);
        self.pp += way2;
        self.pv += way * speed;
        self.vv += 2.0 * speed * speed;
    }

    fn update(&mut self, innovation: f64, fix_var: f64) {
        let s = self.pp + fix_var;
        let (kp, kv, ke) = (self.pp / s, self.pv / s, self.pe / s);
        self.p += kp * innovation;
        self.v += kv * innovation;
        self.e += ke * innovation;
        self.vv -= kv * self.pv;
        self.ve -= kv * self.pe;
        self.ee -= ke * self.pe;
        self.pv *= 1.0 - kp;
        self.pe *= 1.0 - kp;
        self.pp *= 1.0 - kp;
    }

    /// A place that is known with this variance.
    fn at(self, p: f64, pp: f64) -> Self {
        Axis { p, pp, ..self }
    }
}

/// Motion in the plane. The axes are filtered apart: the fit's cross covariance is small.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Motion {
    x: Axis,
    y: Axis,
    /// Since the last fix that was taken in, s.
    since_s: f64,
}

impl Motion {
    pub(super) fn new(fix: &Fix) -> Self {
        let (rx, ry) = variances(fix);
        Motion {
            x: Axis::new(fix.x_px, rx),
            y: Axis::new(fix.y_px, ry),
            since_s: 0.0,
        }
    }

    /// Of what has no velocity.
    pub(super) fn standing(fix: &Fix) -> Self {
        let mut motion = Motion::new(fix);
        (motion.x.vv, motion.y.vv) = (0.0, 0.0);
        motion
    }

    pub(super) fn predict(
        &mut self,
        dt_s: f64,
        (flow_x, flow_y): (f64, f64),
        randomness: &Randomness,
    ) {
        self.x.predict(dt_s, flow_x, randomness);
        self.y.predict(dt_s, flow_y, randomness);
        self.since_s += dt_s;
    }

    pub(super) fn position(&self) -> (f64, f64) {
        (self.x.p, self.y.p)
    }

    /// The way that goes with a commanded one, px, and with what no command explains, in `time_s`.
    pub(super) fn way_px(&self, (x, y): (f64, f64), time_s: f64) -> (f64, f64) {
        let way = |axis: &Axis, px: f64| px * (1.0 + axis.e) + axis.v * time_s;
        (way(&self.x, x), way(&self.y, y))
    }

    /// Time since the last fix that was taken in, s.
    pub(super) fn since_s(&self) -> f64 {
        self.since_s
    }

    /// From the prediction to a fix, px.
    pub(super) fn way_to(&self, fix: &Fix) -> (f64, f64) {
        (fix.x_px - self.x.p, fix.y_px - self.y.p)
    }

    /// Standard deviation of the predicted position, the larger axis, px.
    pub(super) fn sd_px(&self) -> f64 {
        self.x.pp.max(self.y.pp).sqrt()
    }

    /// Squared innovation over its variance, both axes.
    pub(super) fn distance2(&self, fix: &Fix) -> f64 {
        let (rx, ry) = variances(fix);
        (fix.x_px - self.x.p).powi(2) / (self.x.pp + rx)
            + (fix.y_px - self.y.p).powi(2) / (self.y.pp + ry)
    }

    /// Minus twice the logarithm of the density of the fix (per px^2) while the flow is quiet.
    pub(super) fn quiet_cost(&self, fix: &Fix) -> f64 {
        self.distance2(fix) + self.cost_of_width(fix)
    }

    fn cost_of_width(&self, fix: &Fix) -> f64 {
        let (rx, ry) = variances(fix);
        ((self.x.pp + rx) * (self.y.pp + ry)).ln() + 2.0 * TAU.ln()
    }

    /// Minus twice the logarithm of the density of the fix (per px^2) when the flow has stepped since the last fix: the chance
    /// of a step in that time, and a speed of any magnitude in any direction, `1 / (LOG_RANGE 2 pi way^2)`.
    pub(super) fn step_cost(&self, fix: &Fix) -> f64 {
        let (x, y) = self.way_to(fix);
        // Nearer than the prediction is known no step can be told.
        let way2 = (x * x + y * y).max(self.x.pp + self.y.pp);
        let chance = (STEPS_PER_S * self.since_s).min(1.0);
        -2.0 * (chance / (LOG_RANGE * TAU * way2)).ln()
    }

    /// Whether a step of the flow explains the fix better than the quiet walk.
    pub(super) fn has_stepped(&self, fix: &Fix) -> bool {
        self.step_cost(fix) < self.quiet_cost(fix)
    }

    /// Minus twice the logarithm of the density of the fix (per px^2) under the likelier hypothesis.
    pub(super) fn surprise(&self, fix: &Fix) -> f64 {
        self.step_cost(fix).min(self.quiet_cost(fix))
    }

    /// Goes along with a step of the flow that has carried the bead this far from the prediction since its last fix: the
    /// velocity is as uncertain as what has been seen of it.
    pub(super) fn carry(&mut self, way_px: (f64, f64)) {
        if self.since_s > 0.0 {
            self.x.carry(way_px.0, self.since_s);
            self.y.carry(way_px.1, self.since_s);
        }
    }

    /// Takes a fix in, with a step of the flow where that is the likelier hypothesis.
    pub(super) fn update(&mut self, fix: &Fix) {
        if self.has_stepped(fix) {
            self.carry(self.way_to(fix));
        }
        let (rx, ry) = variances(fix);
        self.x.update(fix.x_px - self.x.p, rx);
        self.y.update(fix.y_px - self.y.p, ry);
        self.since_s = 0.0;
    }

    /// The motion of a bead that moves like `of` and is where this fix is.
    pub(super) fn at(fix: &Fix, of: &Self) -> Self {
        let (rx, ry) = variances(fix);
        Motion {
            x: of.x.at(fix.x_px, rx),
            y: of.y.at(fix.y_px, ry),
            ..*of
        }
    }

    /// The same with a way to another bead added, as far as its place goes.
    pub(super) fn plus(&self, way: &Self) -> Self {
        let sum = |a: Axis, b: &Axis| a.at(a.p + b.p, a.pp + b.pp);
        Motion {
            x: sum(self.x, &way.x),
            y: sum(self.y, &way.y),
            since_s: self.since_s,
        }
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
    fn a_flow_that_stepped_late_in_a_gap_is_faster_than_the_way_since_the_last_fix() {
        let randomness = Randomness {
            diffusion_px2_per_s: 33.0,
            velocity_walk: 300.0,
            flow_error: 0.5,
        };
        let mut motion = Motion::new(&fix(0.0));
        for _ in 0..200 {
            motion.predict(1e-3, (0.0, 0.0), &randomness);
            motion.update(&fix(0.0));
        }
        // The frame of the step shows no bead; the next one shows 10 px of a flow of 10 px a frame, and so does the one after that.
        motion.predict(1e-3, (0.0, 0.0), &randomness);
        motion.predict(1e-3, (0.0, 0.0), &randomness);
        motion.update(&fix(10.0));
        motion.predict(1e-3, (0.0, 0.0), &randomness);
        assert!(!motion.has_stepped(&fix(20.0)), "{motion:?}");
        motion.update(&fix(20.0));
        motion.predict(1e-3, (0.0, 0.0), &randomness);
        assert!((motion.position().0 - 30.0).abs() < 1.0, "{motion:?}");
    }

    #[test]
    fn commands_that_do_not_act_or_act_the_wrong_way_are_learnt_within_frames() {
        let randomness = Randomness {
            diffusion_px2_per_s: 33.0,
            velocity_walk: 300.0,
            flow_error: 0.5,
        };
        // 20 px a frame commanded; the bead stays, or goes the other way.
        for acts in [0.0, -1.0] {
            let mut motion = Motion::new(&fix(0.0));
            for n in 1..=20 {
                motion.predict(1e-3, (2e4, 0.0), &randomness);
                motion.update(&fix(20.0 * acts * f64::from(n)));
            }
            motion.predict(1e-3, (2e4, 0.0), &randomness);
            let off_px = motion.position().0 - 420.0 * acts;
            let (streak_px, _) = motion.way_px((10.0, 0.0), 0.5e-3);
            assert!(off_px.abs() < 4.0, "{acts}: {off_px}");
            assert!((streak_px - 10.0 * acts).abs() < 2.0, "{acts}: {streak_px}");
        }
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
        let (mut x, mut y, mut sum) = (0.0, 5.0, 0.0);
        let mut random = cellpos_numeric::Random::new(9);
        let n = 20_000;
        for k in 0..n {
            let step = (2.0 * 30.0 * 1e-3_f64).sqrt();
            x += step * random.normal();
            y += step * random.normal();
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
