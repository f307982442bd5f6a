//! The devices of a rig in the hands of the session that armed them.

use crate::failure::Failure;
use crate::rig_file::{ClockKind, Connected, Frames};
use cellpos_rig::{ActuatorFault, ActuatorReport, ActuatorState};
use std::hash::{BuildHasher, Hasher};
use std::time::Duration;

/// Options for the use of a rig.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Options {
    /// The clock (an emulated rig may run on either).
    pub clock: ClockKind,
    /// Whether an emulated rig renders frames.
    pub frames: Frames,
    /// Run without real-time priority.
    pub best_effort: bool,
}

impl Default for Options {
    /// The machine's clock, frames, real time.
    fn default() -> Self {
        Self {
            clock: ClockKind::Real,
            frames: Frames::On,
            best_effort: false,
        }
    }
}

impl Options {
    /// The emulated rig as fast as the machine can: virtual clock, positions without pictures.
    pub fn rehearsal() -> Self {
        Self {
            clock: ClockKind::Virtual,
            frames: Frames::Off,
            best_effort: true,
        }
    }
}

/// The devices; parked when dropped, if they were armed.
pub(crate) struct Devices {
    pub(crate) connected: Connected,
    /// Whether the board may be armed.
    pub(crate) armed: bool,
}

impl Devices {
    /// Ends the session on the board: frozen for a moment, then at park.
    pub(crate) fn disarm(&mut self) {
        if std::mem::take(&mut self.armed) {
            let actuator = self.connected.actuator.as_mut();
            // If this fails, the board's own watchdog does the same.
            if actuator.freeze().is_ok() && !self.connected.clock.is_virtual() {
                std::thread::sleep(Duration::from_millis(20));
            }
            let _ = actuator.disarm();
        }
    }
}

impl Drop for Devices {
    fn drop(&mut self) {
        self.disarm();
    }
}

/// Checks the board's answer to `arm`: it must be armed, at the displacement that it had.
pub(crate) fn check_armed(
    report: &ActuatorReport,
    session: u16,
    expected_um: f64,
    step_um: f64,
) -> Result<(), Failure> {
    let armed = report.state == ActuatorState::Armed && report.fault == ActuatorFault::None;
    if !armed || report.session != session {
        return Err(Failure::Failed(miette::miette!(
            help = "switch the board off and on; does another program use it?",
            "the board should be armed in session {session}, but is {:?} in session {}, with the fault {:?}",
            report.state,
            report.session,
            report.fault
        )));
    }
    // Rounded to a code of the converter on either side.
    if (report.applied_um - expected_um).abs() > 2.0 * step_um.max(1e-6) {
        return Err(Failure::Failed(miette::miette!(
            help = "does another program use the board? Start again when the PZT is at rest",
            "the PZT moved from {expected_um:.4} um to {:.4} um when the board was armed",
            report.applied_um
        )));
    }
    Ok(())
}

/// A session number that another host is unlikely to choose, never 0.
pub(crate) fn session_number() -> u16 {
    // The standard library seeds its hashers from the operating system.
    let random = std::collections::hash_map::RandomState::new()
        .build_hasher()
        .finish();
    ((random ^ (random >> 16) ^ (random >> 32) ^ (random >> 48)) as u16).max(1)
}
