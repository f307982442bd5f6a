//! A loop for the nominal plant, and measurements for it.
#![allow(dead_code, reason = "each test file uses what it needs")]

use cellpos_control::{ControllerFile, ControllerKind, Lead, Pi, Profile, SolverKind};
use cellpos_plant::{Model, TransferFunction};
use cellpos_rig::{ActuatorFault, ActuatorState};
use cellpos_rig::{ActuatorReport, Measurement};
use cellpos_runtime::{ArmingConfig, Core, Timing};
use cellpos_vision::FixQuality;

/// Where the board stands at the start, um.
pub(crate) const START_UM: f64 = 20.0;

/// A controller.toml for the nominal plant.
pub(crate) fn controller(kind: ControllerKind) -> ControllerFile {
    let pi = Pi {
        lead: (kind == ControllerKind::Lead).then_some(Lead {
            zero_hz: 64.0,
            pole_hz: 255.0,
        }),
        ..Pi::new(0.46, 19.5)
    };
    let mut file = ControllerFile::from_pi(pi, 2.5e-3);
    file.controller = kind;
    file.mpc.solver = SolverKind::ActiveSet;
    file
}

/// The loop of a controller, held at 0 um. With `check` off it closes as soon as the bead is steadily seen.
pub(crate) fn core(file: &ControllerFile, check: bool) -> Core<Profile> {
    let model = Model::eq6();
    Core::new(
        file.loop_config(&model).unwrap(),
        Profile::Hold { position_um: 0.0 },
        Timing::default(),
        ArmingConfig {
            check,
            ..ArmingConfig::default()
        },
        &TransferFunction::eq6(),
        START_UM,
        START_UM,
    )
    .unwrap()
}

/// A good position in the frame that arrives at tick `k`, 2 ms after its exposure.
pub(crate) fn measurement(k: u64, position_um: f64) -> Measurement {
    let now_ns = k as i64 * 1_000_000;
    Measurement {
        frame_id: k + 1,
        mid_exposure_ns: now_ns - 2_000_000,
        ready_ns: now_ns,
        position_um,
        variance_um2: 4e-4,
        verdict: FixQuality::Good,
        track: None,
        length_um: f64::NAN,
        area_um2: f64::NAN,
        length_sd_um: f64::NAN,
        area_sd_um2: f64::NAN,
        snr: 40.0,
        true_um: f64::NAN,
        true_pzt_um: f64::NAN,
    }
}

/// What a board that follows says at tick `k`.
pub(crate) fn report(k: u64) -> ActuatorReport {
    ActuatorReport {
        state: ActuatorState::Running,
        fault: ActuatorFault::None,
        applied_um: START_UM,
        last_seq: u32::try_from(k).ok(),
        session: 1,
        last_time_us: k * 1000,
        device_time_us: k * 1000,
        bad_frames: 0,
        ignored: 0,
        holds: 0,
        read_ns: k as i64 * 1_000_000,
    }
}
