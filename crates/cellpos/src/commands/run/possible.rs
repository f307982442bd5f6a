//! What a rig can do of a script, before anything moves: one answer for `cellpos check` and `cellpos run`.

use crate::outcome::Failure;
use cellpos_emulator::{CellConfig, WorldConfig};
use cellpos_script::{Check, CheckLimits, Plan, Script, check};
use cellpos_session::rig_file::{ActuatorConfig, CameraConfig};
use cellpos_session::setup::Prepared;
use cellpos_session::{Rig, RigFile};

/// The limits in force for a controller that is fitted to a rig.
pub(in crate::commands) fn limits(prepared: &Prepared, rig: &Rig) -> CheckLimits {
    let limits = prepared.controller.limits;
    let [low_um, high_um] = rig.source().field_um;
    CheckLimits {
        low_um: limits.low_um,
        high_um: limits.high_um,
        slew_um_per_s: limits.slew_um_per_s,
        neutral_um: rig.first_zero_flow_um(&prepared.model),
        view_um: high_um.min(-low_um),
        sample_s: rig.file().timing.period_us * 1e-6,
        ..CheckLimits::default()
    }
}

/// Checks a script within `limits`: limits that it breaks are in the result.
///
/// # Errors
/// What no factor on its positions can mend: it needs a length that is not measured, or a wave is too fast for the loop.
pub(in crate::commands) fn checked(
    script: &Script,
    plan: &Plan,
    prepared: &Prepared,
    limits: &CheckLimits,
    file: &RigFile,
) -> Result<Check, Failure> {
    measurable(script, plan, file)?;
    let found = check(script, &prepared.model, limits).map_err(Failure::input)?;
    below_nyquist(script, &found, file)?;
    Ok(found)
}

/// Checks a script with the limits in force.
///
/// # Errors
/// As [`checked`], and a limit that it breaks.
pub(super) fn allowed(
    script: &Script,
    plan: &Plan,
    prepared: &Prepared,
    rig: &Rig,
) -> Result<(), Failure> {
    let result = checked(script, plan, prepared, &limits(prepared, rig), rig.file())?;
    match result.violations.first() {
        Some(first) => Err(Failure::bad_input(
            format!(
                "{}:{}: {}: {:.3} {unit} asked for, {:.3} {unit} allowed: the rig cannot do it",
                script.file,
                first.line,
                first.what,
                first.asked,
                first.allowed,
                unit = first.unit
            ),
            format!(
                "scale all positions by {:.3} or less; see cellpos check",
                result.largest_factor
            ),
        )),
        None => Ok(()),
    }
}

/// Whether the field of view is known without asking the camera: it is emulated, or `[emulator]` says how large its picture is.
pub(in crate::commands) fn knows_field(file: &RigFile) -> bool {
    let usual = WorldConfig::default();
    matches!(file.camera, CameraConfig::Emulated {})
        || file.emulator.width_px != usual.width_px
        || file.emulator.pixel_um.total_cmp(&usual.pixel_um).is_ne()
}

/// The rig of `--dry`: everything of the rig file but its devices, which are emulated as the model says. If the field of view is not known,
/// it reaches as far as [`CheckLimits`] assumes.
pub(in crate::commands) fn rehearse(file: &mut RigFile, model: &str) {
    file.actuator = match (file.actuator.period_ms(), file.actuator.lags_ms()) {
        (Some(period_ms), [regulator_ms, compliance_ms]) => ActuatorConfig::EmulatedPressure {
            period_ms,
            regulator_ms,
            compliance_ms,
        },
        (None, _) => ActuatorConfig::Emulated {},
    };
    let knows_field = knows_field(file);
    file.camera = CameraConfig::Emulated {};
    file.calibration = None;
    file.emulator.model = model.to_string();
    // A loop at the pace of a slow actuator takes the newest of several frames.
    if file.actuator.period_ms().is_none() {
        file.emulator.rate_hz = 1e6 / file.timing.period_us;
    }
    file.emulator.latency_ms = file.timing.camera_delay_ms;
    if file.cell.is_some() && file.emulator.cell.is_none() {
        file.emulator.cell = Some(CellConfig::default());
        if file.emulator.validate().is_err() {
            // A field that holds the cell at rest and stretched.
            (file.emulator.width_px, file.emulator.height_px) = (256, 64);
            file.emulator.pixel_um = 0.2;
        }
    }
    if !knows_field {
        let world = &mut file.emulator;
        // The outer pixels' centres are the border of the field.
        let width_px = 2.0 * CheckLimits::default().view_um / world.pixel_um + 1.0;
        world.width_px = width_px.ceil().clamp(8.0, 4096.0) as u16;
    }
}

/// Waiting for a length needs a measured length.
fn measurable(script: &Script, plan: &Plan, file: &RigFile) -> Result<(), Failure> {
    if !plan.needs_length() || file.follows_a_cell() {
        return Ok(());
    }
    Err(Failure::bad_input(
        format!(
            "{}: it waits for cell-length or stops on length_change_above, but the loop follows a bead and measures no length",
            script.file
        ),
        "follow a cell: a table [cell] in rig.toml, or [emulator.cell] for the emulated rig",
    ))
}

/// Refuses a wave above half the loop's rate.
///
/// # Errors
/// A frequency from half the loop's rate on, with its line.
fn below_nyquist(script: &Script, check: &Check, file: &RigFile) -> Result<(), Failure> {
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
