//! A sine and little else: a record that was cut out of a longer one, and two effects that together look like one of another kind.

use cellpos_numeric::Random;
use cellpos_plant::{Effect, Model, SimulateOptions, Simulator, effects, simulate};
use cellpos_reconcile::{Options, Record, Verdict, reconcile};
use std::f64::consts::TAU;

const ROWS: usize = 10_000;
const ROW_S: f64 = 1e-3;
const DELAY_S: f64 = 2e-3;

/// Eq. (6) with effects, under a sine and the small commands by which a loop answers the noise.
fn record(effects: Vec<Effect>, seed: u64) -> (Vec<f64>, Vec<f64>) {
    let mut random = Random::new(seed);
    let pzt_um: Vec<f64> = (0..ROWS)
        .map(|k| 4.0 + 0.46 * (TAU * 10.0 * k as f64 * ROW_S).sin() + 0.005 * random.normal())
        .collect();
    let model = Model {
        effects,
        ..Model::eq6()
    };
    let path = simulate(&model, &pzt_um, ROW_S, &SimulateOptions::default()).unwrap();
    let mut walk = 0.0;
    let seen = |um: &f64| {
        walk += (2.0 * 0.33 * ROW_S).sqrt() * random.normal();
        um + walk + 0.001 * random.normal()
    };
    (pzt_um, path.iter().map(seen).collect())
}

#[test]
fn a_record_cut_out_of_a_motion_names_what_the_whole_one_does() {
    let (pzt_um, bead_um) = record(vec![effects::time_delay(DELAY_S)], 5);
    for from in [0, 25, 250, 1_033] {
        let time_s: Vec<f64> = (from..ROWS).map(|k| k as f64 * ROW_S).collect();
        let cut = Record::from_rows("cut", &time_s, &pzt_um[from..], &bead_um[from..]).unwrap();
        let r = reconcile(&Model::eq6(), &[cut], &Options::default(), &mut |_| {}).unwrap();
        let ids: Vec<&str> = r.effects.iter().map(|e| e.id.as_str()).collect();
        assert_eq!(ids, ["time-delay"], "from {from}: {:?}", r.verdict);
        assert_eq!(r.verdict, Verdict::Named, "from {from}");
        let delay_s = r.effects[0].parameters["delay_s"].value;
        assert!((delay_s - DELAY_S).abs() < 1e-4, "from {from}: {delay_s}");
    }
}

/// At one frequency a hysteresis takes from the gain and adds a lag, as a smaller gain and a delay do.
#[test]
fn a_smaller_gain_and_a_delay_are_no_hysteresis() {
    let hidden = vec![effects::gain_error(0.8), effects::time_delay(DELAY_S)];
    let (pzt_um, bead_um) = record(hidden, 3);
    let time_s: Vec<f64> = (0..ROWS).map(|k| k as f64 * ROW_S).collect();
    let whole = Record::from_rows("sine", &time_s, &pzt_um, &bead_um).unwrap();
    let r = reconcile(&Model::eq6(), &[whole], &Options::default(), &mut |_| {}).unwrap();
    let mut ids: Vec<&str> = r.effects.iter().map(|e| e.id.as_str()).collect();
    ids.sort_unstable();
    assert_eq!(ids, ["gain-error", "time-delay"], "{:?}", r.verdict);
}

/// Eq. (6) with effects in a loop: a controller answers the position of every row, and the bead shall follow a path.
fn looped(effects: Vec<Effect>, seed: u64, path_um: impl Fn(f64) -> f64) -> (Vec<f64>, Vec<f64>) {
    const PROPORTIONAL: f64 = 0.25;
    const INTEGRAL_PER_S: f64 = 2.0;
    let model = Model {
        effects,
        ..Model::eq6()
    };
    let mut rig = Simulator::new(&model, ROW_S, None).unwrap();
    let mut random = Random::new(seed);
    let (mut walk, mut integral) = (0.0, 0.0);
    (0..ROWS)
        .map(|k| {
            walk += (2.0 * 0.33 * ROW_S).sqrt() * random.normal();
            let bead_um = rig.measure() + walk + 0.0025 * random.normal();
            let error = path_um(k as f64 * ROW_S) - bead_um;
            integral += INTEGRAL_PER_S * error * ROW_S;
            let pzt_um = 4.0 + PROPORTIONAL * error + integral + 0.0005 * random.normal();
            rig.hold(pzt_um);
            (pzt_um, bead_um)
        })
        .unzip()
}

/// The ids that the rows of a record from one on get, in alphabetical order.
fn named((pzt_um, bead_um): &(Vec<f64>, Vec<f64>), from: usize) -> Vec<String> {
    let time_s: Vec<f64> = (from..ROWS).map(|k| k as f64 * ROW_S).collect();
    let cut = Record::from_rows("loop", &time_s, &pzt_um[from..], &bead_um[from..]).unwrap();
    let r = reconcile(&Model::eq6(), &[cut], &Options::default(), &mut |_| {}).unwrap();
    let mut ids: Vec<String> = r.effects.iter().map(|e| e.id.clone()).collect();
    ids.sort_unstable();
    ids
}

/// What a loop answers to the noise differs from period to period. A noise that is read from those differences needs the answers off.
#[test]
fn a_sine_in_a_loop_names_gain_and_delay_from_any_row_on() {
    let hidden = vec![effects::gain_error(0.8), effects::time_delay(DELAY_S)];
    let record = looped(hidden, 3, |t| 3.0 * (TAU * 10.0 * t).sin());
    for from in [1_487, 4_213] {
        assert_eq!(named(&record, from), ["gain-error", "time-delay"], "{from}");
    }
}

/// A bubble that dissolves is a compromise between a resonance and a delay, and neither of these explains anything beside it.
#[test]
fn two_effects_are_found_where_the_best_single_one_is_a_compromise() {
    let hidden = vec![
        effects::pzt_resonance(280.0, 0.05),
        effects::time_delay(DELAY_S),
    ];
    let record = looped(hidden, 4, |t| match t {
        t if t < 3.0 => (TAU * 20.0 * t).sin(),
        t if t < 6.5 => 3.0 * (TAU * 4.0 * (t - 3.0)).sin(),
        // A triangle of 2 Hz.
        t => (2.0 / std::f64::consts::PI) * (TAU * 2.0 * (t - 6.5)).sin().asin(),
    });
    assert_eq!(named(&record, 0), ["pzt-resonance", "time-delay"]);
}
