//! What a board is built and set up for.

use serde::{Deserialize, Serialize};

/// Properties of a board. In TOML every key may be left out; lengths in um, rates in um/s, times in ms or us.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct BoardConfig {
    /// Serial number.
    pub serial: u32,
    /// Smallest displacement, um (code 0).
    pub low_um: f64,
    /// Largest displacement, um (highest code).
    pub high_um: f64,
    /// Largest rate of the output, um/s.
    pub slew_um_per_s: f64,
    /// Rate of a ramp to park, um/s.
    pub ramp_um_per_s: f64,
    /// Displacement after power-up, until the first session ends, um.
    pub power_up_um: f64,
    /// Where a ramp to park ends unless the host says otherwise, um.
    pub park_um: f64,
    /// Bits of the converter, 8..=16.
    pub dac_bits: u8,
    /// Period of the output's updates while it moves, us.
    pub update_us: u32,
    /// Default watchdog on missing commands while running, ms.
    pub watchdog_ms: u16,
    /// Default watchdog while frozen or armed, ms.
    pub hold_watchdog_ms: u16,
    /// Longest watchdog time that a host may ask for, ms.
    pub longest_watchdog_ms: u16,
    /// A command that took this much longer than the fastest one counts as late, us.
    pub late_us: u32,
}

impl Default for BoardConfig {
    /// The drive of the paper: 0..40 um. 40 um/ms lets the full stroke swing at 300 Hz; a ramp to park takes 20 ms for
    /// half the stroke. Power-up at mid-stroke, so that the PZT can move both ways.
    fn default() -> Self {
        Self {
            serial: 1,
            low_um: 0.0,
            high_um: 40.0,
            slew_um_per_s: 40_000.0,
            ramp_um_per_s: 1_000.0,
            power_up_um: 20.0,
            park_um: 0.0,
            dac_bits: 16,
            update_us: 100,
            watchdog_ms: 20,
            hold_watchdog_ms: 2_000,
            longest_watchdog_ms: 10_000,
            late_us: 2_000,
        }
    }
}

/// A value of [`BoardConfig`] that cannot be.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[error("board: `{key}` is {value}, must be {must}")]
pub struct BoardConfigError {
    /// Key.
    pub key: &'static str,
    /// Value found.
    pub value: f64,
    /// What would be right.
    pub must: &'static str,
}

impl BoardConfig {
    /// One step of the converter, um.
    pub fn step_um(&self) -> f64 {
        (self.high_um - self.low_um) / self.highest_code()
    }

    pub(super) fn highest_code(&self) -> f64 {
        ((1_u32 << self.dac_bits.min(16)) - 1) as f64
    }

    /// Checks every value.
    ///
    /// # Errors
    /// [`BoardConfigError`] for the first value that cannot be.
    pub fn validate(&self) -> Result<(), BoardConfigError> {
        // i32 picometres reach to 2147 um.
        const FARTHEST_UM: f64 = 2_000.0;
        let check = |good: bool, key, value, must| {
            if good {
                Ok(())
            } else {
                Err(BoardConfigError { key, value, must })
            }
        };
        let positive = |v: f64| v.is_finite() && v > 0.0;
        let within = |v: f64| (self.low_um..=self.high_um).contains(&v);
        check(
            self.low_um.abs() <= FARTHEST_UM,
            "low_um",
            self.low_um,
            "finite and within +-2000 um",
        )?;
        check(
            self.high_um.abs() <= FARTHEST_UM && self.high_um > self.low_um,
            "high_um",
            self.high_um,
            "finite, above `low_um` and at most 2000 um",
        )?;
        check(
            positive(self.slew_um_per_s) && self.slew_um_per_s <= 4e6,
            "slew_um_per_s",
            self.slew_um_per_s,
            "above 0 and at most 4e6 um/s",
        )?;
        check(
            positive(self.ramp_um_per_s) && self.ramp_um_per_s <= self.slew_um_per_s,
            "ramp_um_per_s",
            self.ramp_um_per_s,
            "above 0 and at most `slew_um_per_s`",
        )?;
        check(
            within(self.power_up_um),
            "power_up_um",
            self.power_up_um,
            "within `low_um`..`high_um`",
        )?;
        check(
            within(self.park_um),
            "park_um",
            self.park_um,
            "within `low_um`..`high_um`",
        )?;
        check(
            (8..=16).contains(&self.dac_bits),
            "dac_bits",
            f64::from(self.dac_bits),
            "8..=16",
        )?;
        check(
            (1..=10_000).contains(&self.update_us),
            "update_us",
            f64::from(self.update_us),
            "1..=10000 us",
        )?;
        check(
            self.longest_watchdog_ms > 0,
            "longest_watchdog_ms",
            f64::from(self.longest_watchdog_ms),
            "above 0 ms",
        )?;
        let allowed = 1..=self.longest_watchdog_ms;
        check(
            allowed.contains(&self.watchdog_ms),
            "watchdog_ms",
            f64::from(self.watchdog_ms),
            "above 0 and at most `longest_watchdog_ms`",
        )?;
        check(
            allowed.contains(&self.hold_watchdog_ms),
            "hold_watchdog_ms",
            f64::from(self.hold_watchdog_ms),
            "above 0 and at most `longest_watchdog_ms`",
        )
    }
}
