//! The threads' rounds on clocks that bend. A scheduler runs them in any order, with stalls, bursts, early, late, lost, doubled and false
//! frames, slow vision, a slow disk and threads that die. The board is the firmware's own, and every step of its output is looked at.

use super::*;
use crate::arming::ArmingConfig;
use crate::core::Core;
use crate::life::{Event, Request};
use crate::recorder::{Recorder, RecorderReport, Unconfirmed};
use crate::reference::{ReferenceInput, ReferenceOutput, Stage};
use crate::replay::Replay;
use crate::run::{RunSink, close_session};
use crate::summary::Statistics;
use crate::tick_record::{TickFlags, TickRecord};
use crate::ticker::RingSizes;
use crate::timing::Timing;

use cellpos_control::{ControllerFile, Limits, Pi};
use cellpos_drivers::{BoardHost, Port};
use cellpos_emulator::{BoardConfig, RigInABox, WorldConfig};
use cellpos_plant::{Model, TransferFunction};
use cellpos_rig::{ArmRequest, CameraError, CommandAccount, SourceInfo};
use rtrb::RingBuffer;
use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard};

mod line;
mod misbehaving_line;
mod peers;
mod rig;
mod scheduler;
mod slow_vision;
mod stops;

use misbehaving_line::{LineFaults, MisbehavingLine};
use peers::*;
use rig::*;
use scheduler::*;

const MS: i64 = 1_000_000;

const SLEW_UM_PER_S: f64 = 600.0;

fn file() -> ControllerFile {
    let mut file = ControllerFile::from_pi(Pi::new(0.46, 19.5), 2.5e-3);
    file.limits = Limits {
        low_um: 2.0,
        high_um: 38.0,
        slew_um_per_s: SLEW_UM_PER_S,
        park_um: 2.0,
    };
    file
}

fn core<R: ReferenceGenerator>(reference: R, first_um: f64) -> Core<R> {
    Core::new(
        file().loop_config(&Model::eq6()).expect("a controller"),
        reference,
        Timing::default(),
        ArmingConfig {
            check: true,
            ..ArmingConfig::default()
        },
        &TransferFunction::eq6(),
        first_um,
        20.0,
    )
    .expect("a loop")
}

/// Asserts every rule that a run must keep in all conditions.
fn check(ran: &Ran, faults: &Faults) {
    let limits = file().limits;
    // The board's converter rounds to steps of 0.6 nm.
    let step_um = 40.0 / 65_535.0;
    for (_, um) in &ran.outputs {
        let range = limits.low_um.min(ran.stood_um) - step_um..=limits.high_um + step_um;
        assert!(range.contains(um), "{um} um");
    }
    for window in [1, 2, 5, 10, 50, 200] {
        for (from, to) in ran.outputs.iter().zip(ran.outputs.iter().skip(window)) {
            // The board's clock counts microseconds.
            let apart_s = (to.0 - from.0 + 1000) as f64 * 1e-9;
            let most_um = SLEW_UM_PER_S * apart_s + step_um * 1.001;
            assert!(
                (to.1 - from.1).abs() <= most_um,
                "{from:?} -> {to:?} in {window} steps"
            );
        }
    }
    assert!(
        (ran.applied_um - limits.park_um).abs() < 2.0 * step_um,
        "parked at {} um",
        ran.applied_um
    );
    let Some(end) = &ran.end else {
        assert_eq!(faults.dies.map(|(thread, _)| thread), Some(Thread::Control));
        return;
    };
    let kept = ran.records.len() as u64 + ran.report.records_unkept + end.account.records_lost;
    assert_eq!(
        kept,
        end.counts.ticks.wrapping_sub(faults.first.0),
        "every tick is recorded or counted as lost"
    );
    if let Some((from_ns, until_ns)) = faults.hangs
        && until_ns - from_ns < 800 * MS
    {
        assert_ne!(ran.fault, Some(RecorderFault::Stuck));
    }
    if faults
        .unconfirmed
        .is_none_or(|(from_ns, until_ns)| until_ns - from_ns < 4990 * MS)
    {
        assert_ne!(ran.fault, Some(RecorderFault::Unconfirmed));
    }
    // The board of these runs obeys, unless it is deaf.
    let blamed = [
        SafeReason::BoardForeign,
        SafeReason::BoardNotObeying,
        SafeReason::BoardNotFollowing,
    ];
    assert!(
        faults.deaf.is_some()
            || end
                .safe_reason
                .is_none_or(|reason| !blamed.contains(&reason))
    );
    assert_eq!(end.life == Life::Safe, end.safe_reason.is_some());
    assert!(end.end != End::Duration || end.safe_reason.is_none());
    if end.safe_reason != Some(SafeReason::Stalled) {
        check_plan(&ran.records);
    }
}

/// At every tick the plan is where the clock is, whatever the frames did: within the reach of two ticks.
fn check_plan(records: &[TickRecord]) {
    let closed = records.iter().find(|r| r.is_running());
    let Some(closed) = closed else { return };
    for record in records.iter().filter(|r| r.is_running()) {
        let clock_ns = record.time_ns - closed.time_ns;
        assert!(
            (record.plan_ns - closed.plan_ns - clock_ns).abs() <= 3 * MS / 2,
            "plan {} ns, clock {clock_ns} ns",
            record.plan_ns
        );
    }
}

fn replays(ran: &Ran) {
    let reference = Counting {
        steps: 0,
        clock: Clock::virtual_at(0),
        dice: Dice::new(0),
        slow_tick: 0.0,
        slow_tick_ns: 0,
    };
    let first = ran.records.first().map_or(0, |record| record.seq);
    let mut replay = Replay::new(core(reference, ran.stood_um).counted_from(first));
    for record in &ran.records {
        replay.add(record);
    }
    let outcome = replay.outcome();
    assert_eq!(outcome.first_mismatch, None);
    assert_eq!(outcome.identical, ran.records.len() as u64);
}

#[test]
fn plan_and_clock_agree_within_a_thousandth_whatever_the_frames_do() {
    let doubled = Faults {
        doubled: 1.0,
        ..Faults::default()
    };
    let jitter = Faults {
        jitter_ns: (MS / 2, 2 * MS),
        calm_ns: 500 * MS,
        ..Faults::default()
    };
    let lost = Faults {
        lost: 0.05,
        ..Faults::default()
    };
    let rate = |camera_hz| Faults {
        camera_hz,
        ..Faults::default()
    };
    let cases = [doubled, jitter, lost]
        .into_iter()
        .chain([500.0, 990.0, 1010.0, 2000.0].map(rate));
    for (seed, faults) in (1..).zip(cases) {
        let ran = run(seed, 6000, &faults, &[]);
        check(&ran, &faults);
        let end = ran.end.as_ref().expect("control lives");
        assert_eq!(
            (end.end, end.safe_reason),
            (End::Duration, None),
            "{faults:?}"
        );
        let closed = |r: &&TickRecord| r.is_running();
        let first = ran.records.iter().find(closed).expect("closed");
        let last = ran.records.last().expect("records");
        let clock_s = (last.time_ns - first.time_ns) as f64;
        let plan_s = (last.plan_ns - first.plan_ns) as f64;
        assert!((plan_s / clock_s - 1.0).abs() < 1e-3, "{faults:?}");
        assert!(clock_s > 5.5e9, "{faults:?}");
        replays(&ran);
    }
}

#[test]
fn frames_lost_are_counted_once_though_others_are_old() {
    let faults = Faults {
        lost: 0.05,
        stale: 0.1,
        ..Faults::default()
    };
    let ran = run(3, 6000, &faults, &[]);
    let end = ran.end.expect("control lives");
    let lost = end.counts.frames_lost as f64;
    assert!((lost / 6000.0 - 0.05).abs() < 0.01, "{lost}");
    // A display that counts up to the last tick has the summary's numbers.
    let counted = ran.records.last().expect("records").counts;
    assert_eq!(counted.frames_lost, end.counts.frames_lost);
    assert_eq!(counted.skipped, end.counts.skipped);
    assert_eq!(counted.stale, end.counts.stale);
    assert!(counted.stale > 100, "{counted:?}");
}

#[test]
fn frames_from_the_future_are_not_used_and_end_the_run_when_there_are_no_others() {
    let faults = Faults {
        future: 1.0,
        ..Faults::default()
    };
    let ran = run(3, 6000, &faults, &[]);
    check(&ran, &faults);
    let end = ran.end.expect("control lives");
    assert_eq!(end.safe_reason, Some(SafeReason::StaleFrames));
    assert!(end.counts.future >= 5);
}

#[test]
fn each_thread_that_dies_ends_the_run_by_its_name() {
    for thread in [
        Thread::Camera,
        Thread::Control,
        Thread::Line,
        Thread::Recorder,
    ] {
        let faults = Faults {
            dies: Some((thread, 500 * MS)),
            ..Faults::default()
        };
        let ran = run(11, 20_000, &faults, &[]);
        check(&ran, &faults);
        let reason = ran.end.as_ref().map(|end| end.safe_reason);
        let expected = match thread {
            Thread::Camera => Some(Some(SafeReason::CameraLost)),
            Thread::Control => None,
            Thread::Line => Some(Some(SafeReason::LinkLost)),
            Thread::Recorder => Some(Some(SafeReason::Unrecorded)),
        };
        assert_eq!(reason, expected, "{thread:?}");
        assert_eq!(ran.io_error.is_some(), thread == Thread::Line, "{thread:?}");
    }
}

#[test]
fn numbers_that_run_past_their_ends_disturb_nothing_and_replay_to_the_bit() {
    // Ticks past 32 and 64 bits, commands past the 32 bits of the wire, frames past 32 bits.
    let frames = u64::from(u32::MAX) - 1500;
    for seq in [u64::from(u32::MAX) - 1500, u64::MAX - 1500] {
        let faults = Faults {
            first: (seq, frames, u32::MAX - 1500),
            lost: 0.01,
            doubled: 0.1,
            ..Faults::default()
        };
        let ran = run(17, 4000, &faults, &[]);
        check(&ran, &faults);
        let end = ran.end.as_ref().expect("control lives");
        assert_eq!((end.end, end.safe_reason), (End::Duration, None));
        let (first, last) = (ran.records.first(), ran.records.last());
        let passed = last.map(|r| r.seq.wrapping_sub(first.map_or(0, |r| r.seq)));
        assert_eq!(passed, Some(ran.records.len() as u64 - 1));
        assert!(ran.records.len() > 3900 && end.counts.frames_lost < 100);
        replays(&ran);
    }
}

#[test]
fn a_recorder_that_does_not_come_back_from_a_write_is_noticed_within_a_second() {
    use crate::life::EventKind;
    for (hangs_ms, noticed) in [(700, false), (1500, true), (20_000, true)] {
        let faults = Faults {
            hangs: Some((2000 * MS, (2000 + hangs_ms) * MS)),
            ..Faults::default()
        };
        let ran = run(13, 6000, &faults, &[]);
        check(&ran, &faults);
        let end = ran.end.as_ref().expect("control lives");
        let reason = noticed.then_some(SafeReason::Unrecorded);
        assert_eq!(end.safe_reason, reason, "{hangs_ms} ms");
        let frozen_ms = ran.events.iter().find_map(|event| {
            let frozen = matches!(event.kind, EventKind::FreezeStarted { .. });
            frozen.then_some(event.time_ns / MS - 2000)
        });
        let in_time = frozen_ms.is_some_and(|ms| (800..1000).contains(&ms));
        assert_eq!(in_time, noticed, "{hangs_ms} ms: {frozen_ms:?}");
        assert_eq!(end.account.records_lost, 0, "{hangs_ms} ms");
    }
}

#[test]
fn a_disk_that_confirms_nothing_is_told_within_a_second_and_ends_the_run_after_five() {
    use crate::life::EventKind;
    for (lasts_ms, told, ends) in [
        (500, false, false),
        (3000, true, false),
        (20_000, true, true),
    ] {
        let faults = Faults {
            unconfirmed: Some((2000 * MS, (2000 + lasts_ms) * MS)),
            ..Faults::default()
        };
        let ran = run(19, 20_000, &faults, &[]);
        check(&ran, &faults);
        let ms_of = |is: fn(&EventKind) -> bool| {
            let event = ran.events.iter().find(|event| is(&event.kind));
            event.map(|event| event.time_ns / MS - 2000)
        };
        let slow_ms = ms_of(|kind| matches!(kind, EventKind::DiskSlowStarted { .. }));
        assert_eq!(
            slow_ms.is_some_and(|ms| (850..1000).contains(&ms)),
            told,
            "{lasts_ms} ms: {slow_ms:?}"
        );
        let well_ms = ms_of(|kind| matches!(kind, EventKind::DiskSlowEnded { .. }));
        assert_eq!(well_ms.is_some(), told && !ends, "{lasts_ms} ms");
        let frozen_ms = ms_of(|kind| matches!(kind, EventKind::FreezeStarted { .. }));
        assert_eq!(
            frozen_ms.is_some_and(|ms| (4990..5030).contains(&ms)),
            ends,
            "{lasts_ms} ms: {frozen_ms:?}"
        );
        // Frozen once, and until the PZT parks: the bead is in view all the time.
        let unrecorded = |event: &&Event| {
            let reason = crate::life::FreezeReason::Unrecorded;
            event.kind == EventKind::FreezeStarted { reason }
        };
        let freezes = ran.events.iter().filter(unrecorded).count();
        assert_eq!(freezes, usize::from(ends), "{lasts_ms} ms");
        let frozen = ran
            .records
            .iter()
            .filter(|r| r.flags.has(TickFlags::FREEZE));
        assert_eq!(frozen.count() > 290, ends, "{lasts_ms} ms");
        let end = ran.end.as_ref().expect("control lives");
        let reason = ends.then_some(SafeReason::Unrecorded);
        assert_eq!(end.safe_reason, reason, "{lasts_ms} ms");
        let fault = ends.then_some(RecorderFault::Unconfirmed);
        assert_eq!(ran.fault, fault, "{lasts_ms} ms");
        let longest_ms = ran.report.unconfirmed_ms;
        assert!(longest_ms >= lasts_ms.min(5000).unsigned_abs() - 10 && longest_ms <= 5600);
    }
}

#[test]
fn a_board_that_hears_no_command_any_more_is_named_and_parks_by_itself() {
    let faults = Faults {
        deaf: Some(2000 * MS),
        ..Faults::default()
    };
    let ran = run(23, 6000, &faults, &[]);
    check(&ran, &faults);
    let end = ran.end.as_ref().expect("control lives");
    assert_eq!(end.safe_reason, Some(SafeReason::BoardNotObeying));
}

#[test]
fn frames_that_come_early_or_in_a_burst_do_not_end_the_run() {
    for faults in [
        Faults {
            early: 0.5,
            ..Faults::default()
        },
        Faults {
            burst: Some((2000 * MS, 2200 * MS)),
            ..Faults::default()
        },
    ] {
        let ran = run(29, 5000, &faults, &[]);
        check(&ran, &faults);
        let end = ran.end.as_ref().expect("control lives");
        assert_eq!(
            (end.end, end.safe_reason),
            (End::Duration, None),
            "{faults:?}"
        );
        replays(&ran);
    }
}

#[test]
fn a_program_that_stood_still_as_a_whole_does_not_blame_its_recorder() {
    let (pulse, mut watch) = (Pulse::default(), PulseWatch::default());
    let mut now_ns = 0;
    for late_ms in [1, 1, 3000, 1, 800, 1, 1] {
        now_ns += late_ms * MS;
        assert!(!watch.stuck(&pulse, now_ns));
    }
    let stuck = (0..2000).position(|_| {
        now_ns += MS;
        watch.stuck(&pulse, now_ns)
    });
    assert!(
        stuck.is_some_and(|ms| (800..901).contains(&ms)),
        "{stuck:?}"
    );
}

#[test]
fn freeze_and_park_take_the_clocks_time_with_doubled_frames() {
    let faults = Faults {
        doubled: 1.0,
        ..Faults::default()
    };
    let ran = run(2, 20_000, &faults, &[(2000 * MS, Request::Freeze)]);
    check(&ran, &faults);
    assert_eq!(ran.end.as_ref().map(|end| end.end), Some(End::Operator));
    let frozen = |r: &&TickRecord| r.flags.has(TickFlags::FREEZE);
    let first = ran.records.iter().find(frozen).expect("frozen");
    let last = ran.records.last().expect("records");
    let frozen_ms = (last.time_ns - first.time_ns) / MS;
    assert!((frozen_ms - 500).abs() <= 2, "{frozen_ms} ms");
}

fn any_orders(seeds: std::ops::Range<u64>) {
    let periods = 1500;
    for seed in seeds {
        let mut dice = Dice::new(seed ^ 0x5EED);
        let faults = Faults::any(&mut dice, periods as i64 * MS);
        let asks: Vec<_> = (0..dice.next() % 3)
            .map(|_| {
                let asked = [
                    Request::Freeze,
                    Request::Pause,
                    Request::None,
                    Request::Park,
                ];
                let at_ns = dice.within(0, periods as i64 * MS);
                (at_ns, asked[(dice.next() % 4) as usize])
            })
            .collect();
        let outcome = std::panic::catch_unwind(|| {
            let ran = run(seed, periods, &faults, &asks);
            check(&ran, &faults);
            if ran.report.records_unkept == 0
                && ran
                    .end
                    .as_ref()
                    .is_some_and(|e| e.account.records_lost == 0)
            {
                replays(&ran);
            }
        });
        assert!(outcome.is_ok(), "seed {seed}: {faults:?}, {asks:?}");
    }
}

#[test]
fn sixty_random_orders_of_faults_break_nothing() {
    any_orders(0..60);
}

#[test]
#[ignore = "five minutes: cargo test -p cellpos-runtime --lib five_thousand -- --ignored"]
fn five_thousand_random_orders_of_faults_break_nothing() {
    any_orders(60..5060);
}
