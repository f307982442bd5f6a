//! Runs on an emulated rig, on the virtual clock.

use cellpos_emulator::EmulatedRig;
use cellpos_plant::Model;
use cellpos_rig::{Clock, PositionSource};
use cellpos_runtime::{EndRule, RunSink, Summary};
use cellpos_session::rig_file::{ClockKind, Frames};
use cellpos_session::setup::ReferenceSpec;
use cellpos_session::{EndKind, Ended, Options, Rig, RigFile};

/// What a run leaves.
pub(crate) struct Ran<S> {
    pub ended: Ended,
    /// The world continues.
    pub emulated: EmulatedRig,
    pub summary: Summary,
    pub sink: S,
    /// The rates that the loop expects.
    pub ticks_per_fix: f64,
}

/// A run of some ticks with a law designed on Eq. (6), to its orderly end. Positions come without pictures.
pub(crate) fn run<S: RunSink + Default + 'static>(
    file: RigFile,
    law: &str,
    reference: ReferenceSpec,
    ticks: u64,
) -> Ran<S> {
    let positions = |_: &RigFile, emulated: &EmulatedRig, _: &Clock| -> Box<dyn PositionSource> {
        Box::new(emulated.positions())
    };
    let ran = run_on(positions, file, Frames::Off, law, reference, ticks);
    assert_eq!(ran.ended.kind, EndKind::Done, "{}", ran.ended);
    ran
}

/// The same with a source of positions of the test's own, to whatever end.
pub(crate) fn run_on<S: RunSink + Default + 'static>(
    source: impl FnOnce(&RigFile, &EmulatedRig, &Clock) -> Box<dyn PositionSource>,
    file: RigFile,
    frames: Frames,
    law: &str,
    reference: ReferenceSpec,
    ticks: u64,
) -> Ran<S> {
    let clock = Clock::virtual_at(0);
    let model = Model::load("eq6").expect("built in");
    let emulated =
        EmulatedRig::new(file.board, &file.emulator, &model, clock.clone()).expect("a rig");
    let options = Options {
        clock: ClockKind::Virtual,
        frames,
        best_effort: true,
    };
    let board = Box::new(emulated.actuator().expect("it answers"));
    let source = source(&file, &emulated, &clock);
    let mut rig = Rig::with_devices(file, options, source, board, clock).expect("a session");
    let prepared = rig.prepare("eq6", law).expect("a law for Eq. (6)");
    let setup = rig.set_up(prepared, reference).expect("the PZT stands");
    let core = setup.core().expect("a loop");
    let ticks_per_fix = core.controller().settings().estimator.ticks_per_fix;
    let end = EndRule {
        ticks: Some(ticks),
        ..EndRule::default()
    };
    let armed = rig.arm(&setup, core, S::default(), end).ok();
    let finished = armed.expect("armed").start().and_then(|run| run.wait());
    let finished = finished.expect("a run");
    Ran {
        ended: finished.ended,
        emulated,
        summary: finished.summary,
        sink: finished.sink,
        ticks_per_fix,
    }
}

/// A bead held in the middle.
pub(crate) fn hold() -> ReferenceSpec {
    ReferenceSpec::Hold { position_um: 0.0 }
}
