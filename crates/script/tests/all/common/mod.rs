//! A script on the emulated rig, on the virtual clock, as far as its per-cycle table.

use cellpos_control::design::DesignPlant;
use cellpos_control::{ControllerFile, Pi};
use cellpos_emulator::BoardConfig;
use cellpos_emulator::EmulatedRig;
use cellpos_emulator::WorldConfig;
use cellpos_plant::Model;
use cellpos_rig::ArmRequest;
use cellpos_rig::{Actuator, Clock};
use cellpos_runtime::live::Operator;
use cellpos_runtime::{
    ArmingConfig, Core, EndRule, Event, RunSink, Statistics, Summary, TickRecord, Timing,
    virtual_run,
};
use cellpos_script::{CycleRow, CycleTable, Follower, Plan, Script};
use std::ops::Range;
use std::sync::Arc;

/// Gathers rows; `deaf` in a span of run time: the recorder waits for its disk.
pub(crate) struct Table {
    cycles: CycleTable,
    /// The rows so far.
    pub rows: Vec<CycleRow>,
    /// Records that came.
    pub records: u64,
    deaf: Range<u64>,
    clock: Clock,
}

impl RunSink for Table {
    fn tick(&mut self, record: &TickRecord) {
        self.records += 1;
        self.cycles.add(record);
        self.rows.extend(std::iter::from_fn(|| self.cycles.pop()));
    }

    fn event(&mut self, _: &Event) {}

    fn progress(&mut self, _: &Statistics) {}

    fn is_ready(&self) -> bool {
        !self
            .deaf
            .contains(&(self.clock.now_ns() as u64 / 1_000_000_000))
    }
}

/// Runs a script with a PI controller; `deaf_s`: seconds in which the recorder takes nothing.
#[allow(dead_code, reason = "not every test file has its scripts as text")]
pub(crate) fn run(
    text: &str,
    world: &WorldConfig,
    timing: Timing,
    deaf_s: Range<u64>,
) -> (Summary, Table) {
    run_script(
        &Script::parse(text, "t.toml").unwrap(),
        world,
        timing,
        deaf_s,
    )
}

/// As [`run`], with a script that was read already.
pub(crate) fn run_script(
    script: &Script,
    world: &WorldConfig,
    timing: Timing,
    deaf_s: Range<u64>,
) -> (Summary, Table) {
    let plan = Arc::new(Plan::new(script).unwrap());
    let clock = Clock::virtual_at(0);
    let model = Model::eq6();
    let rig = EmulatedRig::new(BoardConfig::default(), world, &model, clock.clone()).unwrap();
    let mut actuator = rig.actuator().unwrap();
    let armed = actuator
        .arm(&ArmRequest {
            session: 1,
            park_um: 20.0,
            limits: [0.0, 40.0, 20_000.0],
            watchdog_ms: None,
            hold_watchdog_ms: None,
        })
        .unwrap();
    let gains = Pi::new(0.46, 19.5);
    let mut file = ControllerFile::from_pi(gains, 2.5e-3);
    file.limits.slew_um_per_s = 20_000.0;
    let plant = DesignPlant::from_model(&model, Some(2.5e-3), 1e-3).unwrap();
    let core = Core::new(
        file.loop_config(&model).unwrap(),
        Follower::new(Arc::clone(&plan), 0.0, 2),
        timing,
        ArmingConfig::default(),
        &plant.plant,
        armed.applied_um,
        20.0,
    )
    .unwrap();
    let table = Table {
        cycles: CycleTable::new(plan, 1, 0, 2.0, 1000.0),
        rows: Vec::new(),
        records: 0,
        deaf: deaf_s,
        clock: clock.clone(),
    };
    let operator = Operator::default();
    let finished = virtual_run::run(
        core,
        &clock,
        &mut rig.positions(),
        &mut actuator,
        table,
        Statistics::default(),
        EndRule::default(),
        |_| operator.take(),
    )
    .unwrap();
    (finished.summary, finished.sink)
}
