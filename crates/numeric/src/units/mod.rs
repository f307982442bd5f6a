//! Physical quantities with their unit in the type: micrometres, seconds, volts, hertz and what follows from them.
//!
//! Every boundary of cellpos (command line, files, records) speaks these units. The parser accepts a quantity only with
//! its unit, and refuses a bare number with a sentence that says what to write. Not for arithmetic in the loop: step
//! functions use plain `f64` with the unit in the name (`error_um`).
//!
//! ```
//! use cellpos_numeric::units::{Micrometers, Seconds};
//! assert_eq!("-250nm".parse(), Ok(Micrometers(-0.25)));
//! assert_eq!("1.5ms".parse(), Ok(Seconds(0.0015)));
//! let error = "10".parse::<Micrometers>().unwrap_err();
//! assert_eq!(error.to_string(), "a length needs a unit: write for example 10um (nm, um, mm, m)");
//! ```

mod parse;
mod spelling;

pub use parse::{UnitError, UnitProblem};
pub use spelling::{nearest, nearest_in};

use core::fmt;
use core::str::FromStr;

/// One accepted spelling of a unit and the factor that brings it to the base unit of its quantity.
pub(crate) struct Unit {
    pub(crate) symbol: &'static str,
    pub(crate) factor: f64,
}

/// The parser's data of a quantity.
pub(crate) struct Quantity {
    pub(crate) noun: &'static str,
    pub(crate) base: &'static str,
    pub(crate) symbols: &'static str,
    pub(crate) units: &'static [Unit],
}

macro_rules! quantity {
    ($(#[$doc:meta])* $name:ident, $noun:literal, $base:literal, [$($symbol:literal = $factor:expr),+ $(,)?], $symbols:literal) => {
        $(#[$doc])*
        #[derive(Debug, Clone, Copy, PartialEq, PartialOrd, Default)]
        pub struct $name(pub f64);

        impl $name {
            const QUANTITY: Quantity = Quantity {
                noun: $noun,
                base: $base,
                symbols: $symbols,
                units: &[$(Unit { symbol: $symbol, factor: $factor }),+],
            };

            /// The number in the quantity's base unit.
            pub const fn value(self) -> f64 {
                self.0
            }
        }

        impl FromStr for $name {
            type Err = UnitError;
            fn from_str(text: &str) -> Result<Self, UnitError> {
                parse::parse(text, &Self::QUANTITY).map(Self)
            }
        }

        impl fmt::Display for $name {
            /// The shortest number that reads back to the same value, with the base unit; `{:.3}` sets decimals.
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                if let Some(decimals) = f.precision() {
                    write!(f, "{:.*}{}", decimals, self.0, $base)
                } else {
                    write!(f, "{}{}", self.0, $base)
                }
            }
        }
    };
}

quantity!(
    /// A length in micrometres (um): bead positions and PZT displacements.
    Micrometers, "a length", "um",
    ["nm" = 1e-3, "um" = 1.0, "\u{b5}m" = 1.0, "\u{3bc}m" = 1.0, "mm" = 1e3, "m" = 1e6],
    "nm, um, mm, m"
);
quantity!(
    /// A time in seconds (s).
    Seconds, "a time", "s",
    ["ns" = 1e-9, "us" = 1e-6, "\u{b5}s" = 1e-6, "\u{3bc}s" = 1e-6, "ms" = 1e-3, "s" = 1.0, "min" = 60.0, "h" = 3600.0],
    "us, ms, s, min, h"
);
quantity!(
    /// A frequency in hertz (Hz), never rad/s.
    Hertz, "a frequency", "Hz",
    ["mHz" = 1e-3, "Hz" = 1.0, "kHz" = 1e3],
    "mHz, Hz, kHz"
);
quantity!(
    /// A speed in micrometres per second (um/s).
    MicrometersPerSecond, "a speed", "um/s",
    ["nm/s" = 1e-3, "um/s" = 1.0, "\u{b5}m/s" = 1.0, "\u{3bc}m/s" = 1.0, "um/ms" = 1e3, "mm/s" = 1e3, "m/s" = 1e6],
    "nm/s, um/s, um/ms, mm/s"
);
quantity!(
    /// An angle in degrees (deg): phases.
    Degrees, "an angle", "deg",
    ["deg" = 1.0, "\u{b0}" = 1.0, "rad" = 57.295_779_513_082_32],
    "deg, rad"
);
quantity!(
    /// A gain in decibels (dB), 20 log10 of an amplitude ratio.
    Decibels, "a gain", "dB",
    ["dB" = 1.0],
    "dB"
);
