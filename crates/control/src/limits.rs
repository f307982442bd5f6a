//! Limits of the command: finite, within range, within slew. The last step of every tick, whatever went before.

use crate::error::{BuildError, check};
use serde::{Deserialize, Serialize};

/// Range, slew and park displacement of the PZT.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Limits {
    /// Smallest displacement, um.
    pub low_um: f64,
    /// Largest displacement, um.
    pub high_um: f64,
    /// Largest change of the command, um/s.
    pub slew_um_per_s: f64,
    /// Where a safe stop ends, um.
    pub park_um: f64,
}

impl Default for Limits {
    /// The drive of the paper: 0..40 um. The slew serves 0.5 um of bead amplitude at 300 Hz.
    fn default() -> Self {
        Self {
            low_um: 0.0,
            high_um: 40.0,
            slew_um_per_s: 10_000.0,
            park_um: 0.0,
        }
    }
}

/// A command after the limits, and which of them acted.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limited {
    /// Finite, within range, within slew of the previous command, um.
    pub command_um: f64,
    /// The request was outside the range.
    pub range: bool,
    /// The request was further away than one tick's slew.
    pub slew: bool,
    /// The request was not a finite number; the previous command was kept.
    pub not_finite: bool,
}

/// Part of the range by which a request may pass a limit before that counts: 2.4 pm of 40 um, far below any DAC's step.
const ROUNDING: f64 = 6e-8;

impl Limits {
    /// Checks that the range is a range, the slew positive and the park displacement within the range.
    ///
    /// # Errors
    /// [`BuildError::OutOfRange`] naming the key.
    pub fn validate(&self) -> Result<(), BuildError> {
        check(
            "low_um",
            "um",
            self.low_um,
            self.low_um.abs() <= 1e6,
            "at least -1e6 um: the range of the PZT begins at 0 or a few um below",
        )?;
        let in_reach = self.high_um.abs() <= 1e6;
        check(
            "high_um",
            "um",
            self.high_um,
            in_reach,
            "at most 1e6 um: the range of the PZT, some 40 um",
        )?;
        let high_ok = self.high_um > self.low_um;
        check("high_um", "um", self.high_um, high_ok, "larger than low_um")?;
        check(
            "slew_um_per_s",
            "um/s",
            self.slew_um_per_s,
            self.slew_um_per_s > 0.0,
            "positive",
        )?;
        let park_ok = (self.low_um..=self.high_um).contains(&self.park_um);
        check(
            "park_um",
            "um",
            self.park_um,
            park_ok,
            "within low_um..high_um",
        )
    }

    /// The nearest displacement within the range, um; park for a number that is not finite.
    pub fn nearest(&self, displacement_um: f64) -> f64 {
        let wanted = if displacement_um.is_finite() {
            displacement_um
        } else {
            self.park_um
        };
        wanted.clamp(self.low_um, self.high_um)
    }

    /// Limits a request, given the previous command (already within the range) and the sample time.
    pub fn apply(&self, requested_um: f64, previous_um: f64, sample_time_s: f64) -> Limited {
        let not_finite = !requested_um.is_finite();
        let wanted = if not_finite {
            previous_um
        } else {
            requested_um
        };
        let in_range = wanted.clamp(self.low_um, self.high_um);
        let most = self.slew_um_per_s * sample_time_s;
        let command_um = in_range.clamp(previous_um - most, previous_um + most);
        // A plan within the limits may miss them by the rounding of its arithmetic.
        let least_um = ROUNDING * (self.high_um - self.low_um);
        Limited {
            command_um,
            range: (in_range - wanted).abs() > least_um,
            slew: (command_um - in_range).abs() > least_um,
            not_finite,
        }
    }
}
