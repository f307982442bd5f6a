//! A sine and little else: a record that was cut out of a longer one, and two effects that together look like one of another kind.

use cellpos_numeric::Random;
use cellpos_plant::{Effect, Model, SimulateOptions, effects, simulate};
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
