//! A step of the flow, as a hypothesis next to the quiet walk of neutral.
//!
//! A tap on the syringe or a valve moves neutral at once as far as the walk does in minutes. Two hypotheses compete for the innovations of
//! the last fixes. In a quiet flow their sum has a normal density. After a step of the flow before any one fix it may have any magnitude
//! on a logarithmic scale. A fast flow shows in one fix, a slow one in several. If the step is likelier, neutral moves by the step that
//! explains the sum.

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

/// What the last fixes showed, newest first, since the zero flow was last believed to be quiet.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct RecentFixes {
    fixes: [RecentFix; HISTORY],
    count: usize,
}

/// How far the bead went from one fix to the next.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct RecentFix {
    /// Fix less its prediction, um.
    innovation_um: f64,
    /// The way that the commands account for, um.
    motion_um: f64,
    ticks: f64,
}

impl RecentFixes {
    fn push(&mut self, fix: RecentFix) {
        self.fixes.copy_within(0..HISTORY - 1, 1);
        self.fixes[0] = fix;
        self.count = (self.count + 1).min(HISTORY);
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
        state.recent.push(RecentFix {
            innovation_um,
            motion_um,
            ticks: f64::from(state.ticks_since_fix.max(1)),
        });
        let sample_s = self.model.sample_time_s;
        let walk_um2 = 2.0 * self.config.diffusion_um2_per_s * sample_s;
        // What is not known of neutral carries the bead the same way in every tick.
        let unsure_um2 = self.tick.gain.powi(2) * state.covariance_um2[2];
        let swing_um = WRONG_GAIN * self.commanded_swing(state);
        // Of a fix that is not of its nominal time the tick may have come late as well, and the walk of a tick is in doubt.
        let late = fix.age > 0 || fix.offset != 0.0;
        let mut variance_um2 = variance_um2 + if late { walk_um2 } else { 0.0 };
        let newest_ticks = state.recent.fixes[0].ticks;
        let (mut way_um, mut motion_um, mut ticks) = (0.0, 0.0, 0.0);
        let mut best: Option<(f64, FlowStep)> = None;
        for (back, recent) in state.recent.fixes[..state.recent.count].iter().enumerate() {
            way_um += recent.innovation_um;
            motion_um += recent.motion_um;
            ticks += recent.ticks;
            if back > 0 {
                let before = ticks - recent.ticks;
                variance_um2 += (walk_um2 + state.spread_um2) * recent.ticks
                    + unsure_um2 * (ticks * ticks - before * before);
            }
            let by_gain = [-WRONG_GAIN - 1.0, WRONG_GAIN - 1.0].map(|more| more * motion_um);
            let low_um = by_gain[0].min(by_gain[1]) - swing_um;
            let high_um = by_gain[0].max(by_gain[1]) + swing_um;
            if (low_um..=high_um).contains(&way_um) {
                continue;
            }
            let quiet = -0.5 * (way_um * way_um / variance_um2 + (TAU * variance_um2).ln());
            let odds = flow_step_log_density(way_um, recent.ticks * sample_s) - quiet;
            if odds > best.map_or(0.0, |(odds, _)| odds) {
                let step = FlowStep {
                    way_um,
                    variance_um2,
                    ticks,
                    newest_ticks,
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
        state.recent.forget();
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
