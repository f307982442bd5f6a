//! Whether the loop can follow the motions of a script, before anything moves.

use crate::cyclic::Motion;
use crate::outcome::Failure;
use cellpos_script::{Check, PeriodicReference, Plan, Script};
use cellpos_session::setup::Prepared;
use cellpos_session::{Rig, RigFile};

/// Most motions whose error is predicted: each takes a simulation.
const MOST_MOTIONS: usize = 16;

/// Refuses a wave above half the loop's rate.
///
/// # Errors
/// A frequency from half the loop's rate on, with its line.
pub(super) fn below_nyquist(script: &Script, check: &Check, file: &RigFile) -> Result<(), Failure> {
    let rate_hz = 1e6 / file.timing.period_us;
    match check
        .waves
        .iter()
        .find(|wave| wave.frequency_hz >= 0.5 * rate_hz)
    {
        Some(wave) => Err(Failure::bad_input(
            format!(
                "{}:{}: a wave of {} Hz: at {rate_hz:.0} ticks a second, motion at {:.0} Hz or faster looks like a slower one",
                script.file,
                wave.line,
                wave.frequency_hz,
                0.5 * rate_hz
            ),
            "choose a lower frequency, or a faster loop and camera (period_us in [timing])",
        )),
        None => Ok(()),
    }
}

/// Warnings about periodic motions with a predicted error above a tenth of the amplitude.
///
/// # Errors
/// A model or a controller of which no loop can be made.
pub(super) fn warnings(
    plan: &Plan,
    prepared: &Prepared,
    rig: &Rig,
) -> Result<Vec<String>, Failure> {
    let mut warnings = Vec::new();
    for (number, motion) in plan.periodic().iter().enumerate().take(MOST_MOTIONS) {
        let Some(reference) = plan.periodic_reference(number) else {
            continue;
        };
        let motion = Motion {
            name: motion.name(),
            reference: &reference,
            from_s: PeriodicReference::FADE_S,
            frequency_hz: motion.frequency_hz,
        };
        warnings.extend(motion.warning(prepared, rig.file())?);
    }
    for warning in &warnings {
        tracing::warn!("{warning}");
    }
    Ok(warnings)
}
