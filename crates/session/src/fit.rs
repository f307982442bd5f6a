//! A controller adapted to a rig: limits, field of view, exposure and frame rate.

use crate::Failure;
use crate::prepared::Prepared;
use crate::rig_file::{CameraConfig, Connected, RigFile};
use crate::setup;
use cellpos_control::ControllerKind;
use cellpos_plant::Model;
use cellpos_plant::effects::Action;
use cellpos_rig::SourceInfo;

/// Narrows the controller's limits to those of rig file and board, and MPC's positions to the field of view. Passes exposure and
/// frame rate to the estimator.
pub(crate) fn narrow(setup: &mut Prepared, file: &RigFile, rig: &Connected) {
    let board = rig.actuator.info();
    let own = setup.controller.limits;
    let asked = setup::within(file.limits, [own.low_um, own.high_um, own.slew_um_per_s]);
    setup.controller.limits =
        setup::within(asked, [board.low_um, board.high_um, board.slew_um_per_s]);
    let exposure_ms = 1e3 * exposure_s(file, &rig.source.info(), &setup.model);
    let estimator = &mut setup.controller.estimator;
    if estimator.ticks_per_fix == 1.0 {
        estimator.ticks_per_fix = ticks_per_fix(file.timing.period_us, rig.source.info().rate_hz);
    }
    let apart_ms = file.timing.period_us * 1e-3 * estimator.ticks_per_fix;
    if estimator.exposure_ms == 0.0 && exposure_ms <= apart_ms {
        estimator.exposure_ms = exposure_ms;
    }
    let [low_um, high_um] = rig.source.info().field_um;
    if setup.controller.controller == ControllerKind::Mpc && low_um < high_um {
        let mpc = &mut setup.controller.mpc;
        let given = |view_um: Option<f64>| view_um.filter(|um| um.is_finite());
        mpc.view_low_um = given(Some(mpc.view_low_um.map_or(low_um, |um| um.max(low_um))));
        mpc.view_high_um = given(Some(mpc.view_high_um.map_or(high_um, |um| um.min(high_um))));
    }
}

/// Ticks per frame of a camera that is slower than the loop; 1 if it is about as fast.
fn ticks_per_fix(period_us: f64, rate_hz: f64) -> f64 {
    /// A camera whose rate is off by less counts as equally fast.
    const AS_FAST: f64 = 1.25;
    let ticks = 1e6 / (period_us * rate_hz);
    if ticks.is_finite() && ticks >= AS_FAST {
        ticks.min(16.0)
    } else {
        1.0
    }
}

/// Key of a model's provenance: the board with which it was identified, by its own description.
pub const OF_BOARD: &str = "board";

/// Zero flow at which a run with this model begins, um: the newest that was measured on this rig. That is the one of the run before in
/// this program, else the model's if it was identified with this board. Without either it is the rig file's `first_neutral`.
///
/// An emulated rig is a new one in each run: the zero flow of its model is no measurement of it.
pub(crate) fn first_zero_flow_um(file: &RigFile, model: &Model, board: &str) -> f64 {
    let of_model = (model.provenance.get(OF_BOARD))
        .filter(|of| !file.is_emulated() && *of == board)
        .map(|_| model.working_point_um);
    let measured_um = (file.rested_um.or(of_model))
        .filter(|um| (file.limits.low_um..=file.limits.high_um).contains(um));
    if let (Some(um), None) = (measured_um, file.rested_um) {
        tracing::info!(
            "the run begins at {um:.3} um, the zero flow that the model measured with this board"
        );
    }
    measured_um.unwrap_or(file.first_neutral_um)
}

/// Exposure of a frame, s, if the rig file states it.
pub fn stated_exposure_s(file: &RigFile) -> Option<f64> {
    match &file.camera {
        CameraConfig::Emulated {} => Some(file.emulator.exposure_ms * 1e-3),
        CameraConfig::Industrial { exposure_us, .. } => exposure_us.map(|us| us * 1e-6),
        CameraConfig::Socket { .. } => None,
    }
}

/// The same; else as the camera reports it.
pub fn known_exposure_s(file: &RigFile, camera: &SourceInfo) -> Option<f64> {
    let reported_s = Some(camera.exposure_s).filter(|s| *s > 0.0);
    stated_exposure_s(file).or(reported_s)
}

/// Exposure of a frame, s, from rig file or camera, else from the model; 0 if none states it.
fn exposure_s(file: &RigFile, camera: &SourceInfo, model: &Model) -> f64 {
    let of_model = || {
        model.effects.iter().find_map(|effect| match effect.act() {
            Action::Exposure(exposure_s) => Some(exposure_s),
            _ => None,
        })
    };
    known_exposure_s(file, camera)
        .or_else(of_model)
        .unwrap_or(0.0)
}

/// Model and controller from their options, before a board is known.
pub fn prepare(model: &str, controller: &str, file: &RigFile) -> Result<Prepared, Failure> {
    let model = Model::load(model).map_err(Failure::input)?;
    let model = file.actuator.before(model);
    let controller = setup::controller(controller, &model, &file.timing, file.frame_s())?;
    Ok(Prepared { model, controller })
}

/// Diffusion of the bead, um^2/s, from the emulated rig or from the model.
pub(crate) fn diffusion_um2_per_s(file: &RigFile, model: &cellpos_plant::Model) -> f64 {
    if file.is_emulated() {
        file.emulator.diffusion_um2_per_s
    } else {
        model.noise.diffusion_um2_per_s
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rig_file::ActuatorConfig;

    #[test]
    fn a_run_begins_at_the_zero_flow_that_was_measured_last_on_this_rig() {
        const BOARD: &str = "PZT board on pzt, serial number 7, firmware 1.0.0";
        let mut file = RigFile {
            actuator: toml::from_str::<ActuatorConfig>("kind = \"serial\"\nport = \"pzt\"")
                .unwrap(),
            ..RigFile::default()
        };
        let mut model = Model {
            working_point_um: 20.117,
            ..Model::eq6()
        };
        let begins = |file: &RigFile, model: &Model| first_zero_flow_um(file, model, BOARD);
        // Nothing says that the model was measured here.
        assert_eq!(begins(&file, &model), 20.0);
        (model.provenance).insert(OF_BOARD.to_owned(), BOARD.to_owned());
        assert_eq!(begins(&file, &model), 20.117);
        let other = Model {
            provenance: [(OF_BOARD.to_owned(), "another board".to_owned())].into(),
            ..model.clone()
        };
        assert_eq!(begins(&file, &other), 20.0);
        // The PZT cannot stand there.
        file.limits.low_um = 20.2;
        assert_eq!(begins(&file, &model), 20.0);
        file.limits.low_um = 0.0;
        file.rested_um = Some(20.19);
        assert_eq!(begins(&file, &model), 20.19);
        // An emulated rig is another one in each run.
        model.working_point_um = 21.0;
        assert_eq!(begins(&RigFile::default(), &model), 20.0);
    }

    #[test]
    fn an_exposure_that_no_file_states_is_the_one_that_the_camera_reports() {
        let mut file: RigFile =
            toml::from_str("[camera]\nkind = \"socket\"\nsocket = \"c.sock\"").unwrap();
        let reporting = |exposure_s| SourceInfo {
            name: "camera".to_owned(),
            width_px: 64,
            height_px: 64,
            rate_hz: 1000.0,
            latency_ms: 2.0,
            exposure_s,
            field_um: [-3.0, 3.0],
        };
        let blurred = Model::eq6().with_effect(cellpos_plant::effects::exposure_averaging(2e-4));
        assert_eq!(exposure_s(&file, &reporting(5e-4), &blurred), 5e-4);
        assert_eq!(exposure_s(&file, &reporting(0.0), &blurred), 2e-4);
        assert_eq!(exposure_s(&file, &reporting(0.0), &Model::eq6()), 0.0);
        file.camera = CameraConfig::Emulated {};
        let stated_s = file.emulator.exposure_ms * 1e-3;
        assert_eq!(exposure_s(&file, &reporting(1e-4), &blurred), stated_s);
    }
}
