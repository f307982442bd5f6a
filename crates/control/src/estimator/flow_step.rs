//! A step of the flow, as a hypothesis beside the quiet walk of neutral.
//!
//! A tap on the syringe or a valve moves neutral at once by what a walk would take minutes for. A fix that the quiet model
//! hardly grants is weighed under both: the normal density of the innovation, and a step since the last fix that was used, of
//! any magnitude on a logarithmic scale. Where the step is likelier, neutral is as uncertain as the step that the innovation
//! shows, and the filter learns the new one from the fixes that follow.

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
/// An innovation of up to so many times what the last commands moved the bead in a tick can come from a plant that is not the
/// model's: a gain that jumps from half to twice is four times what the law has followed and adds the motion three times; a tick
/// of delay where the motion turns round makes it twice that.
const MOTION_SHARE: f64 = 6.0;

/// Natural logarithm of the density (1/um) of a fix that is `off_um` from where a quiet flow would have it, if the flow has stepped
/// within the last `since_s`: any speed is as likely as any other on a logarithmic scale.
pub fn flow_step_log_density(off_um: f64, since_s: f64) -> f64 {
    let chance = (STEPS_PER_S * since_s).min(1.0);
    (chance / (2.0 * LOG_RANGE * off_um.abs().max(LEAST_OFF_UM))).ln()
}

impl Estimator {
    /// Whether a step of the flow since the last fix that was used explains an innovation better than the quiet model does, in
    /// which its variance is `variance_um2`. At 1 kHz that is from about 5.3 standard deviations on. What the bead's own motion
    /// of the last ticks could explain, by a gain or a delay that is wrong, is no step.
    pub(super) fn is_step(
        &self,
        state: &EstimatorState,
        innovation_um: f64,
        variance_um2: f64,
        fix: &Fix,
    ) -> bool {
        if state.stuck || innovation_um.abs() <= MOTION_SHARE * self.commanded_swing(state) {
            return false;
        }
        // Of a fix that is not of its nominal time the tick may have come late as well, and the walk of a tick is in doubt.
        let late = fix.age > 0 || fix.offset != 0.0;
        let walk_um2 = 2.0 * self.config.diffusion_um2_per_s * self.model.sample_time_s;
        let variance_um2 = variance_um2 + if late { walk_um2 } else { 0.0 };
        let quiet =
            -0.5 * (innovation_um * innovation_um / variance_um2 + (TAU * variance_um2).ln());
        let since_s = f64::from(state.ticks_since_fix.max(1)) * self.model().sample_time_s;
        flow_step_log_density(innovation_um, since_s) > quiet
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

    /// Neutral may have stepped at any time since the last fix that was used, by what has carried the bead this far.
    pub(super) fn grant_step(&self, state: &mut EstimatorState, innovation_um: f64) {
        state.stepped_ticks = HISTORY as u8;
        let way_per_um = self.tick.gain * f64::from(state.ticks_since_fix.max(1));
        let step_um = innovation_um / way_per_um;
        for covariance_um2 in [&mut state.covariance_um2, &mut state.stated_um2] {
            covariance_um2[0] += innovation_um * innovation_um;
            covariance_um2[1] -= innovation_um * step_um;
            covariance_um2[2] += step_um * step_um;
        }
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
