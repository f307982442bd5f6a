//! The further effects against closed forms.

use super::*;

#[test]
fn a_stiffening_makes_a_third_harmonic_of_a_quarter_of_c_a_squared() {
    let (c, a, f) = (0.05, 1.5, 10.0);
    let y = run(
        &unity().with_effect(effects::stiffening(c)),
        &sine(f, a, 1e-3, 3000),
        1e-3,
    );
    let third = harmonic(&y, 3.0 * f, 1e-3, 1000).norm();
    assert!(
        (third / (0.25 * c * a * a * a) - 1.0).abs() < 1e-6,
        "{third}"
    );
}

#[test]
fn a_stiffening_by_the_square_makes_a_third_harmonic_of_c_a_squared() {
    let (c, a, f) = (0.05, 1.5, 10.0);
    let y = run(
        &unity().with_effect(effects::stiffening_by_square(c)),
        &sine(f, a, 1e-3, 3000),
        1e-3,
    );
    // Fourier series of sin |sin|.
    let third = harmonic(&y, 3.0 * f, 1e-3, 1000).norm();
    let right = 8.0 / (15.0 * std::f64::consts::PI) * c * a * a;
    assert!((third / right - 1.0).abs() < 1e-3, "{third} {right}");
}

#[test]
fn a_swinging_gain_multiplies_the_speed_and_a_valve_adds_a_drift_in_proportion_to_it() {
    let ramp: Vec<f64> = (0..4000).map(|k| 1e-3 * f64::from(k)).collect();
    let (depth, period_s) = (0.2, 2.0);
    let y = run(
        &unity().with_effect(effects::gain_swing(depth, period_s, 90.0)),
        &ramp,
        1e-3,
    );
    // dx/dt = 1 + d cos(w t): x = t + d/w sin(w t); a record lags by a row.
    let w = TAU / period_s;
    let t = 2.999;
    assert!(
        (y[3000] - (t + depth / w * (w * t).sin())).abs() < 1e-3,
        "{}",
        y[3000]
    );
    let (a, f, asymmetry) = (1.0, 5.0, 0.02);
    let u = sine(f, a, 1e-3, 4001);
    let y = run(
        &unity().with_effect(effects::valve_asymmetry(asymmetry)),
        &u,
        1e-3,
    );
    // Four amplitudes of way per period.
    let drift = asymmetry * 4.0 * a * f * 4.0;
    let found = y[4000] - u[3999];
    assert!((found / drift - 1.0).abs() < 1e-2, "{found} {drift}");
}

#[test]
fn a_stuck_bead_does_not_move_below_the_break_and_follows_in_full_above() {
    let mut model = Model::eq6().with_effect(effects::stick_slip(60.0, 10.0));
    // An integrator of 1/s: a displacement is a speed.
    model.plant = TransferFunction::new(vec![1.0], vec![1.0, 0.0]).unwrap();
    model.working_point_um = 0.0;
    let slow = run(&model, &vec![50.0; 1000], 1e-3);
    assert!(slow[999].abs() < 1e-9, "{}", slow[999]);
    let fast = run(&model, &vec![80.0; 1000], 1e-3);
    assert!((fast[999] - 80.0 * 0.999).abs() < 1e-6, "{}", fast[999]);
    // Once free it continues below the break: up to 80, then at 20.
    let mut u = vec![80.0; 100];
    u.extend(vec![20.0; 900]);
    let y = run(&model, &u, 1e-3);
    assert!((y[999] - y[200] - 20.0 * 0.799).abs() < 1e-6);
}

#[test]
fn a_shaken_camera_shows_the_motion_of_the_piezo_above_the_resonance_of_its_stand() {
    let share = 0.3;
    let still = {
        let mut m = unity();
        m.plant = TransferFunction::new(vec![1e-9], vec![1.0]).unwrap();
        m
    };
    let model = still
        .clone()
        .with_effect(effects::camera_shake(5.0, 0.7, share));
    let y = run(&model, &sine(100.0, 1.0, 1e-4, 20_000), 1e-4);
    let seen = harmonic(&y, 100.0, 1e-4, 10_000).norm();
    assert!((seen / share - 1.0).abs() < 0.01, "{seen}");
    let slow = run(&model, &sine(0.5, 1.0, 1e-3, 8000), 1e-3);
    assert!(harmonic(&slow, 0.5, 1e-3, 4000).norm() < 0.02 * share);
    let h = model.linear_response(Hertz(100.0)).norm();
    assert!((h / share - 1.0).abs() < 0.01, "{h}");
}

#[test]
fn effects_at_random_are_silent_without_a_seed_and_have_their_size_with_one() {
    let rest = vec![0.0; 40_000];
    let seeded = SimulateOptions {
        seed: Some(7),
        ..SimulateOptions::default()
    };
    let mut base = unity();
    base.noise = cellpos_plant::Noise::NONE;
    for effect in [
        effects::flow_wander(5.0, 0.5),
        effects::jumps(2.0, 0.5),
        effects::frame_jitter(1e-3),
    ] {
        let model = base.clone().with_effect(effect.clone());
        let quiet = run(&model, &rest, 1e-3);
        assert!(quiet.iter().all(|y| *y == 0.0), "{effect:?}");
        let loud = simulate(&model, &rest, 1e-3, &seeded).unwrap();
        match effect.id() {
            "flow-wander" => {
                let v: Vec<f64> = loud.windows(2).map(|w| (w[1] - w[0]) / 1e-3).collect();
                let rms = (v.iter().map(|v| v * v).sum::<f64>() / v.len() as f64).sqrt();
                assert!((rms / 5.0 - 1.0).abs() < 0.3, "{rms}");
            }
            "jumps" => {
                let steps = loud.windows(2).filter(|w| w[0] != w[1]).count();
                assert!((50..120).contains(&steps), "{steps} in 40 s at 2 a second");
            }
            // Nothing moves: nothing is late.
            _ => assert!(loud.iter().all(|y| *y == 0.0)),
        }
    }
}
