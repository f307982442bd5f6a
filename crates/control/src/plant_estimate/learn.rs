//! A fix enters the estimate.

use super::evidence::{MEMORY_FIXES, Products, dot, part, weights};
use super::motion::MEMBERS;
use super::retuning::DELAYS;
use super::whiten::Whitener;
use super::{AdaptState, Adapter};
use crate::estimator::Fix;

/// Standard deviations from which on less is taken of a fix (Huber).
const FAR: f64 = 3.0;
/// Memory of the mean square that is left now, fixes: three periods of the ringing that a gain that doubled makes.
const NOW_FIXES: f64 = 60.0;
/// Mean square of the residual, over the usual one, above which it is larger than noise: ten standard deviations of a mean of
/// [`NOW_FIXES`] squares would be 2.3.
const LOUD: f64 = 2.5;
/// Below this part of the usual mean square the bead does not wander: something holds it.
const STILL: f64 = 0.5;
/// Largest logarithm of the gain to which caution goes before the estimate knows the cause. A law for 1.3 times the design's gain holds a
/// plant of twice that gain with Ms below 2. A line causes no larger change.
const ENOUGH: f64 = 0.26;
/// Standard deviations by which the motion of the loop's own commands asks for caution.
const CAUTION: f64 = 6.0;

/// Mean squares of the residual, now and usually, and their correlation with the loop's own commands.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Noise {
    usual_um2: f64,
    yy: f64,
    py: f64,
    pp: f64,
    n: f64,
    fixes: f64,
}

impl Noise {
    pub(super) fn new(usual_um2: f64) -> Self {
        Self {
            usual_um2,
            yy: 0.0,
            py: 0.0,
            pp: 0.0,
            n: 0.0,
            fixes: 0.0,
        }
    }

    /// Adds a fix. Gives the rise of the logarithm of the gain in force that caution asks for.
    fn add(&mut self, y: f64, p: f64, gain: f64) -> f64 {
        let keep = 1.0 - 1.0 / NOW_FIXES;
        self.yy = keep * self.yy + y * y;
        self.py = keep * self.py + y * p;
        self.pp = keep * self.pp + p * p;
        self.n = keep * self.n + 1.0;
        let left2 = (y - gain * p).powi(2);
        self.fixes += 1.0;
        self.usual_um2 += part(self.fixes, MEMORY_FIXES)
            * (left2.min(FAR * FAR * self.usual_um2) - self.usual_um2);
        let wrong = self.py - gain * self.pp;
        let surely = wrong > CAUTION * (self.pp * self.usual_um2).sqrt();
        if self.left(gain) > LOUD * self.usual_um2 && surely {
            (wrong / (gain * self.pp)).ln_1p()
        } else {
            0.0
        }
    }

    /// Mean square of the residual for a gain now, um^2.
    fn left(&self, gain: f64) -> f64 {
        let left = self.yy - 2.0 * gain * self.py + gain * gain * self.pp;
        left.max(0.0) / self.n.max(1.0)
    }
}

impl Adapter {
    /// One tick of the regression. Whether something was learned.
    pub(super) fn learn(&self, state: &mut AdaptState, fix: Option<Fix>) -> bool {
        let (delay, exposure) = (self.delay_samples, self.exposure_ticks);
        state.since_fix += 1.0;
        let known = fix.and_then(|fix| {
            let at_um = state.model.at(&fix, delay, exposure)?;
            Some((fix, at_um, state.instrument.at(&fix, delay, exposure)?))
        });
        let Some((fix, at_um, chosen_um)) = known else {
            state.silent = state.silent.saturating_add(1);
            return false;
        };
        state.silent = 0;
        // From exposure to exposure, whenever the ticks were that used them.
        let ago = fix.age as f64 + fix.offset;
        let apart = state.since_fix - ago;
        state.since_fix = ago;
        let usual_um2 = state.noise.usual_um2;
        let correction =
            (self.whitener).correction(state.covariance, apart, fix.variance_um2, usual_um2);
        let series = (state.seen.as_mut())
            .zip(state.model.innovations(&correction, &at_um))
            .zip(state.instrument.innovations(&correction, &chosen_um));
        let Some(((seen, p), x)) = series else {
            state.seen = Some(Whitener::begin(fix.position_um));
            state.model.begin(at_um);
            state.instrument.begin(chosen_um);
            return false;
        };
        let y = correction.innovation(seen, fix.position_um);
        correction.step(seen, y);
        state.model.follow(&correction, &p);
        state.instrument.follow(&correction, &x);
        state.covariance = correction.after;
        let scale = correction.weight;
        let (y, p, x) = (scale * y, p.map(|v| scale * v), x.map(|v| scale * v));
        let (gain, late) = (state.force.log_gain.exp(), DELAYS[state.force.member]);
        let in_force = dot(&p, &weights(late));
        let rise = (state.noise.add(y, in_force, gain)).min(ENOUGH - state.force.log_gain);
        if rise > 0.0 {
            state.force.go(rise);
        }
        let usual_um2 = state.noise.usual_um2;
        // The usual mean square may hold a line that is cancelled by now; a bead that is held wanders less than a free one as well.
        let wanders_um2 = usual_um2.min(self.whitener.noise_um2);
        if state.noise.fixes <= 2.0 * NOW_FIXES || state.noise.left(gain) < STILL * wanders_um2 {
            state.force.wait();
            return false;
        }
        let believed = match state.evidence.found {
            Some(found) => (found.gain.max(0.0), found.delay),
            None => (gain, late),
        };
        let moved = dot(&p, &weights(believed.1));
        // The error of the model along a reference is not a line.
        let chosen_um = x.iter().fold(0.0_f64, |most, x| most.max(x.abs()));
        if chosen_um * chosen_um < usual_um2 {
            let left_um = (y - gain * in_force) / gain;
            let noise_um2 = state.colour.white_um2 / (gain * gain);
            let shown_ago = delay + late + fix.age as f64 + fix.offset;
            let left = (left_um, noise_um2);
            (state.lines).learn(&self.lines, &self.whitener, left, shown_ago);
        }
        let mut series = [0.0; 1 + 2 * MEMBERS];
        series[0] = y;
        series[1..=MEMBERS].copy_from_slice(&p);
        series[1 + MEMBERS..].copy_from_slice(&x);
        state.colour.take_out(&mut series, y - believed.0 * moved);
        let y_um = series[0];
        let p_um = std::array::from_fn(|i| series[1 + i]);
        let x_um = std::array::from_fn(|i| series[1 + MEMBERS + i]);
        let left_um = y_um - believed.0 * dot(&p_um, &weights(believed.1));
        let far = left_um.abs() / (FAR * state.colour.white_um2.sqrt()).max(1e-9);
        let complete = state.evidence.add(&Products {
            y_um,
            p_um,
            x_um,
            weight: 1.0 / far.max(1.0),
        });
        if complete {
            state.colour.solve();
            let fix_s = self.interval * self.sample_s;
            state.evidence.conclude(fix_s, believed);
        }
        true
    }
}
