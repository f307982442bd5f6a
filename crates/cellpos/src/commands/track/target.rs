//! Whether what is to be reached is in view.

use crate::outcome::Failure;
use cellpos_numeric::units::Micrometers;
use cellpos_session::Rig;

/// Target, and the ends of a sine about it, have to be in view.
pub(super) fn check(
    target: Micrometers,
    amplitude: Option<Micrometers>,
    rig: &Rig,
) -> Result<(), Failure> {
    let [low_um, high_um] = rig.source().field_um;
    let seen = |um: f64| (low_um..=high_um).contains(&um);
    if seen(target.value()) {
        let Some(reach) = amplitude else {
            return Ok(());
        };
        let ends = [
            target.value() - reach.value(),
            target.value() + reach.value(),
        ];
        if ends.into_iter().all(seen) {
            return Ok(());
        }
        let most = (target.value() - low_um).min(high_um - target.value());
        return Err(Failure::bad_input(
            format!(
                "--sine {reach}: about --target {target} it goes from {:.1}um to {:.1}um, but the camera sees only {low_um:.1}um to {high_um:.1}um",
                ends[0], ends[1]
            ),
            format!(
                "write an amplitude of at most {most:.1}um, or move the field of view (origin_px, width_px)"
            ),
        ));
    }
    Err(Failure::bad_input(
        format!("--target {target}: outside what the camera sees, {low_um:.1}um to {high_um:.1}um"),
        "choose a target inside, or move the field of view (origin_px, width_px)",
    ))
}
