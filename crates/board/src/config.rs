//! Configuration of a board, in whole numbers.

use cellpos_link::Limits;

/// Properties of a board. Lengths in picometres, rates in nm/s, times in ms or us.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Config {
    /// Serial number.
    pub serial: u32,
    /// Range (code 0 is its lower end, the highest code its upper one) and largest rate of the output.
    pub limits: Limits,
    /// Rate of a ramp to park, nm/s.
    pub ramp_nm_per_s: u32,
    /// Displacement after power-up, until the first session, pm: the converter's output when it is switched on.
    pub power_up_pm: i32,
    /// Displacement at the end of a ramp to park, unless the host sets another, pm.
    pub park_pm: i32,
    /// Bits of the converter, 8..=16.
    pub dac_bits: u8,
    /// Period of the output's updates while it moves, us.
    pub update_us: u32,
    /// Default time without a new command after which the output moves to the zero-flow displacement, ms.
    pub watchdog_ms: u16,
    /// Default holding time before the ramp to park, ms: after that move, in a freeze, and for an armed board without a
    /// command.
    pub hold_watchdog_ms: u16,
    /// Longest time that a host may request for either, ms.
    pub longest_watchdog_ms: u16,
    /// A command that took this much longer than the fastest one counts as late, us.
    pub late_us: u32,
}

impl Config {
    /// The drive of the paper: 0..40 um. 40 um/ms lets the full stroke swing at 300 Hz; a ramp to park takes 20 ms for
    /// half the stroke. Power-up at mid-stroke, so that the PZT can move both ways.
    pub const DEFAULT: Self = Self {
        serial: 1,
        limits: Limits {
            low_pm: 0,
            high_pm: 40_000_000,
            slew_nm_per_s: 40_000_000,
        },
        ramp_nm_per_s: 1_000_000,
        power_up_pm: 20_000_000,
        park_pm: 0,
        dac_bits: 16,
        update_us: 100,
        watchdog_ms: 20,
        hold_watchdog_ms: 2_000,
        longest_watchdog_ms: 10_000,
        late_us: 2_000,
    };

    /// Highest code of the converter.
    pub const fn highest_code(&self) -> u16 {
        // `dac_bits` must be 8..=16; any other value counts as 16.
        match self.dac_bits {
            8..=15 => (1 << self.dac_bits) - 1,
            _ => u16::MAX,
        }
    }

    /// Checks every value.
    ///
    /// # Errors
    /// [`ConfigError`] for the first invalid value.
    pub const fn validate(&self) -> Result<(), ConfigError> {
        const FARTHEST_PM: i32 = 2_000_000_000;
        let Limits {
            low_pm,
            high_pm,
            slew_nm_per_s,
        } = self.limits;
        let outside_power_up = self.power_up_pm < low_pm || self.power_up_pm > high_pm;
        let outside_park = self.park_pm < low_pm || self.park_pm > high_pm;
        Err(
            if low_pm < -FARTHEST_PM || high_pm > FARTHEST_PM || low_pm >= high_pm {
                ConfigError::Range
            } else if slew_nm_per_s == 0 {
                ConfigError::Slew
            } else if self.ramp_nm_per_s == 0 || self.ramp_nm_per_s > slew_nm_per_s {
                ConfigError::Ramp
            } else if outside_power_up {
                ConfigError::PowerUp
            } else if outside_park {
                ConfigError::Park
            } else if self.dac_bits < 8 || self.dac_bits > 16 {
                ConfigError::DacBits
            } else if self.update_us == 0 || self.update_us > 10_000 {
                ConfigError::Update
            } else if self.watchdog_ms == 0
                || self.hold_watchdog_ms == 0
                || self.watchdog_ms > self.longest_watchdog_ms
                || self.hold_watchdog_ms > self.longest_watchdog_ms
            {
                ConfigError::Watchdog
            } else {
                return Ok(());
            },
        )
    }
}

impl Default for Config {
    fn default() -> Self {
        Self::DEFAULT
    }
}

/// The invalid value of a [`Config`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ConfigError {
    /// The range is empty or reaches beyond +-2000 um.
    Range,
    /// No slew.
    Slew,
    /// No rate of the ramp, or one above the slew.
    Ramp,
    /// Power-up outside the range.
    PowerUp,
    /// Park outside the range.
    Park,
    /// A converter of less than 8 or more than 16 bits.
    DacBits,
    /// A period of updates of zero or above 10 ms.
    Update,
    /// A watchdog time of zero, or above the longest allowed.
    Watchdog,
}

impl core::fmt::Display for ConfigError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(match self {
            Self::Range => "the range must not be empty and lie within +-2000 um",
            Self::Slew => "the slew must be above 0",
            Self::Ramp => "the rate of the ramp to park must be above 0 and at most the slew",
            Self::PowerUp => "the displacement after power-up must lie within the range",
            Self::Park => "the park displacement must lie within the range",
            Self::DacBits => "the converter must have 8 to 16 bits",
            Self::Update => "the period of updates must be 1 to 10000 us",
            Self::Watchdog => {
                "both watchdog times must be above 0 and at most the longest time allowed"
            }
        })
    }
}

impl core::error::Error for ConfigError {}
