//! Configuration of a learner: responses of the loop, how to learn, and the errors of a configuration.

use crate::error::{BuildError, check};
use serde::{Deserialize, Serialize};

/// Harmonics that a learner holds.
pub const HARMONICS: usize = 8;

/// Response of the bead to an addition to the command, in the closed loop, at one harmonic.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HarmonicResponse {
    /// Which harmonic: 1 is the reference's own frequency.
    pub harmonic: u32,
    /// Real part, um of bead per um of PZT.
    pub re_um_per_um: f64,
    /// Imaginary part, um of bead per um of PZT.
    pub im_um_per_um: f64,
    /// Bound on `|T_true / T - 1|`.
    pub relative_uncertainty: f64,
}

/// How a learner learns. Runs of older versions have further keys. They are ignored, so that such a run can still
/// be read.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct LearnConfig {
    /// Shortest time over which an error is measured before a correction, cycles.
    pub watch_cycles: f64,
    /// The same in ticks; both must have passed.
    pub watch_ticks: u32,
    /// Final memory, cycles: noise is averaged over it, and a plant that changes faster is not followed.
    pub longest_cycles: f64,
    /// Ticks after a change of the addition until the loop has settled and counts again.
    pub response_ticks: u32,
    /// Largest addition, um of PZT.
    pub most_um: f64,
    /// Growth of the RMS error over that of the start that makes the learner retreat.
    pub retreat_growth: f64,
    /// Ticks without learning after the bead was lost.
    pub settle_ticks: u32,
    /// Ticks from one fix to the next, 1 to 16; see [`crate::EstimatorConfig::ticks_per_fix`].
    pub ticks_per_fix: f64,
    /// Exposure of a frame, s; at most 4 ticks, or the time from fix to fix where that is longer. A fix is the mean over it of a path whose velocity changes with each
    /// command, and is compared with the mean of the reference's path: at 300 Hz the two differ from the positions at the
    /// middle by a fifth of the amplitude.
    pub exposure_s: f64,
}

impl Default for LearnConfig {
    fn default() -> Self {
        Self {
            watch_cycles: 2.0,
            watch_ticks: 10,
            longest_cycles: 33.0,
            response_ticks: 8,
            most_um: 20.0,
            retreat_growth: 1.5,
            settle_ticks: 20,
            ticks_per_fix: 1.0,
            exposure_s: 0.0,
        }
    }
}

impl LearnConfig {
    /// Checks every value.
    pub(super) fn validate(&self, sample_time_s: f64) -> Result<(), BuildError> {
        let positive = |key, unit, value: f64| check(key, unit, value, value > 0.0, "positive");
        positive("watch_cycles", "cycles", self.watch_cycles)?;
        positive("most_um", "um", self.most_um)?;
        let ticks = f64::from(self.watch_ticks);
        check("watch_ticks", "ticks", ticks, ticks >= 8.0, "8 or more")?;
        let longest = self.longest_cycles;
        let room = longest >= self.watch_cycles;
        check(
            "longest_cycles",
            "cycles",
            longest,
            room,
            "watch_cycles or more",
        )?;
        let apart = self.ticks_per_fix;
        let known = (1.0..=16.0).contains(&apart);
        check("ticks_per_fix", "", apart, known, "1 to 16")?;
        let growth = self.retreat_growth;
        check("retreat_growth", "", growth, growth > 1.0, "above 1")?;
        let most_s = self.ticks_per_fix.max(4.0) * sample_time_s + 1e-12;
        let open = (0.0..=most_s).contains(&self.exposure_s);
        check(
            "exposure_s",
            "s",
            self.exposure_s,
            open,
            "0 to 4 ticks, or to the time from fix to fix",
        )
    }
}

/// Why a learner cannot be made.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum LearnError {
    /// A value of the configuration.
    #[error(transparent)]
    Value(#[from] BuildError),
    /// No harmonic passes the convergence test.
    #[error(
        "learning at {frequency_hz} Hz would not be sure to converge: the loop's response to an addition is uncertain by {uncertainty:.2} of itself, and must be by less than {most}; identify the plant, or choose a lower frequency or another controller"
    )]
    NotConvergent {
        /// Frequency of the reference, Hz.
        frequency_hz: f64,
        /// Smallest relative uncertainty of its harmonics.
        uncertainty: f64,
        /// Bound.
        most: f64,
    },
    /// A table of another frequency.
    #[error(
        "the learned table is for {table_hz} Hz, the reference has {frequency_hz} Hz: learn again"
    )]
    OtherFrequency {
        /// Of the table, Hz.
        table_hz: f64,
        /// Of the reference, Hz.
        frequency_hz: f64,
    },
    /// A table with an impossible harmonic.
    #[error(
        "the learned table has harmonic {harmonic}: must be 1 to {HARMONICS}, below {highest_hz} Hz"
    )]
    Harmonic {
        /// Found.
        harmonic: u32,
        /// Highest frequency, Hz.
        highest_hz: f64,
    },
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_configuration_of_an_older_run_is_read() {
        let old = "rate_per_cycle = 0.5\nfast_cycles = 10.0\nwatch_cycles = 3.0\nmost_um = 5.0";
        let read: LearnConfig = toml::from_str(old).unwrap();
        assert_eq!((read.watch_cycles, read.most_um), (3.0, 5.0));
        assert_eq!(read.longest_cycles, LearnConfig::default().longest_cycles);
    }
}
