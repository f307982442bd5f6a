//! Settings of a board's trial, and names of its lines.

use super::talk::Talk;
use cellpos_session::Failure;

/// Settings of a trial.
pub struct Trial<'a> {
    /// Range and slew of the rig file, um and um/s; the trial stays within them.
    pub limits_um: [f64; 3],
    /// Displacement of the PZT at the end, um.
    pub park_um: f64,
    /// How far the output is moved to each side, um.
    pub amplitude_um: f64,
    /// Opens the line again after a reset, and asks for the reset; none: the reset is not tried.
    pub reset: Option<&'a mut dyn FnMut(Talk) -> Result<Talk, Failure>>,
}

pub(super) const fn of(name: &'static str) -> (&'static str, &'static str) {
    ("board", name)
}

/// A picometre number in um.
pub(super) fn um(pm: i32) -> f64 {
    cellpos_link::um_from_picometres(pm)
}
