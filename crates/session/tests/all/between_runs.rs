//! What becomes of the bead where one run ends and the next begins, on the emulated rig and the virtual clock.

use crate::common::{hold, run};
use cellpos_emulator::EmulatedRig;
use cellpos_runtime::life::EventKind;
use cellpos_runtime::{Event, RunSink, Statistics, TickFlags, TickRecord};
use cellpos_session::RigFile;
use cellpos_session::setup::ReferenceSpec;
use std::time::Duration;

/// Gain of Eq. (6) below its pole-zero pair, 1/s.
const GAIN_PER_S: f64 = 428.0;

#[derive(Default)]
struct Kept {
    ticks: Vec<TickRecord>,
    events: Vec<EventKind>,
}

impl RunSink for Kept {
    fn tick(&mut self, record: &TickRecord) {
        self.ticks.push(*record);
    }
    fn event(&mut self, event: &Event) {
        self.events.push(event.kind);
    }
    fn progress(&mut self, _: &Statistics) {}
}

/// A run with PI: the world, which continues, and the recorded ticks.
fn pi_run(file: RigFile, reference: ReferenceSpec, ticks: u64) -> (EmulatedRig, Kept) {
    let ran = run(file, "pi", reference, ticks);
    (ran.emulated, ran.sink)
}

#[test]
fn a_bead_at_the_border_of_the_view_stays_in_view_while_arming_and_is_brought_to_the_middle() {
    for (start_um, seed) in [(11.6, 1), (-11.6, 1), (11.8, 2), (-11.8, 3)] {
        let mut file = RigFile::default();
        file.emulator.start_um = start_um;
        file.emulator.seed = seed;
        let (_, kept) = pi_run(file, hold(), 1500);
        let first = kept
            .ticks
            .iter()
            .position(|tick| tick.measured_um.is_finite());
        let seen = &kept.ticks[first.expect("the bead is in view")..];
        let lost = seen.iter().filter(|tick| tick.flags.has(TickFlags::LOST));
        assert_eq!(lost.count(), 0, "from {start_um} um");
        let passed = |event: &&EventKind| matches!(event, EventKind::ArmingPassed { .. });
        assert_eq!(kept.events.iter().filter(passed).count(), 1);
        let last = &seen[seen.len() - 200..];
        let farthest = last.iter().map(|tick| tick.true_um.abs());
        assert!(farthest.fold(0.0, f64::max) < 0.4, "from {start_um} um");
    }
}

#[test]
fn after_a_run_the_bead_goes_with_the_flow_that_park_leaves_and_not_otherwise() {
    let sine = ReferenceSpec::Sine {
        centre_um: 0.0,
        amplitude_um: 5.0,
        frequency_hz: 7.0,
        fade_s: 0.1,
    };
    // The second run ends in full motion.
    for (reference, ticks) in [(hold(), 2000), (sine, 2013)] {
        for park_um in [20.0, 19.99, 20.02] {
            let mut file = RigFile::default();
            file.limits.park_um = park_um;
            file.board.power_up_um = park_um;
            let drift_um_per_s = file.emulator.drift_um_per_s;
            let beside_um = park_um - file.emulator.neutral_um;
            let (emulated, kept) = pi_run(file, reference.clone(), ticks);
            let last_um = kept.ticks.last().expect("ticks").true_um;
            let at_um = |emulated: &EmulatedRig| emulated.now().world().bead_um();
            // Frozen at its place, within the motion during the delays of camera and command.
            emulated.clock().sleep(Duration::from_millis(50));
            let parked_um = at_um(&emulated);
            assert!(
                (parked_um - last_um).abs() < 2.0,
                "{last_um} um, parked {parked_um} um"
            );
            // From then on physics alone: K (park - neutral) and the drift, and diffusion of 0.8 um in a second.
            emulated.clock().sleep(Duration::from_secs(1));
            let went_um = at_um(&emulated) - parked_um;
            let expected_um = GAIN_PER_S * beside_um + drift_um_per_s;
            let off_um = went_um - expected_um;
            assert!(
                off_um.abs() < 2.5 + 0.1 * expected_um.abs(),
                "park {park_um} um: went {went_um} um, expected {expected_um} um"
            );
        }
    }
}
