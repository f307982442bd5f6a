//! A loop and a camera of different rates, on the emulated rig and the virtual clock.

use crate::common::{Ran, hold, run};
use cellpos_control::Adaptation;
use cellpos_runtime::life::EventKind;
use cellpos_runtime::{Event, RunSink, Statistics, TickFlags, TickRecord};
use cellpos_session::RigFile;

/// What went by.
#[derive(Default)]
struct Kept {
    between: u64,
    coasting: u64,
    events: Vec<EventKind>,
}

impl RunSink for Kept {
    fn tick(&mut self, record: &TickRecord) {
        self.between += u64::from(record.flags.has(TickFlags::BETWEEN));
        self.coasting += u64::from(record.flags.has(TickFlags::COASTING));
    }
    fn event(&mut self, event: &Event) {
        self.events.push(event.kind);
    }
    fn progress(&mut self, _: &Statistics) {}
}

/// A rig with a loop of this period and a camera of this rate, its path 2 ms.
fn rig_file(period_us: f64, rate_hz: f64) -> RigFile {
    let mut file = RigFile::default();
    // What is counted here is exact arithmetic of two rates: clocks that stray make a tick without a frame now and then.
    file.emulator.ideal = true;
    file.timing.period_us = period_us;
    file.timing.budget_us = 0.5 * period_us;
    file.timing.solver_us = 0.17 * period_us;
    // The same times as at 1 kHz.
    file.timing.coast_ticks = (20e3 / period_us) as u32;
    file.timing.lost_ticks = (1e6 / period_us) as u32;
    file.emulator.rate_hz = rate_hz;
    file.emulator.exposure_ms = file.emulator.exposure_ms.min(0.5e3 / rate_hz);
    file
}

/// Seconds of hold with a law.
fn hold_for(file: RigFile, law: &str, seconds: f64) -> Ran<Kept> {
    let ticks = (seconds * 1e6 / file.timing.period_us) as u64;
    run(file, law, hold(), ticks)
}

/// In force is what is there, and so is what is stated; nothing is while chance is put to the test.
fn is_right(adaptation: &Adaptation) {
    assert!(adaptation.gain.ln().abs() < 0.12, "{adaptation:?}");
    if let Some([gain, sd]) = adaptation.gain_estimate {
        assert!((gain - 1.0).abs() < 3.0 * sd && sd < 0.15, "{adaptation:?}");
    }
}

#[test]
fn ticks_between_the_frames_of_a_slower_camera_are_no_loss_and_no_wrong_gain() {
    for (period_us, law) in [(500.0, "mpc"), (200.0, "lqg")] {
        let every = (1000.0 / period_us) as u64;
        let ran = hold_for(rig_file(period_us, 1000.0), law, 20.0);
        let (summary, kept, told) = (ran.summary, ran.sink, ran.ticks_per_fix);
        let counts = summary.counts;
        println!("{period_us} us: {summary:?}");
        assert_eq!(told, every as f64);
        assert_eq!(
            (counts.coasted, counts.frames_lost, kept.coasting),
            (0, 0, 0)
        );
        // Every frame but the first few came to a tick; all other ticks are between two.
        let expected = counts.ticks - counts.ticks / every;
        assert!(kept.between.abs_diff(expected) < 20, "{}", kept.between);
        let ordinary = |event: &EventKind| {
            matches!(
                event,
                EventKind::Armed
                    | EventKind::ArmingPassed { .. }
                    | EventKind::Running
                    | EventKind::Finished
                    | EventKind::BoardChanged { .. }
            )
        };
        assert!(kept.events.iter().all(ordinary), "{:?}", kept.events);
        let adaptation = summary.adaptation.expect("it adapts");
        is_right(&adaptation);
        let hold_nm = summary.rms_true_nm.expect("an emulated rig");
        assert!(hold_nm < 53.0, "{hold_nm} nm");
    }
}

#[test]
fn a_camera_faster_than_the_loop_costs_frames_and_nothing_else() {
    let ran = hold_for(rig_file(1000.0, 2000.0), "lqg", 20.0);
    let (summary, kept, told) = (ran.summary, ran.sink, ran.ticks_per_fix);
    println!("{summary:?}");
    let counts = summary.counts;
    assert_eq!(told, 1.0);
    assert_eq!(
        (counts.coasted, counts.frames_lost, kept.between),
        (0, 0, 0)
    );
    assert!(counts.superseded.abs_diff(counts.ticks) < 50);
    let adaptation = summary.adaptation.expect("it adapts");
    is_right(&adaptation);
    let hold_nm = summary.rms_true_nm.expect("an emulated rig");
    assert!(hold_nm < 56.0, "{hold_nm} nm");
}
