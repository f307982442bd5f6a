//! The threads of a live run: what they leave behind in the program that made them.

use crate::common::{controller, core};
use cellpos_control::ControllerKind;
use cellpos_emulator::{BoardConfig, EmulatedRig, WorldConfig};
use cellpos_plant::Model;
use cellpos_rig::{Actuator, ArmRequest, Clock};
use cellpos_runtime::live::{self, Operator, Threads};
use cellpos_runtime::run::Finished;
use cellpos_runtime::{EndRule, Event, NoSink, RunError, RunSink, Statistics, TickRecord};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

/// A short run with a sink.
fn run<S: RunSink + 'static>(
    sink: S,
    threads: &Threads,
    operator: &Arc<Operator>,
) -> Result<Finished<S>, RunError> {
    let world = WorldConfig::default();
    let rig = EmulatedRig::new(BoardConfig::default(), &world, &Model::eq6(), Clock::Real).unwrap();
    let mut board = rig.actuator().unwrap();
    let file = controller(ControllerKind::Pi);
    let limits = file.limits;
    board
        .arm(&ArmRequest {
            session: 1,
            park_um: limits.park_um,
            limits: [limits.low_um, limits.high_um, limits.slew_um_per_s],
            watchdog_ms: None,
            hold_watchdog_ms: None,
        })
        .unwrap();
    let end = EndRule {
        ticks: Some(300),
        ..EndRule::default()
    };
    live::run(
        core(&file, false),
        &mut rig.positions(),
        &mut board,
        sink,
        Statistics::default(),
        end,
        threads,
        operator,
    )
}

/// Scheduling policy of the calling thread by number: 0 ordinary, 1 FIFO.
fn policy() -> Option<u32> {
    let stat = std::fs::read_to_string("/proc/thread-self/stat").ok()?;
    // Fields are counted from behind the name, which may hold anything; the 41st is the policy.
    let rest = stat.rsplit_once(')')?.1;
    rest.split_whitespace().nth(38)?.parse().ok()
}

#[test]
fn whoever_calls_for_a_run_keeps_the_rights_that_it_had() {
    let before = policy();
    let finished = run(NoSink, &Threads::real_time(), &Arc::default()).unwrap();
    if finished.conditions.policy != "SCHED_FIFO" {
        println!("not tested: this machine grants no SCHED_FIFO");
        return;
    }
    assert_eq!(policy(), before);
}

/// A sink that stands in its hundredth record for as long as the test wants.
struct Stands {
    records: u64,
    until: Receiver<()>,
}

impl RunSink for Stands {
    fn tick(&mut self, _: &TickRecord) {
        self.records += 1;
        if self.records == 100 {
            let _ = self.until.recv();
        }
    }
    fn event(&mut self, _: &Event) {}
    fn progress(&mut self, _: &Statistics) {}
}

#[test]
fn a_sink_that_never_comes_back_is_left_behind_and_its_rows_are_counted() {
    let (release, until) = channel();
    let operator = Arc::new(Operator::default());
    let began = Instant::now();
    let sink = Stands { records: 0, until };
    let ended = run(sink, &Threads::best_effort(), &operator);
    match ended.map(|_| ()) {
        Err(RunError::RecorderHangs { ticks, unkept, .. }) => {
            // A round of the recorder was whole before the one that hangs; at most a hundred rows were handed over.
            assert!(ticks >= 100 && unkept >= ticks - 100, "{unkept} of {ticks}");
        }
        other => panic!("{other:?}"),
    }
    // A bound, not a latency: without one it would never come here.
    assert!(began.elapsed() < Duration::from_secs(60));
    drop(release);
}
