//! Sensors whose noise is slow and returns: neither a walk, that would swallow slow errors, nor an error of the model.

use cellpos_numeric::Random;
use cellpos_plant::{Model, Noise, SimulateOptions, TransferFunction, effects, simulate};
use cellpos_reconcile::{NoiseKind, Options, Reconciliation, Record, Verdict, reconcile};

const ROWS: usize = 6000;
/// Correlation time \[rows\] and sizes of the slow and the white noise \[um RMS\].
const SLOW_ROWS: f64 = 60.0;
const SLOW_UM: f64 = 0.04;
const WHITE_UM: f64 = 0.02;

/// A lag of 20 ms about zero, sampled at 1 kHz, that states no noise.
fn plant() -> Model {
    Model {
        name: "lag".to_owned(),
        plant: TransferFunction::new(vec![1.0], vec![0.02, 1.0]).unwrap(),
        working_point_um: 0.0,
        noise: Noise::NONE,
        ..Model::eq6()
    }
}

/// The model's answer to held random levels of a size, with slow and white noise.
fn record(name: &str, model: &Model, size: f64, seed: u64) -> Record {
    let mut random = Random::new(seed);
    let mut u = Vec::with_capacity(ROWS);
    while u.len() < ROWS {
        let level = size * random.normal();
        u.extend(std::iter::repeat_n(level, 20));
    }
    let keep = (-1.0 / SLOW_ROWS).exp();
    let mut slow = SLOW_UM * random.normal();
    let y: Vec<f64> = simulate(model, &u, 1e-3, &SimulateOptions::default())
        .unwrap()
        .iter()
        .map(|y| {
            slow = keep * slow + SLOW_UM * (1.0 - keep * keep).sqrt() * random.normal();
            y + slow + WHITE_UM * random.normal()
        })
        .collect();
    let t: Vec<f64> = (0..ROWS).map(|k| k as f64 * 1e-3).collect();
    Record::from_rows(name, &t, &u, &y).unwrap()
}

fn run(truth: &Model, noise: NoiseKind) -> Reconciliation {
    let records = [
        record("one", truth, 1.0, 11),
        record("two", truth, 0.5, 12),
        record("rest", truth, 0.0, 13),
    ];
    let options = Options {
        free_start: true,
        noise,
        ..Options::default()
    };
    reconcile(&plant(), &records, &options, &mut |_| {}).unwrap()
}

#[test]
fn slow_noise_of_a_sensor_is_measured_and_nothing_is_missing() {
    let r = run(&plant(), NoiseKind::Auto);
    let slow = r.noise.coloured.expect("coloured noise");
    // 6000 rows are a hundred times of 60: a variance is known to some 20 %.
    assert!(
        (slow.variance_um2.sqrt() / SLOW_UM).ln().abs() < 0.35,
        "{slow:?}"
    );
    assert!((slow.time_rows / SLOW_ROWS).ln().abs() < 0.6, "{slow:?}");
    assert_eq!(r.noise.walk_um2, 0.0);
    assert_eq!(r.verdict, Verdict::NothingMissing, "{:?}", r.places);
    assert!(
        r.places
            .iter()
            .any(|p| p.contains("the noise itself is slow"))
    );
    // The next command does not take what is stated of this noise for all of it.
    assert!(r.augmented.provenance.contains_key("noise.coloured"));
}

#[test]
fn an_effect_is_named_beside_slow_noise() {
    let r = run(
        &plant().with_effect(effects::gain_error(1.1)),
        NoiseKind::Auto,
    );
    let named: Vec<&str> = r.effects.iter().map(|e| e.id.as_str()).collect();
    assert_eq!(named, ["gain-error"], "{:?}", r.places);
    let factor = &r.effects[0].parameters["factor"];
    assert!((factor.value - 1.1).abs() < 0.01, "{factor:?}");
}

#[test]
#[ignore = "13 s of a debug build: for .ci/nightly"]
fn noise_that_is_said_to_be_white_makes_slow_noise_an_error() {
    let r = run(&plant(), NoiseKind::White);
    assert!(r.noise.coloured.is_none() && r.noise.walk_um2 == 0.0);
    assert_ne!(r.verdict, Verdict::NothingMissing);
    assert!(r.effects.is_empty(), "{:?}", r.effects);
}
