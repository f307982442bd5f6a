//! A fix enters the estimate.

use super::evidence::{FAR, Products, dot};
use super::motion::{Alignment, MEMBERS};
use super::retuning::DELAYS;
use super::whiten::Whitener;
use super::{AdaptState, Adapter, age_ticks};
use crate::estimator::Fix;

/// Memory of the motion of the loop's own commands and of what they leave, fixes: three periods of the ringing that a gain that doubled
/// makes.
const NOW_FIXES: f64 = 60.0;
/// Below this part of the usual mean square the bead does not wander: something holds it.
const STILL: f64 = 0.5;
/// Largest logarithm of the gain to which caution goes before the estimate knows the cause. A law for 1.3 times the design's gain holds a
/// plant of twice that gain with Ms below 2. A line causes no larger change.
const MOST_CAUTION: f64 = 0.26;
/// Standard deviations by which the motion of the loop's own commands asks for caution.
const CAUTION: f64 = 6.0;
/// Mean square of the residual, over the usual one, that ringing at least leaves: ten standard deviations of a mean of [`NOW_FIXES`]
/// squares would be 2.3. Without it a quiet hold asks for caution once in a hundred hours.
const LOUD: f64 = 2.5;

/// The residual now, and its correlation with the motion of the loop's own commands.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Now {
    yy: f64,
    py: f64,
    pp: f64,
    fixes: f64,
}

impl Now {
    /// Adds a fix.
    fn add(&mut self, y: f64, p: f64) {
        let keep = 1.0 - 1.0 / NOW_FIXES;
        self.yy = keep * self.yy + y * y;
        self.py = keep * self.py + y * p;
        self.pp = keep * self.pp + p * p;
        self.fixes = keep * self.fixes + 1.0;
    }

    /// How far the logarithm of the gain in force should rise, where the residual usually has this mean square.
    fn rise(&self, gain: f64, usual_um2: f64) -> f64 {
        let wrong = self.py - gain * self.pp;
        let surely = wrong > CAUTION * (self.pp * usual_um2).sqrt();
        if surely && self.left(gain) > LOUD * usual_um2 * self.fixes {
            (wrong / (gain * self.pp)).ln_1p()
        } else {
            0.0
        }
    }

    /// Whether the bead wanders less than with this mean square, or too few fixes tell.
    fn still(&self, gain: f64, usual_um2: f64) -> bool {
        self.fixes < STILL * NOW_FIXES || self.left(gain) < STILL * usual_um2 * self.fixes
    }

    /// Sum of the squares that a gain leaves, um^2.
    fn left(&self, gain: f64) -> f64 {
        self.yy - 2.0 * gain * self.py + gain * gain * self.pp
    }
}

impl Adapter {
    /// One tick of the regression. Whether something was learned.
    pub(super) fn learn(&self, state: &mut AdaptState, fix: Option<Fix>) -> bool {
        let delay = self.delay_samples;
        state.since_fix += 1.0;
        let known = fix.and_then(|fix| {
            let age = age_ticks(&fix);
            let aligned = state.aligned.get_or_insert(Alignment::begin(delay, age));
            if !aligned.follow(delay, age) {
                *aligned = Alignment::begin(delay, age);
                state.seen = None;
            }
            let at_um = state.model.at(aligned, age)?;
            let chosen_um = state.instrument.at(aligned, age)?;
            Some((fix, age, self.frame(aligned), at_um, chosen_um))
        });
        let Some((fix, age, frame, at_um, chosen_um)) = known else {
            state.silent = state.silent.saturating_add(1);
            return false;
        };
        state.silent = 0;
        let ago = age - state.late;
        // From exposure to exposure, whenever the ticks were that used them.
        let apart = state.since_fix - ago;
        state.since_fix = ago;
        let usual_um2 = state.colour.usual_um2();
        let correction =
            (self.whitener).correction(state.covariance, apart, fix.variance_um2, usual_um2);
        let late = DELAYS[state.force.member];
        let shown_ago = self.shown_ago(state, ago);
        let cancelled_um = state.cancelled.seen(shown_ago, self.exposure_ticks);
        let cancelled_um = cancelled_um.unwrap_or(0.0);
        let series = (state.seen.as_mut())
            .zip(state.model.innovations(&correction, &at_um))
            .zip(state.instrument.innovations(&correction, &chosen_um));
        let Some(((seen, p), x)) = series else {
            state.seen = Some(Whitener::begin(fix.position_um));
            state.cancelled_seen = Whitener::begin(cancelled_um);
            state.model.begin(at_um);
            state.instrument.begin(chosen_um);
            self.zero_flow.begin(&mut state.zero_flow);
            return false;
        };
        let cancelled = correction.innovation(&state.cancelled_seen, cancelled_um);
        correction.step(&mut state.cancelled_seen, cancelled);
        let y = correction.innovation(seen, fix.position_um);
        correction.step(seen, y);
        state.model.follow(&correction, &p);
        state.instrument.follow(&correction, &x);
        state.covariance = correction.after;
        let scale = correction.weight;
        let gain = state.force.log_gain.exp();
        let in_force = dot(&p, &frame.of(late));
        let disturbed = y - gain * in_force;
        // The error of the model along a reference is no disturbance.
        let chosen_um = x.iter().fold(0.0_f64, |most, x| most.max(x.abs()));
        let tells = (scale * chosen_um).powi(2) < usual_um2;
        (self.zero_flow).learn(&mut state.zero_flow, &correction, disturbed, &fix, tells);
        let (y, p, x) = (scale * y, p.map(|v| scale * v), x.map(|v| scale * v));
        state.now.add(y, scale * in_force);
        let rise = (state.now.rise(gain, usual_um2)).min(MOST_CAUTION - state.force.log_gain);
        if rise > 0.0 {
            state.force.go(rise);
        }
        // The usual mean square may hold a line that is cancelled by now; a bead that is held wanders less than a free one as well.
        if (state.now).still(gain, usual_um2.min(self.whitener.noise_um2)) {
            state.force.wait();
            return false;
        }
        let believed = match state.evidence.found {
            Some(found) => (found.gain.max(0.0), found.delay),
            None => (gain, late),
        };
        let believed_weights = frame.of(believed.1);
        let moved = |p: &[f64; MEMBERS]| believed.0 * dot(p, &believed_weights);
        let far = (y - moved(&p)).abs() / (FAR * usual_um2.sqrt());
        if tells {
            // What is cancelled shakes the plant all the same.
            let disturbed_um = scale * (disturbed / gain - cancelled);
            let fix = (disturbed_um, usual_um2 / (gain * gain));
            (state.lines).learn(&self.lines, &self.whitener, fix, shown_ago);
        }
        let mut series = [0.0; 1 + 2 * MEMBERS];
        series[0] = y;
        series[1..=MEMBERS].copy_from_slice(&p);
        series[1 + MEMBERS..].copy_from_slice(&x);
        state.colour.take_out(&mut series, y - moved(&p));
        let y_um = series[0];
        let p_um = std::array::from_fn(|i| series[1 + i]);
        let x_um = std::array::from_fn(|i| series[1 + MEMBERS + i]);
        let products = Products {
            y_um,
            p_um,
            x_um,
            weight: 1.0 / far.max(1.0),
        };
        if state.evidence.add(&products, self.block) {
            state.colour.solve();
            let seconds = f64::from(self.block) * self.interval * self.sample_s;
            state.evidence.conclude(seconds, &frame, believed);
        }
        true
    }
}
