//! Configuration of the estimator: noise and plant.

use crate::error::{BuildError, check};
use serde::{Deserialize, Serialize};

/// Ticks in a row that may be without a fix where one comes every so many.
pub(crate) fn planned_gap(ticks_per_fix: f64) -> u32 {
    if ticks_per_fix > 1.0 {
        ticks_per_fix.ceil() as u32
    } else {
        0
    }
}

/// Noise and gate of the estimator.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct EstimatorConfig {
    /// Diffusion coefficient D of the bead, um^2/s.
    pub diffusion_um2_per_s: f64,
    /// Random walk of neutral, um/sqrt(s).
    pub neutral_walk_um_per_sqrt_s: f64,
    /// Relative standard uncertainty of the plant's gain.
    pub gain_uncertainty: f64,
    /// Standard uncertainty of neutral at the start, um.
    pub neutral_initial_um: f64,
    /// Localisation noise assumed where a fix states none, um (standard deviation).
    pub fix_noise_um: f64,
    /// By how much smaller than it is the variance of a fix is taken when the estimate is corrected by it: 1 is the Kalman
    /// filter, the best for the model as it is; more brings the loop nearer to its state feedback, whose margins a filter
    /// that trusts the model takes away (loop transfer recovery, Doyle and Stein 1979). The gate has the variance as it is.
    #[serde(alias = "recovery")]
    pub ltr_noise_scaling: f64,
    /// Exposure of a frame, ms; at most the time from fix to fix. A fix is the mean over it of a path that bends where a command takes effect.
    pub exposure_ms: f64,
    /// Ticks from one fix to the next, 1 to 16: above 1 where the loop is faster than its camera. Ticks between fixes are run on
    /// prediction and are no loss.
    #[serde(skip_serializing_if = "is_one")]
    pub ticks_per_fix: f64,
    /// An innovation larger than this many standard deviations is refused.
    pub gate_sigma: f64,
    /// ... unless it is smaller than this and the fastest motion of the last ticks, um.
    pub gate_floor_um: f64,
    /// After this many refused measurements in a row the next one is believed.
    pub gate_most: u8,
    /// Bead speed granted while the bead is taken for stuck, um per tick: bounds the jump when it comes free. Twice that
    /// is granted for 50 ticks afterwards, so that it goes to a far reference without a jerk.
    pub stuck_speed_um_per_tick: f64,
    /// Gain and delay of the plant are estimated while the loop runs, and the law follows them.
    #[serde(skip_serializing_if = "is_off")]
    pub adapt: bool,
    /// Largest addition of the dither of adaptation to the hold error, %: the gain is known by it, with a standard deviation that falls with
    /// the root. With 0 the loop does not adapt.
    #[serde(skip_serializing_if = "is_usual_dither")]
    pub dither_percent: f64,
}

/// Dither of a file without the key, % of the hold error.
const USUAL_DITHER_PERCENT: f64 = 1.0;

/// A file without the key is of the usual dither.
#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde calls it so")]
fn is_usual_dither(percent: &f64) -> bool {
    *percent == USUAL_DITHER_PERCENT
}

/// A file without the key is one that does not adapt.
#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde calls it so")]
fn is_off(adapt: &bool) -> bool {
    !adapt
}

/// A file without the key is of a camera as fast as the loop.
#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde calls it so")]
fn is_one(ticks: &f64) -> bool {
    *ticks == 1.0
}

impl Default for EstimatorConfig {
    /// A 1 um bead mid-slit (D = 0.33 um^2/s) with 20 nm fixes.
    fn default() -> Self {
        Self {
            diffusion_um2_per_s: 0.33,
            neutral_walk_um_per_sqrt_s: 0.015,
            gain_uncertainty: 0.2,
            neutral_initial_um: 2.0,
            fix_noise_um: 0.020,
            ltr_noise_scaling: 10.0,
            exposure_ms: 0.0,
            ticks_per_fix: 1.0,
            gate_sigma: 6.0,
            gate_floor_um: 0.5,
            gate_most: 1,
            stuck_speed_um_per_tick: 0.5,
            adapt: false,
            dither_percent: USUAL_DITHER_PERCENT,
        }
    }
}

impl EstimatorConfig {
    /// Ticks in a row that may be without a fix and are no loss: none where every tick has one, else those between two fixes and
    /// one more, since fixes come a tick late now and then.
    pub fn planned_gap(&self) -> u32 {
        planned_gap(self.ticks_per_fix)
    }

    /// Whether gain and delay are estimated: nothing tells them without dither.
    pub fn adapts(&self) -> bool {
        self.adapt && self.dither_percent > 0.0
    }

    /// Checks every value.
    pub(super) fn validate(&self, sample_time_s: f64) -> Result<(), BuildError> {
        let c = self;
        check(
            "diffusion_um2_per_s",
            "um^2/s",
            c.diffusion_um2_per_s,
            c.diffusion_um2_per_s > 0.0,
            "positive",
        )?;
        let walk = c.neutral_walk_um_per_sqrt_s;
        check(
            "neutral_walk_um_per_sqrt_s",
            "um/sqrt(s)",
            walk,
            walk >= 0.0,
            "0 or more",
        )?;
        check(
            "gain_uncertainty",
            "",
            c.gain_uncertainty,
            (0.0..=10.0).contains(&c.gain_uncertainty),
            "0 to 10",
        )?;
        check(
            "neutral_initial_um",
            "um",
            c.neutral_initial_um,
            c.neutral_initial_um > 0.0,
            "positive",
        )?;
        check(
            "fix_noise_um",
            "um",
            c.fix_noise_um,
            c.fix_noise_um > 0.0,
            "positive",
        )?;
        check(
            "ltr_noise_scaling",
            "",
            c.ltr_noise_scaling,
            (1.0..=1e6).contains(&c.ltr_noise_scaling),
            "1 (Kalman filter) to 1000000",
        )?;
        check(
            "exposure_ms",
            "ms",
            c.exposure_ms,
            (0.0..=1e3 * sample_time_s * c.ticks_per_fix.max(1.0) + 1e-9).contains(&c.exposure_ms),
            "0 to the time from fix to fix",
        )?;
        check(
            "ticks_per_fix",
            "",
            c.ticks_per_fix,
            (1.0..=16.0).contains(&c.ticks_per_fix),
            "1 to 16",
        )?;
        check(
            "dither_percent",
            "%",
            c.dither_percent,
            c.dither_percent == 0.0 || (0.1..=10.0).contains(&c.dither_percent),
            "0.1 to 10, or 0 for a loop that does not adapt",
        )?;
        check(
            "gate_sigma",
            "",
            c.gate_sigma,
            c.gate_sigma > 0.0,
            "positive",
        )?;
        check(
            "gate_floor_um",
            "um",
            c.gate_floor_um,
            c.gate_floor_um >= 0.0,
            "0 or more",
        )?;
        let speed = c.stuck_speed_um_per_tick;
        check(
            "stuck_speed_um_per_tick",
            "um",
            speed,
            speed > 0.0,
            "positive",
        )
    }
}
