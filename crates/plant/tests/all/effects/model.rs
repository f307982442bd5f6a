//! Effects together, and the model that holds them.

use super::*;

#[test]
fn a_model_means_the_same_in_whatever_order_its_effects_are_written() {
    let a = effects::driver_lag(150.0);
    let b = bouc_wen(false);
    let c = effects::wall_adhesion(20.0);
    let u: Vec<f64> = sine(9.0, 1.0, 1e-3, 300).iter().map(|u| u + 4.0).collect();
    let one = Model::eq6()
        .with_effect(a.clone())
        .with_effect(b.clone())
        .with_effect(c.clone());
    let two = Model::eq6().with_effect(c).with_effect(b).with_effect(a);
    assert_eq!(run(&one, &u, 1e-3), run(&two, &u, 1e-3));
}

#[test]
fn sub_steps_are_fine_enough_for_hysteresis_behind_a_lag_and_adhesion_behind_the_plant() {
    let model = Model::eq6()
        .with_effect(effects::driver_lag(300.0))
        .with_effect(bouc_wen(false))
        .with_effect(effects::backlash(0.05))
        .with_effect(effects::wall_adhesion(35.0));
    let u: Vec<f64> = sine(43.0, 1.0, 1e-3, 500).iter().map(|u| u + 4.0).collect();
    let mut coarse = Chain::new(&model).unwrap();
    let mut fine = Chain::new(&model).unwrap();
    let mut worst = 0.0_f64;
    for u in &u {
        coarse.advance(*u, 1e-3);
        for _ in 0..1000 {
            fine.advance(*u, 1e-6);
        }
        worst = worst.max((coarse.bead_um() - fine.bead_um()).abs());
    }
    assert!(worst < 0.02, "{worst} um");
}

#[test]
fn a_clock_that_is_hardly_skewed_sees_the_same_positions_as_one_that_is_not() {
    let model = Model::eq6()
        .with_effect(effects::time_delay(1.3e-3))
        .with_effect(effects::exposure_averaging(0.4e-3));
    let u: Vec<f64> = sine(21.0, 1.0, 1e-3, 400).iter().map(|u| u + 4.0).collect();
    let regular = run(&model, &u, 1e-3);
    let skewed = run(&model.with_effect(effects::clock_skew(1e-7)), &u, 1e-3);
    for (a, b) in regular.iter().zip(&skewed) {
        assert!((a - b).abs() < 1e-8);
    }
}

#[test]
fn a_parameter_is_changed_by_name_within_its_bounds_only() {
    let lag = effects::driver_lag(100.0);
    let changed = lag.with_parameter("bandwidth_hz", 200.0).unwrap();
    assert_eq!(changed, effects::driver_lag(200.0));
    let error = lag.with_parameter("bandwidth_hz", -1.0).unwrap_err();
    assert_eq!(
        error.to_string(),
        "driver-lag: `bandwidth_hz` = -1 Hz: it must be a finite number in 0.1..100000 Hz"
    );
    assert!(
        lag.with_parameter("bandwidth", 1.0)
            .unwrap_err()
            .to_string()
            .contains("bandwidth_hz")
    );
    let operators = play(vec![0.0, 0.5], vec![0.6, 0.4], 0.1);
    let changed = operators.with_parameter("weights[1]", 0.3).unwrap();
    assert_eq!(changed, play(vec![0.0, 0.5], vec![0.6, 0.3], 0.1));
    let changed = changed.with_parameter("quadratic_per_um", 0.0).unwrap();
    assert_eq!(changed, play(vec![0.0, 0.5], vec![0.6, 0.3], 0.0));
    assert!(operators.with_parameter("weights[2]", 0.3).is_err());
    assert!(operators.with_parameter("thresholds_um[1]", 0.0).is_err());
}
