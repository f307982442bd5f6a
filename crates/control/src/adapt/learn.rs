//! What a tick tells of gain and delay: the regression, the search for lines, and what is no bead that wanders.

use super::lines::{LINES, SERIES, SETTLING_TICKS};
use super::motion::Motion;
use super::probe::Trial;
use super::spectrum::Lineup;
use super::whiten::Whitener;
use super::window::{DELAYS, MEMBERS, Window};
use super::{AdaptState, Adapter, DRIVEN, FAST, FAST_TICKS, Lesson, SLOW, SLOW_TICKS};
use crate::estimator::Fix;

/// A fix so many standard deviations off, over twice what the model moved, is no fix of this bead.
const OUTLIER: f64 = 6.0;
/// Outliers in a row after which the series begin anew.
const OUTLIERS: u8 = 12;
/// Memory of the check whether what is left is white, ticks.
const WHITE_TICKS: f64 = 2000.0;
/// Ticks from one look at the spectra to the next.
const LOOK_TICKS: f64 = 64.0;
/// Memory of the mean square of what is left now, and of what is usually left, ticks. Where the first is below this part of
/// the other the bead does not wander: something holds it, whatever else is known.
const NOW_TICKS: f64 = 100.0;
const USUAL_TICKS: f64 = 20_000.0;
const STILL: f64 = 0.65;
/// Fixes missing in a row over which a line is followed.
const LONGEST_GAP: f64 = 64.0;

impl Adapter {
    /// One tick of the regression.
    pub(super) fn learn(&self, state: &mut AdaptState, fix: Option<Fix>) -> Lesson {
        let (usable, noise_um2) = (self.usable(), self.left_um2(state));
        let (delay, exposure) = (self.delay_samples, self.exposure_ticks);
        let at = |motion: &Motion| motion.at(&fix?, delay, exposure, &usable);
        state.since_fix += 1.0;
        let Some((fix, at_um)) = fix.zip(at(&state.model)) else {
            state.silent = state.silent.saturating_add(1);
            return if fix.is_none() && state.silent <= self.planned_gap {
                Lesson::Between
            } else {
                Lesson::Nothing
            };
        };
        state.silent = 0;
        // From exposure to exposure, whenever the ticks were that used them.
        let ago = fix.age as f64 + fix.offset;
        let apart = state.since_fix - ago;
        let correction = (self.whitener).correction(state.covariance, apart, fix.variance_um2);
        let instrument = state.probe.instrument().and_then(|motion| {
            let at_um = at(motion)?;
            let innovations = motion.innovations(&correction, &at_um);
            if innovations.is_none() {
                motion.begin(at_um);
            }
            innovations
        });
        let begun = (state.seen.as_mut()).zip(state.model.innovations(&correction, &at_um));
        let Some((seen, p)) = begun else {
            state.seen = Some(Whitener::begin(fix.position_um));
            state.model.begin(at_um);
            state.since_fix = ago;
            return Lesson::Nothing;
        };
        let y = correction.innovation(seen, fix.position_um);
        let (gain, member) = state.believed;
        let z = (seen.drift - gain * state.model.drift(member)) * correction.ticks;
        let (told_y, told_p) = (y, p);
        let weight = correction.weight;
        let mut values = [0.0; SERIES];
        values[0] = weight * y;
        for (value, p) in values[1..=MEMBERS].iter_mut().zip(p) {
            *value = weight * p;
        }
        values[SERIES - 1] = weight * z;
        let mut lines = state.lines;
        let times = (correction.ticks / self.interval).round().min(LONGEST_GAP);
        (1..times as u32).for_each(|_| lines.coast());
        let force = (state.force.log_gain.exp(), state.force.member);
        lines.step(&mut values, force.0, force.1, noise_um2);
        let (y, z) = (values[0], values[SERIES - 1]);
        let mut p = told_p;
        p.copy_from_slice(&values[1..=MEMBERS]);
        let left = y - gain * p[member];
        let sd = noise_um2.sqrt();
        let outlier = left.abs() > OUTLIER * sd + 2.0 * gain.max(1.0) * p[member].abs();
        state.outliers = if outlier { state.outliers + 1 } else { 0 };
        if outlier {
            if state.outliers >= OUTLIERS {
                state.seen = None;
                state.outliers = 0;
            }
            return Lesson::Nothing;
        }
        state.lines = lines;
        correction.step(seen, told_y);
        state.model.follow(&correction, &told_p);
        if let Some((motion, d)) = state.probe.instrument().zip(instrument) {
            motion.follow(&correction, &d);
        }
        state.covariance = correction.after;
        state.since_fix = ago;
        let in_force = y - force.0 * p[force.1];
        if self.listen(state, in_force.clamp(-6.0 * sd, 6.0 * sd)) {
            return Lesson::Nothing;
        }
        let left = left.clamp(-3.0 * sd, 3.0 * sd);
        if Self::is_still(state, left) {
            return Lesson::Nothing;
        }
        state.slow.add(member, &p, z, y, noise_um2);
        state.fast.add(member, &p, z, y, noise_um2);
        if let Some(instrument) = instrument {
            state.probe.learn(&Trial {
                seen_um: y,
                moved_um: p[member],
                gain,
                instrument_um: instrument.map(|um| weight * um),
                delay: state.found.map_or(DELAYS[member], |f| f.delay),
                spreads: !self.is_faster(),
                noise_um2,
            });
        }
        let keep = 1.0 - 1.0 / WHITE_TICKS;
        state.white[0] = keep * state.white[0] + left * left;
        state.white[1] = keep * state.white[1] + left * state.left_um;
        state.left_um = left;
        Lesson::Learned
    }

    /// Looks for a line in what is left beside the tuning in force. Whether a new notch settles and nothing is to be learned.
    fn listen(&self, state: &mut AdaptState, left_um: f64) -> bool {
        if state.settling > 0 {
            state.settling -= 1;
            return true;
        }
        if state.driven_um2 >= DRIVEN * self.whitener.noise_um2 {
            return false;
        }
        state.lineup.add(&self.bank, left_um);
        if state.lineup.ticks() % LOOK_TICKS != 0.0 || state.lines.count() == LINES {
            return false;
        }
        let Some(rad) = state.lineup.line(&self.bank) else {
            return false;
        };
        state.lines.take_out(rad);
        state.lineup = Lineup::NONE;
        state.settling = SETTLING_TICKS;
        state.slow = Window::new(FAST, SLOW, SLOW_TICKS);
        state.fast = Window::new(FAST, FAST, FAST_TICKS);
        state.found = None;
        state.probe.begin_anew();
        state.since_line = 0;
        true
    }

    /// Whether the bead wanders so much less than it did that something must hold it.
    fn is_still(state: &mut AdaptState, left_um: f64) -> bool {
        let square = left_um * left_um;
        state.ticks += 1.0;
        state.now_um2 += (square - state.now_um2) / state.ticks.min(NOW_TICKS);
        state.usual_um2 += (square - state.usual_um2) / state.ticks.min(USUAL_TICKS);
        state.ticks > 2.0 * NOW_TICKS && state.now_um2 < STILL * state.usual_um2
    }
}
