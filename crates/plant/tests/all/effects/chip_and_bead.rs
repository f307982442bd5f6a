//! Effects of chip and bead.

use super::*;

#[test]
fn relaxation_is_a_step_in_gain_with_a_bump_in_phase_at_its_frequency() {
    let (time_s, strength) = (0.2, 0.3);
    let model = Model::eq6().with_effect(effects::pdms_relaxation(time_s, strength));
    let ratio = |f: f64| model.linear_response(Hertz(f)) / Model::eq6().linear_response(Hertz(f));
    let corner = 1.0 / (TAU * time_s);
    assert!((ratio(corner / 100.0).norm() - 1.0).abs() < 1e-3);
    assert!((ratio(corner * 100.0).norm() - 1.3).abs() < 1e-3);
    // The bump of a lead pair: asin((a - 1)/(a + 1)) at the geometric mean.
    let bump = ratio(corner / 1.3_f64.sqrt()).arg();
    assert!((bump - (0.3_f64 / 2.3).asin()).abs() < 1e-9);
    assert!(bump > ratio(3.0 * corner).arg() && bump > ratio(corner / 3.0).arg());
    // In time: a step in displacement gives 1 + strength exp(-t/time) of it.
    let y = run(
        &unity().with_effect(effects::pdms_relaxation(time_s, strength)),
        &[1.0; 300],
        1e-3,
    );
    for (k, y) in y.iter().enumerate().skip(1) {
        let expected = 1.0 + strength * (-(k as f64) * 1e-3 / time_s).exp();
        assert!((y - expected).abs() < 1e-10);
    }
}

#[test]
fn a_bubble_is_an_extra_pole_and_fades_when_it_dissolves() {
    let lag_s = 3e-3;
    let lasting = unity().with_effect(effects::bubble(lag_s, 0.0));
    for (k, y) in run(&lasting, &[1.0; 20], 1e-3).iter().enumerate() {
        assert!((y - (1.0 - (-(k as f64) * 1e-3 / lag_s).exp())).abs() < 1e-11);
    }
    let dissolving = Model::eq6().with_effect(effects::bubble(lag_s, 0.5));
    let constant = |lag: f64| Model::eq6().with_effect(effects::bubble(lag, 0.0));
    let n = 8000;
    let u: Vec<f64> = sine(50.0, 1.0, 1e-3, n).iter().map(|u| u + 4.0).collect();
    let y = run(&dissolving, &u, 1e-3);
    for (range, t) in [(1000..1500, 1.25), (7000..7500, 7.25)] {
        let now = lag_s * (-0.5_f64 * t).exp();
        let expected = harmonic(&run(&constant(now), &u, 1e-3), 50.0, 1e-3, 500);
        let part: Vec<f64> = y[..range.end].to_vec();
        let got = harmonic(&part, 50.0, 1e-3, 500);
        assert!(
            (got / expected - 1.0).norm() < 0.03,
            "{t}: {got} {expected}"
        );
    }
}

#[test]
fn a_leak_lets_a_step_sag_exponentially_to_zero() {
    let model = unity().with_effect(effects::leak(2.0));
    for (k, y) in run(&model, &[1.0; 500], 1e-3).iter().enumerate().skip(1) {
        assert!((y - (-2.0 * k as f64 * 1e-3).exp()).abs() < 1e-12);
    }
    let lead = model.linear_response(Hertz(2.0 / TAU)).arg().to_degrees();
    assert!((lead - 45.0).abs() < 1e-9);
}

#[test]
fn a_gain_error_is_the_same_at_all_frequencies_amplitudes_and_times() {
    let model = Model::eq6().with_effect(effects::gain_error(1.7));
    let u: Vec<f64> = sine(13.0, 1.0, 1e-3, 500).iter().map(|u| u + 4.0).collect();
    for (a, b) in run(&model, &u, 1e-3)
        .iter()
        .zip(run(&Model::eq6(), &u, 1e-3))
    {
        assert!((a - 1.7 * b).abs() < 1e-10);
    }
}

#[test]
fn a_gain_drift_multiplies_the_velocity_by_one_plus_r_t() {
    let r = 0.05;
    let u: Vec<f64> = sine(3.0, 1.0, 1e-3, 2000).iter().map(|u| u + 4.0).collect();
    let plain = run(&Model::eq6(), &u, 1e-3);
    let drifting = run(&Model::eq6().with_effect(effects::gain_drift(r)), &u, 1e-3);
    // Increment by increment: the mean of 1 + r t over the row weights the increment, but for its slope.
    for k in 1..2000 {
        let factor = 1.0 + r * (k as f64 - 0.5) * 1e-3;
        let expected = factor * (plain[k] - plain[k - 1]);
        assert!(
            (drifting[k] - drifting[k - 1] - expected).abs() < 1e-4 * r + 2e-6,
            "{k}"
        );
    }
}

#[test]
fn adhesion_holds_the_bead_below_its_speed_and_lets_it_lag_above() {
    let mut model = Model::eq6();
    model.plant = TransferFunction::integrator(400.0).unwrap();
    let stuck = model.clone().with_effect(effects::wall_adhesion(35.0));
    // 0.08 um gives 32 um/s: stuck. 0.5 um gives 200 um/s: 165 are left.
    let y = run(&stuck, &[4.08; 50], 1e-3);
    assert!(y.iter().all(|y| *y == 0.0));
    let y = run(&stuck, &[4.5; 50], 1e-3);
    assert!((y[49] - 49.0 * 0.165).abs() < 1e-9);
    // A sine of speed: the travel per half period is that of the dead zone in closed form.
    let (v, v0, f) = (100.0, 35.0, 2.0);
    let u: Vec<f64> = (0..1000)
        .map(|k| 4.0 + v / 400.0 * (TAU * f * (k as f64 + 0.5) * 1e-3).sin())
        .collect();
    let y = run(&stuck, &u, 1e-3);
    let top = y[..500].iter().fold(0.0_f64, |m, y| m.max(*y));
    let a = (v0 / v).asin();
    let travel = (2.0 * v * a.cos() - v0 * (PI - 2.0 * a)) / (TAU * f);
    assert!((top - travel).abs() < 0.01 * travel, "{top} {travel}");
    // Plateaus at the reversals.
    assert!(y.windows(2).filter(|w| w[0] == w[1]).count() > 150);
}

#[test]
fn adhesion_within_a_step_is_exact_when_the_flow_reverses_in_it() {
    // Lag before integrator: the speed decays through the threshold within the pieces.
    let mut model = Model::eq6();
    model.plant = TransferFunction::integrator(400.0).unwrap();
    let stuck = model
        .with_effect(effects::driver_lag(20.0))
        .with_effect(effects::wall_adhesion(35.0));
    let mut chain = Chain::new(&stuck).unwrap();
    chain.advance(5.0, 0.05);
    let up = chain.bead_um();
    chain.advance(4.0, 1.0);
    // From 400 um/s (nearly) down: the sum of (400 e^{-w t} - 35) until 35.
    let w = TAU * 20.0;
    let v = 400.0 * (1.0 - (-w * 0.05_f64).exp());
    let t = (v / 35.0_f64).ln() / w;
    let expected = v / w * (1.0 - 35.0 / v) - 35.0 * t;
    assert!(
        (chain.bead_um() - up - expected).abs() < 1e-3,
        "{} {expected}",
        chain.bead_um() - up
    );
}

#[test]
fn drift_is_a_ramp_at_rest_too_and_does_not_unstick_a_held_bead() {
    let model = Model::eq6().with_effect(effects::flow_drift(8.0));
    let y = run(&model, &[4.0; 1000], 1e-3);
    assert!((y[999] - 8.0 * 0.999).abs() < 1e-9);
    // The flow that adhesion sees includes the drift.
    let held = model.with_effect(effects::wall_adhesion(10.0));
    assert!(run(&held, &[4.0; 100], 1e-3).iter().all(|y| *y == 0.0));
}
