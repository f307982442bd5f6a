//! A day on the virtual clock: no count runs over, and the record replays to the bit.

use crate::common;
use crate::common::{controller, core};
use cellpos_control::ControllerKind;
use cellpos_emulator::{BoardConfig, EmulatedRig, WorldConfig};
use cellpos_plant::Model;
use cellpos_rig::{Actuator, ArmRequest, Clock};
use cellpos_runtime::replay::Replay;
use cellpos_runtime::{
    EndRule, EndState, Event, Request, RunSink, Statistics, TickRecord, virtual_run,
};

/// Replays each record as it comes.
struct Replaying {
    replay: Replay<cellpos_control::Profile>,
    last: Option<TickRecord>,
    gaps: u64,
}

impl RunSink for Replaying {
    fn tick(&mut self, record: &TickRecord) {
        self.replay.add(record);
        // Ticks start with the arrivals of frames, which jitter by less than half a period.
        let after = self.last.is_some_and(|last| {
            let step_ns = record.time_ns - last.time_ns;
            record.seq != last.seq + 1 || !(500_000..1_500_000).contains(&step_ns)
        });
        self.gaps += u64::from(after);
        self.last = Some(*record);
    }
    fn event(&mut self, _: &Event) {}
    fn progress(&mut self, _: &Statistics) {}
}

fn held(ticks: u64) {
    let clock = Clock::virtual_at(0);
    let world = WorldConfig {
        seed: 24,
        ..WorldConfig::ideal()
    };
    let rig =
        EmulatedRig::new(BoardConfig::default(), &world, &Model::eq6(), clock.clone()).unwrap();
    let mut board = rig.actuator().unwrap();
    let file = controller(ControllerKind::Pi);
    let limits = file.limits;
    let armed = board
        .arm(&ArmRequest {
            session: 1,
            park_um: limits.park_um,
            limits: [limits.low_um, limits.high_um, limits.slew_um_per_s],
            watchdog_ms: None,
            hold_watchdog_ms: None,
        })
        .unwrap();
    assert!(
        (armed.applied_um - common::START_UM).abs() < 0.01,
        "{armed:?}"
    );
    let sink = Replaying {
        replay: Replay::new(core(&file, false)),
        last: None,
        gaps: 0,
    };
    let end = EndRule {
        ticks: Some(ticks),
        ..EndRule::default()
    };
    let finished = virtual_run::run(
        core(&file, false),
        &clock,
        &mut rig.positions(),
        &mut board,
        sink,
        Statistics::default(),
        end,
        |_| Request::None,
    )
    .unwrap();
    let summary = &finished.summary;
    assert_eq!(summary.counts.ticks, ticks, "{summary:?}");
    assert_eq!(
        (summary.state, summary.safe_reason),
        (EndState::Running, None)
    );
    assert_eq!(
        (
            summary.counts.skipped,
            summary.counts.late,
            summary.records_lost
        ),
        (0, 0, 0)
    );
    assert!(
        // Ticks start with the arrivals of frames, which jitter, and the camera's clock is not the loop's.
        (summary.duration_s - ticks as f64 * 1e-3).abs() < 2e-3 + 20e-6 * summary.duration_s,
        "{summary:?}"
    );
    let sink = finished.sink;
    assert_eq!(sink.gaps, 0);
    assert_eq!(sink.last.map(|last| last.seq), Some(ticks - 1));
    let outcome = sink.replay.outcome();
    assert_eq!(outcome.first_mismatch, None);
    assert_eq!(outcome.identical, ticks);
    assert!(
        summary.rms_measured_nm.is_some_and(|nm| nm < 120.0),
        "{summary:?}"
    );
}

#[test]
fn half_a_minute_of_virtual_time_replays_to_the_bit() {
    held(30_000);
}

#[test]
#[ignore = "long: run with --release -- --include-ignored"]
fn a_day_of_virtual_time_replays_to_the_bit() {
    held(24 * 3600 * 1000);
}
