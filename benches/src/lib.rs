//! Benchmarks with conditions and competitors: shared code.
#![forbid(unsafe_code)]

pub mod adaptation;
pub mod live_page;
pub mod parallel;
pub mod problems;
pub mod simulated;

use cellpos_control::{ControllerFile, ControllerKind, Pi, Profile};
use cellpos_drivers::{CommandedFlow, FlowTap, VisionSource};
use cellpos_emulator::BoardConfig;
use cellpos_emulator::EmulatedRig;
use cellpos_emulator::WorldConfig;
use cellpos_plant::{Hertz, Model, TransferFunction};
use cellpos_rig::{Clock, PositionSource};
use cellpos_runtime::live::{self, Operator, Threads};
use cellpos_runtime::realtime::Conditions;
use cellpos_runtime::{
    ArmingConfig, Core, EndRule, NoSink, Statistics, Summary, Timing, virtual_run,
};
use cellpos_vision::{Localiser, LocaliserConfig, ProfileSpec, Tracker, TrackerConfig};
use std::sync::Arc;

/// A run on the emulated rig, held at 0 um with PI, as `cellpos track --target 0um` does it.
///
/// # Panics
/// The default rig does not run: a defect.
pub fn track(clock: Clock, frames: bool, ticks: u64) -> (Summary, Conditions) {
    let world = WorldConfig::default();
    let model = Model::eq6();
    let rig = EmulatedRig::new(BoardConfig::default(), &world, &model, clock.clone())
        .expect("the default rig runs");
    let flow = CommandedFlow::new(model.plant.velocity_gain_at(Hertz(20.0)));
    let board = rig.actuator().expect("the board answers");
    let mut actuator = FlowTap::new(board, flow.clone(), clock.clone());
    let mut source: Box<dyn PositionSource> = if frames {
        let profile = ProfileSpec::Ring {
            edge_px: world.bead_radius_px(),
        };
        let localiser = Localiser::new(LocaliserConfig::new(profile)).expect("a sound profile");
        let tracking = TrackerConfig::for_pixel_um(world.pixel_um);
        let tracker = Tracker::new(localiser, tracking).expect("sound settings");
        let source = VisionSource::new(rig.camera(), tracker, rig.calibration(), clock.clone());
        Box::new(source.with_flow(flow))
    } else {
        Box::new(rig.positions())
    };
    let mut file = ControllerFile::from_pi(Pi::new(0.46, 19.5), 2.5e-3);
    file.controller = ControllerKind::Pi;
    let armed = cellpos_rig::Actuator::arm(
        &mut actuator,
        &cellpos_rig::ArmRequest {
            session: 1,
            park_um: 20.0,
            limits: [
                file.limits.low_um,
                file.limits.high_um,
                file.limits.slew_um_per_s,
            ],
            watchdog_ms: None,
            hold_watchdog_ms: None,
        },
    )
    .expect("the board arms");
    let core = Core::new(
        file.loop_config(&model).expect("the controller fits"),
        Profile::Hold { position_um: 0.0 },
        Timing::default(),
        ArmingConfig::default(),
        &TransferFunction::eq6(),
        armed.applied_um,
        world.neutral_um,
    )
    .expect("the loop can be built");
    let end = EndRule {
        ticks: Some(ticks),
        ..EndRule::default()
    };
    let finished = if clock.is_virtual() {
        virtual_run::run(
            core,
            &clock,
            source.as_mut(),
            &mut actuator,
            NoSink,
            Statistics::default(),
            end,
            |_| cellpos_runtime::Request::None,
        )
    } else {
        live::run(
            core,
            source.as_mut(),
            &mut actuator,
            NoSink,
            Statistics::default(),
            end,
            &Threads::real_time(),
            &Arc::new(Operator::default()),
        )
    }
    .expect("the run is carried through");
    (finished.summary, finished.conditions)
}
