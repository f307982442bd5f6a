//! An experiment in which the bead is lost for a while, on the emulated rig and the virtual clock.

use cellpos_emulator::{FaultEvent, FaultKind};
use cellpos_ident::excitation::{Signal, Tone};
use cellpos_ident::experiment::{Plan, PlannedSegment, Turn};
use cellpos_plant::Model;
use cellpos_session::RigFile;
use cellpos_session::rig_file::Frames;
use cellpos_workbench::experiment::collect::run_experiment;
use cellpos_workbench::experiment::excitation::Experiment;
use cellpos_workbench::experiment::on_rig::{Listener, OnRig, Trouble};

/// Ticks at rest before the first segment.
const REST: usize = 500;

fn plan() -> Plan {
    let tone = Tone {
        frequency_hz: 60.0,
        amplitude_um: 0.5,
        phase_rad: 0.0,
    };
    let segment = PlannedSegment {
        label: "60 Hz".to_string(),
        signal: Signal::Tones {
            tones: vec![tone],
            fade_in_s: 0.1,
        },
        lines_hz: vec![60.0],
        detection_hz: Vec::new(),
        settle_s: 0.2,
        measure_s: 2.0,
    };
    Plan {
        period_s: 1e-3,
        segments: vec![segment.clone(), segment],
        lost_frames: 50,
    }
}

fn rms(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = values.fold((0.0, 0.0_f64), |(sum, count), x| (sum + x * x, count + 1.0));
    (sum / count).sqrt()
}

#[test]
fn a_bead_found_again_is_caught_at_rest_and_the_next_segment_and_the_end_find_it_in_the_middle() {
    let mut file = RigFile::default();
    file.emulator.faults.event.push(FaultEvent {
        kind: FaultKind::LoseBead,
        at_s: 1.5,
        for_s: Some(0.2),
    });
    let neutral_um = file.emulator.neutral_um;
    let rig = OnRig::new(file, Model::eq6(), None, Frames::Off, true).expect("an emulated rig");
    let plan = plan();
    let spans = plan.schedule(&[0, 1].map(Turn::planned)).spans;
    let mut listener = Listener {
        progress: &mut |_| {},
        segment: &mut |_| {},
    };
    let acquired = rig
        .acquire(&plan, &[0, 1].map(Turn::planned), &mut listener)
        .expect("a run");
    let indices: Vec<usize> = acquired.records.iter().map(|record| record.index).collect();
    assert_eq!(indices, [1], "the first is spoilt, the second is whole");
    assert_eq!(acquired.out_of_view, [0]);
    let told = acquired.trouble.as_ref().map(ToString::to_string);
    let told = told.unwrap_or_default();
    let begins = "1 of 2 segments were spoilt; segment 1 (60 Hz): the loop was frozen after 0.";
    assert!(told.starts_with(begins), "{told}");
    assert!(matches!(acquired.trouble, Some(Trouble::Spoilt { .. })));
    let (command_um, bead_um) = (&acquired.rows.pzt_um, &acquired.rows.bead_um);
    let moved = |from: usize, to: usize| rms(command_um[from..to].iter().map(|um| um - neutral_um));
    let first = REST + spans[0].start;
    assert!(
        moved(first + 300, first + 700) > 0.2,
        "it was excited before"
    );
    // Lost at about 1.4 s and found 0.2 s later; the rest of the segment is at rest, with the noise of the loop.
    let (again, next) = (1800, REST + spans[1].start);
    assert!(next > again + 500);
    let rest_um = moved(again, next);
    assert!(rest_um < 0.1, "{rest_um} um of command at rest");
    let held_um = rms(bead_um[next - 100..next].iter().copied());
    assert!(held_um < 0.2, "{held_um} um before the next segment");
    assert!(moved(next + 300, next + 700) > 0.2, "and is excited again");
    // The last rows are at rest, so that the bead is frozen where it was held.
    let end = bead_um.len();
    let rest_um = moved(end - 200, end);
    assert!(rest_um < 0.1, "{rest_um} um of command at the end");
    let held_um = rms(bead_um[end - 200..].iter().copied());
    assert!(held_um < 0.2, "{held_um} um at the end");
}

/// An experiment in which every run ends early, after a fault for longer than the loop waits.
fn an_experiment_goes_on_after(kind: FaultKind) {
    let mut file = RigFile::default();
    // Each run begins the emulated time anew.
    file.emulator.faults.event.push(FaultEvent {
        kind,
        at_s: 8.0,
        for_s: Some(9.0),
    });
    let rig = OnRig::new(file, Model::eq6(), None, Frames::Off, true).expect("an emulated rig");
    let folder = tempfile::tempdir().expect("a folder");
    let first = folder.path().join("amplitudes-1.csv");
    let ran = run_experiment(&rig, Experiment::Amplitudes, 0.25, 1, &first, &mut |_| {});
    let ran = ran.unwrap_or_else(|failure| panic!("{}", failure.text()));
    let names: Vec<_> = (ran.records.iter())
        .map(|(file, _)| file.file_name().expect("a name").to_string_lossy())
        .collect();
    assert!(names.len() > 1, "{names:?}");
    for (n, name) in names.iter().enumerate() {
        assert_eq!(name.as_ref(), format!("amplitudes-{}.csv", n + 1));
    }
    for (file, record) in &ran.records {
        assert!(file.is_file() && record.frames() > 1000, "{record:?}");
    }
}

#[test]
fn an_experiment_goes_on_with_the_next_bead_and_keeps_a_record_of_each() {
    an_experiment_goes_on_after(FaultKind::LoseBead);
}

#[test]
fn an_experiment_goes_on_when_the_camera_delivers_again() {
    an_experiment_goes_on_after(FaultKind::DropFrames);
}
