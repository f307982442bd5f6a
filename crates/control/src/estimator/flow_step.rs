//! A step of the flow, as a hypothesis next to the quiet walk of neutral.
//!
//! A tap on the syringe or a valve moves neutral at once as far as the walk does in minutes. Three hypotheses compete for the innovations
//! of the last fixes. In a quiet flow their sum has a normal density, but for what a wrong gain makes of the commands: the one that
//! explains most of the last second. After a step of the flow, at any time since the last one, it may have any magnitude on a logarithmic
//! scale: a fast flow shows in one fix, a slow one in some ten milliseconds. Or the gain has changed at that time, which is as rare: then
//! the innovations go with the commands, while those of a flow are the same in every tick. If the step is the likeliest, neutral moves by
//! the step that explains the sum.

use super::covariance::corrected;
use super::{Estimator, EstimatorState, Fix, HISTORY};
use std::f64::consts::TAU;

/// Steps of the flow that are expected in a second: some tens in an hour. Ten times more or less move the innovation at which a
/// step is the likelier hypothesis by 0.5 standard deviations.
const STEPS_PER_S: f64 = 0.01;
/// Natural logarithm of the fastest flow over the slowest that is told from the quiet walk: 400, as the tracker takes it.
const LOG_RANGE: f64 = 6.0;
/// No fix is better than that: nearer than it no step is told, um.
const LEAST_OFF_UM: f64 = 1e-3;
/// Gain of a plant over that of its model, of either sign, that is told from a step of the flow: a gain that jumps from half to twice is
/// four times what the law has followed.
const WRONG_GAIN: f64 = 4.0;
/// Time in which what was seen of the gain is forgotten, s: a hold tells it to 10 % in that time, for commands answer the walk.
const GAIN_MEMORY_S: f64 = 1.0;
/// Times at which the flow may have stepped that are kept, newest first.
const ONSETS: usize = 40;
/// They lie closer than this share of the time since then: the way that a flow has made since is then right to a 16th.
const APART: f64 = 0.125;

/// What the fixes showed since each time at which the flow may have stepped, newest first, and what they show of the gain.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RecentFixes {
    onsets: [Onset; ONSETS],
    count: usize,
    gain: SeenGain,
}

/// What the fixes show of the gain: sums of innovation times motion and of motion squared, um^2.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct SeenGain {
    by_motion_um2: f64,
    motion_um2: f64,
}

impl SeenGain {
    fn add(&mut self, by_motion_um2: f64, motion_um2: f64) {
        self.by_motion_um2 += by_motion_um2;
        self.motion_um2 += motion_um2;
    }

    /// Sum of the squares of innovations that the likeliest gain explains, um^2.
    fn explained_um2(&self) -> f64 {
        if self.motion_um2 <= 0.0 {
            return 0.0;
        }
        let more =
            (self.by_motion_um2 / self.motion_um2).clamp(-WRONG_GAIN - 1.0, WRONG_GAIN - 1.0);
        more * (2.0 * self.by_motion_um2 - more * self.motion_um2)
    }
}

/// How far the bead went off its prediction since a time.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Onset {
    /// Sum of the innovations, um.
    way_um: f64,
    ticks: f64,
    gain: SeenGain,
}

impl Default for RecentFixes {
    fn default() -> Self {
        Self {
            onsets: [Onset::default(); ONSETS],
            count: 0,
            gain: SeenGain::default(),
        }
    }
}

impl RecentFixes {
    /// Takes in a fix: its innovation and the way that the commands account for, um, and the ticks that it is of.
    fn push(&mut self, innovation_um: f64, motion_um: f64, ticks: f64, sample_s: f64) {
        let (by_motion_um2, motion_um2) = (innovation_um * motion_um, motion_um * motion_um);
        let kept = (1.0 - ticks * sample_s / GAIN_MEMORY_S).max(0.0);
        self.gain.by_motion_um2 *= kept;
        self.gain.motion_um2 *= kept;
        self.gain.add(by_motion_um2, motion_um2);
        self.thin();
        self.onsets.copy_within(0..self.count, 1);
        self.onsets[0] = Onset::default();
        self.count += 1;
        for onset in &mut self.onsets[..self.count] {
            onset.way_um += innovation_um;
            onset.ticks += ticks;
            onset.gain.add(by_motion_um2, motion_um2);
        }
    }

    /// Makes room for one more: leaves out those whose neighbours are close enough, and the oldest if that does not do.
    fn thin(&mut self) {
        let mut kept = usize::from(self.count > 0);
        for k in 1..self.count {
            let last = k + 1 == self.count;
            let next = self.onsets[(k + 1).min(ONSETS - 1)].ticks;
            if last || next - self.onsets[kept - 1].ticks > APART * next {
                self.onsets[kept] = self.onsets[k];
                kept += 1;
            }
        }
        self.count = kept.min(ONSETS - 1);
    }

    /// The flow is believed from now on; what an onset explained says nothing of the gain.
    fn explained(&mut self, since: SeenGain) {
        self.gain.add(-since.by_motion_um2, -since.motion_um2);
        self.gain.motion_um2 = self.gain.motion_um2.max(0.0);
        self.count = 0;
    }

    pub(super) fn forget(&mut self) {
        self.count = 0;
    }
}

/// A step of the flow that explains the last fixes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct FlowStep {
    /// The way that it has carried the bead, with its variance, um and um^2.
    way_um: f64,
    variance_um2: f64,
    /// Ticks since then, and those of the newest fix.
    ticks: f64,
    newest_ticks: f64,
    gain: SeenGain,
}

/// Natural logarithm of the density (1/um) of a fix that is `off_um` from where a quiet flow would have it, if the flow has stepped
/// within the last `since_s`: any speed is as likely as any other on a logarithmic scale.
pub fn flow_step_log_density(off_um: f64, since_s: f64) -> f64 {
    let chance = (STEPS_PER_S * since_s).min(1.0);
    (chance / (2.0 * LOG_RANGE * off_um.abs().max(LEAST_OFF_UM))).ln()
}

impl Estimator {
    /// The step of the flow before one of the last fixes that explains them best, if it does so better than the quiet model, in which the
    /// variance of the newest innovation is `variance_um2`. One fix shows it at 1 kHz from about 5.3 standard deviations on. What the
    /// bead's own motion could explain, by a gain or a delay that is wrong, is no step.
    pub(super) fn flow_step(
        &self,
        state: &mut EstimatorState,
        [innovation_um, motion_um]: [f64; 2],
        variance_um2: f64,
        fix: &Fix,
    ) -> Option<FlowStep> {
        if state.stuck {
            state.recent.forget();
            return None;
        }
        let sample_s = self.model.sample_time_s;
        let newest_ticks = f64::from(state.ticks_since_fix.max(1));
        (state.recent).push(innovation_um, motion_um, newest_ticks, sample_s);
        let walk_um2 = 2.0 * self.config.diffusion_um2_per_s * sample_s;
        // What is not known of neutral carries the bead the same way in every tick.
        let unsure_um2 = self.tick.gain.powi(2) * state.covariance_um2[2];
        let swing_um = WRONG_GAIN * self.commanded_swing(state);
        // Of a fix that is not of its nominal time the tick may have come late as well, and the walk of a tick is in doubt.
        let late = fix.age > 0 || fix.offset != 0.0;
        let newest_um2 = variance_um2 + if late { walk_um2 } else { 0.0 };
        let tick_um2 = walk_um2 + state.spread_um2;
        // A quiet flow with the gain that explains most.
        let by_gain = state.recent.gain.explained_um2() / tick_um2;
        let mut best: Option<(f64, FlowStep)> = None;
        let mut before = 0.0;
        for onset in &state.recent.onsets[..state.recent.count] {
            let &Onset {
                way_um,
                ticks,
                gain,
            } = onset;
            let between = ticks - std::mem::replace(&mut before, ticks);
            let variance_um2 = newest_um2
                + tick_um2 * (ticks - newest_ticks)
                + unsure_um2 * (ticks * ticks - newest_ticks * newest_ticks);
            // A gain that changed at that time is as rare as a step.
            let changed = gain.explained_um2() * ticks > way_um * way_um;
            let off = way_um * way_um / variance_um2 - by_gain;
            if changed || off <= 0.0 || way_um.abs() <= swing_um {
                continue;
            }
            let quiet = -0.5 * (off + (TAU * variance_um2).ln());
            let odds = flow_step_log_density(way_um, between * sample_s) - quiet;
            if odds > best.map_or(0.0, |(odds, _)| odds) {
                let step = FlowStep {
                    way_um,
                    variance_um2,
                    ticks,
                    newest_ticks,
                    gain,
                };
                best = Some((odds, step));
            }
        }
        best.map(|(_, step)| step)
    }

    /// What the swing of the last commands moves a bead in a tick, um. It does not lean on neutral, which may be what is wrong.
    fn commanded_swing(&self, state: &EstimatorState) -> f64 {
        let (low_um, high_um) = state
            .history_um
            .iter()
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), &um| {
                (low.min(um), high.max(um))
            });
        self.tick.gain.abs() * (high_um - low_um)
    }

    /// Neutral has moved by what has carried the bead this far, and the prediction of the newest fix with it; `h` is the sensitivity of
    /// a fix to neutral. Returns what is left of the innovation.
    pub(super) fn grant_step(
        &self,
        state: &mut EstimatorState,
        step: &FlowStep,
        h: f64,
        innovation_um: f64,
    ) -> f64 {
        state.stepped_ticks = HISTORY as u8;
        state.recent.explained(step.gain);
        // Per um of way: of the newest fix's prediction, and of neutral.
        let newest = step.newest_ticks / step.ticks;
        let neutral = -1.0 / (self.tick.gain * step.ticks);
        state.integrator_um += newest * step.way_um;
        state.neutral_um += neutral * step.way_um;
        for covariance_um2 in [&mut state.covariance_um2, &mut state.stated_um2] {
            covariance_um2[0] += newest * newest * step.variance_um2;
            covariance_um2[1] += newest * neutral * step.variance_um2;
            covariance_um2[2] += neutral * neutral * step.variance_um2;
        }
        innovation_um - (newest + h * neutral) * step.way_um
    }

    /// Corrects the estimate by an innovation; `h` is the sensitivity of the fix to neutral.
    pub(super) fn correct(
        &self,
        state: &mut EstimatorState,
        h: f64,
        innovation_um: f64,
        walk_um2: f64,
        variance_um2: f64,
    ) {
        let [p11, p12, p22] = state.covariance_um2;
        let (ph1, ph2) = (p11 + h * p12, p12 + h * p22);
        let trusted = ph1 + h * ph2 + walk_um2 + variance_um2 / self.config.ltr_noise_scaling;
        let (k1, k2) = (ph1 / trusted, ph2 / trusted);
        state.integrator_um += k1 * innovation_um;
        state.neutral_um += k2 * innovation_um;
        state.covariance_um2 = [p11 - k1 * ph1, p12 - k1 * ph2, p22 - k2 * ph2];
        state.stated_um2 = corrected(state.stated_um2, h, [k1, k2], walk_um2 + variance_um2);
    }
}
