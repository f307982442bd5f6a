//! A loop that keeps the clock's time: frames wait for their command while camera and clock drift apart.

use cellpos_numeric::Random;
use cellpos_plant::{Model, SimulateOptions, simulate};
use cellpos_reconcile::{Options, Reconciliation, Record, Verdict, reconcile};
use std::f64::consts::TAU;

const ROWS: usize = 16_000;
const STEPS_A_ROW: usize = 20;
const ROW_S: f64 = 1e-3;
const DELAY_S: f64 = 2.1e-3;
const EXPOSURE_S: f64 = 0.5e-3;

/// How long the frame of a row waits: a third of the record, as after a late frame.
fn wait_s(row: usize) -> f64 {
    match row {
        6000..12_000 => 2.5e-4,
        _ => 0.0,
    }
}

/// Eq. (6) on a grid of 50 us, with frames that average over their exposure, walk and localisation noise.
fn record(seed: u64) -> Record {
    let lines = [1.5, 4.5, 12.5, 33.5, 87.5, 197.5, 293.5];
    let pzt_um: Vec<f64> = (0..ROWS)
        .map(|k| {
            let at = k as f64 * ROW_S;
            let tone = |(i, hz): (usize, &f64)| (TAU * hz * at + (i * i) as f64).sin();
            4.0 + 0.1 * lines.iter().enumerate().map(tone).sum::<f64>()
        })
        .collect();
    let held: Vec<f64> = (pzt_um.iter())
        .flat_map(|u| std::iter::repeat_n(*u, STEPS_A_ROW))
        .collect();
    let step_s = ROW_S / STEPS_A_ROW as f64;
    let path = simulate(&Model::eq6(), &held, step_s, &SimulateOptions::default()).unwrap();
    let mut random = Random::new(seed);
    let mut walk = 0.0;
    let bead_um: Vec<f64> = (0..ROWS)
        .map(|k| {
            walk += (2.0 * 0.33 * ROW_S).sqrt() * random.normal();
            let middle_s = k as f64 * ROW_S - DELAY_S - wait_s(k);
            let first = ((middle_s - 0.5 * EXPOSURE_S) / step_s).round();
            let steps = (EXPOSURE_S / step_s) as usize;
            let at = |i: usize| path.get((first + i as f64).max(0.0) as usize);
            let seen = |i: usize| at(i).copied().unwrap_or(0.0);
            // By trapezoids.
            let sum: f64 = (0..steps).map(|i| 0.5 * (seen(i) + seen(i + 1))).sum();
            sum / steps as f64 + walk + 0.01 * random.normal()
        })
        .collect();
    let time_s: Vec<f64> = (0..ROWS).map(|k| k as f64 * ROW_S).collect();
    Record::from_rows("waits", &time_s, &pzt_um, &bead_um).unwrap()
}

/// The same with the ages and the exposure of its frames, as a loop knows them.
fn with_frames(record: &Record) -> Record {
    Record {
        frame_age_s: (0..ROWS).map(|k| 2e-3 + wait_s(k)).collect(),
        exposure_s: EXPOSURE_S,
        ..record.clone()
    }
}

fn delay(found: &Reconciliation) -> (f64, [f64; 2]) {
    let named = found.effects.iter().find(|e| e.id == "time-delay").unwrap();
    let p = &named.parameters["delay_s"];
    (p.value, p.ci95)
}

#[test]
fn a_delay_is_that_of_the_rig_whatever_its_frames_waited_and_a_second_pass_finds_nothing() {
    let at_most = |max_effects, model: &Model, record: Record| {
        let options = Options {
            max_effects,
            ..Options::default()
        };
        reconcile(model, &[record], &options, &mut |_| {}).unwrap()
    };
    let look =
        |model: &Model, record: Record| at_most(Options::default().max_effects, model, record);
    let record = record(5);
    let found = look(&Model::eq6(), with_frames(&record));
    let ids: Vec<&str> = found.effects.iter().map(|e| e.id.as_str()).collect();
    assert_eq!((found.verdict, ids), (Verdict::Named, vec!["time-delay"]));
    let (value, [low, high]) = delay(&found);
    // 2.6 standard deviations: one seed in a hundred.
    let edge = 0.65 * (high - low);
    assert!((value - DELAY_S).abs() < edge, "{value} {low} {high}");
    let again = look(&found.augmented, with_frames(&record));
    assert_eq!(
        again.verdict,
        Verdict::NothingMissing,
        "{:?}",
        again.effects
    );
    // Without ages and exposure this record has another delay. What else it may lack is not asked.
    let blind = delay(&at_most(1, &Model::eq6(), record)).0;
    assert!(blind > DELAY_S + 5e-5, "{blind}");
}
