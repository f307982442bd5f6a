//! The processes and interrupts named for late wake-ups.

use serde::Serialize;

/// Something that ran while the loop was late.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Suspect {
    /// A process with its number, or an interrupt with its device.
    pub name: String,
    /// In how many of the late wake-ups, or late tenths of a second, it ran.
    pub times: u64,
    /// Its processor time in them, ms; for an interrupt how often it came.
    pub amount: f64,
    /// `ms` or `interrupts`.
    pub unit: &'static str,
}
