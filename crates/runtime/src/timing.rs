//! Times and counts of the loop, and why a loop cannot be built.

use cellpos_control::BuildError;
use cellpos_plant::PlantError;
use serde::{Deserialize, Serialize};

/// Times and counts of the loop. In TOML every key may be left out.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Timing {
    /// Period of the loop, us: that of the camera.
    pub period_us: f64,
    /// From the start of a tick to the latest hand-over of its command, us.
    pub budget_us: f64,
    /// Of the budget, what an optimising controller may use, us; past it the best feasible point so far is followed.
    pub solver_us: f64,
    /// From the middle of an exposure to the tick that uses it, ms: the camera path.
    pub camera_delay_ms: f64,
    /// Oldest exposure that may still be controlled on, ms.
    pub oldest_ms: f64,
    /// Late ticks, or stale frames, in a row that latch Safe.
    pub faults_in_a_row: u32,
    /// Ticks on prediction alone before the bead is frozen.
    pub coast_ticks: u32,
    /// Ticks without a position before Safe is latched.
    pub lost_ticks: u32,
    /// Silence of the board that latches Safe, ms.
    pub board_silence_ms: f64,
}

impl Default for Timing {
    fn default() -> Self {
        Self {
            period_us: 1000.0,
            budget_us: 500.0,
            solver_us: 170.0,
            camera_delay_ms: 2.0,
            oldest_ms: 5.0,
            faults_in_a_row: 5,
            coast_ticks: 20,
            lost_ticks: 1000,
            board_silence_ms: Self::BOARD_SILENCE_MS,
        }
    }
}

impl Timing {
    /// A line that stalls for 200 ms, the 10 ms between two reports of the board, and a period of the loop on either side.
    pub const BOARD_SILENCE_MS: f64 = 212.0;

    /// Period of the loop, ns.
    pub fn period_ns(&self) -> i64 {
        (self.period_us * 1e3).round() as i64
    }

    /// Silence after which a board is asked to hold zero flow, ms. A command is made for the next two delays: in the first its effect is
    /// not seen yet, in the second the next ones answer it. A PZT that keeps it for longer drives the bead past its target. Five periods
    /// at least, so that a few lost commands hold nothing.
    pub fn board_watchdog_ms(&self) -> u16 {
        let period_ms = self.period_us * 1e-3;
        let delay_ms = self.camera_delay_ms + 0.5 * period_ms;
        (2.0 * delay_ms).max(5.0 * period_ms).ceil().min(1e4) as u16
    }

    /// Budget of a tick, ns.
    pub fn budget_ns(&self) -> i64 {
        (self.budget_us * 1e3).round() as i64
    }

    /// Oldest exposure that may still be controlled on, ns.
    pub fn oldest_ns(&self) -> i64 {
        Self::ms_to_ns(self.oldest_ms)
    }

    pub(crate) fn ms_to_ns(ms: f64) -> i64 {
        (ms * 1e6).round() as i64
    }

    /// Checks every value.
    ///
    /// # Errors
    /// Key, value and what would be right.
    pub fn validate(&self) -> Result<(), CoreError> {
        let positive = |key, value: f64, most| {
            if value.is_finite() && value > 0.0 && value <= most {
                Ok(())
            } else {
                Err(CoreError::Timing { key, value, most })
            }
        };
        positive("period_us", self.period_us, 1e6)?;
        positive("budget_us", self.budget_us, self.period_us)?;
        positive("solver_us", self.solver_us, self.period_us)?;
        positive("camera_delay_ms", self.camera_delay_ms, 1e3)?;
        positive("oldest_ms", self.oldest_ms, 1e4)?;
        positive("board_silence_ms", self.board_silence_ms, 1e5)?;
        positive("faults_in_a_row", f64::from(self.faults_in_a_row), 1e6)?;
        positive("coast_ticks", f64::from(self.coast_ticks), 1e6)?;
        positive("lost_ticks", f64::from(self.lost_ticks), 1e9)
    }
}

/// Why a core cannot be built.
#[derive(Debug, thiserror::Error)]
pub enum CoreError {
    /// A number of [`Timing`].
    #[error("timing: {key} = {value}: must be above 0 and at most {most}")]
    Timing {
        /// Key.
        key: &'static str,
        /// Value found.
        value: f64,
        /// Largest value allowed.
        most: f64,
    },
    /// Controller, estimator or limits.
    #[error("controller: {0}")]
    Control(#[from] BuildError),
    /// The plant of the arming check.
    #[error("plant: {0}")]
    Plant(#[from] PlantError),
}
