//! The board of the emulated rig in the units of a rig file.

use cellpos_board::{Board, Config};
use cellpos_link::{Limits, picometres};
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
    /// Displacement at the end of a ramp to park, unless the host sets another, um.
    pub park_um: f64,
    /// Bits of the converter, 8..=16.
    pub dac_bits: u8,
    /// Period of the output's updates while it moves, us.
    pub update_us: u32,
    /// Default time without a new command after which the output moves to the zero-flow displacement, ms.
    pub watchdog_ms: u16,
    /// Default holding time before the ramp to park, ms: after that move, in a freeze, and for an armed board without a
    /// command.
    pub hold_watchdog_ms: u16,
    /// Longest watchdog time that a host may request, ms.
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

/// An invalid value of [`BoardConfig`].
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
    /// The board's state machine, switched on at time 0.
    ///
    /// # Errors
    /// [`BoardConfigError`] for the first value that cannot be.
    pub fn board(&self) -> Result<Board, BoardConfigError> {
        self.validate()?;
        let pm = |um: f64| picometres(um).unwrap_or(0);
        let nm_per_s = |um_per_s: f64| (um_per_s * 1e3).round().max(1.0) as u32;
        Board::new(Config {
            serial: self.serial,
            limits: Limits {
                low_pm: pm(self.low_um),
                high_pm: pm(self.high_um),
                slew_nm_per_s: nm_per_s(self.slew_um_per_s),
            },
            ramp_nm_per_s: nm_per_s(self.ramp_um_per_s),
            power_up_pm: pm(self.power_up_um),
            park_pm: pm(self.park_um),
            dac_bits: self.dac_bits,
            update_us: self.update_us,
            watchdog_ms: self.watchdog_ms,
            hold_watchdog_ms: self.hold_watchdog_ms,
            longest_watchdog_ms: self.longest_watchdog_ms,
            late_us: self.late_us,
        })
        .map_err(|_| BoardConfigError {
            key: "high_um",
            value: self.high_um,
            must: "at least 1 pm above `low_um`",
        })
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_configuration_that_cannot_be_names_its_key() {
        let base = BoardConfig::default();
        let of = |change: fn(&mut BoardConfig)| {
            let mut config = base;
            change(&mut config);
            config.board().unwrap_err().key
        };
        assert_eq!(of(|c| c.high_um = -1.0), "high_um");
        assert_eq!(of(|c| c.slew_um_per_s = f64::NAN), "slew_um_per_s");
        assert_eq!(of(|c| c.ramp_um_per_s = 1e6), "ramp_um_per_s");
        assert_eq!(of(|c| c.park_um = 41.0), "park_um");
        assert_eq!(of(|c| c.dac_bits = 17), "dac_bits");
        assert_eq!(of(|c| c.watchdog_ms = 0), "watchdog_ms");
    }

    #[test]
    fn the_default_is_the_default_of_the_board() {
        let board = BoardConfig::default()
            .board()
            .expect("the default is sound");
        assert_eq!(*board.config(), Config::DEFAULT);
    }
}
