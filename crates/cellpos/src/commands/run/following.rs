//! Whether the loop can follow the motions of a script, before anything moves.

use crate::cyclic::Motion;
use crate::outcome::Failure;
use cellpos_script::{PeriodicReference, Plan};
use cellpos_session::Rig;
use cellpos_session::setup::Prepared;

/// Most motions whose error is predicted: each takes a simulation.
const MOST_MOTIONS: usize = 16;

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
