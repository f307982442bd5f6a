//! Effects of driver and PZT.

use super::*;

#[test]
fn a_driver_lag_is_an_exponential_with_its_time_constant() {
    let model = unity().with_effect(effects::driver_lag(100.0));
    let y = run(&model, &[1.0; 20], 1e-3);
    for (k, y) in y.iter().enumerate() {
        let expected = 1.0 - (-TAU * 100.0 * k as f64 * 1e-3).exp();
        assert!((y - expected).abs() < 1e-12);
    }
}

#[test]
fn a_slew_limit_makes_straight_ramps_and_passes_slower_inputs_untouched() {
    let model = unity().with_effect(effects::slew_limit(250.0));
    let y = run(&model, &[1.0; 8], 1e-3);
    for (y, expected) in y.iter().zip([0.0, 0.25, 0.5, 0.75, 1.0, 1.0]) {
        assert!((y - expected).abs() < 1e-12);
    }
    let slow: Vec<f64> = (0..100).map(|k| 0.2 * k as f64).collect();
    assert_eq!(run(&model, &slow, 1e-3), run(&unity(), &slow, 1e-3));
    // Product of amplitude and frequency decides: the same amplitude slower is not cut.
    let fast = harmonic(
        &run(&model, &sine(50.0, 1.5, 1e-3, 2000), 1e-3),
        50.0,
        1e-3,
        1000,
    )
    .norm();
    let slow = harmonic(
        &run(&model, &sine(5.0, 1.5, 1e-3, 2000), 1e-3),
        5.0,
        1e-3,
        1000,
    )
    .norm();
    // A triangle of slope rate: fundamental 8/pi^2 times its peak rate/(4 f).
    assert!(
        (fast - 8.0 / (PI * PI) * 250.0 / 200.0).abs() < 0.02,
        "{fast}"
    );
    assert!((slow - 1.5).abs() < 1e-3, "{slow}");
}

#[test]
fn a_slew_ramp_drives_the_plant_exactly() {
    // The corner falls within a sample; a 1 us grid with the ramp as commands is the reference.
    let model = Model::eq6().with_effect(effects::slew_limit(700.0));
    let mut chain = Chain::new(&model).unwrap();
    let mut reference = Chain::new(&Model::eq6()).unwrap();
    for _ in 0..4 {
        chain.advance(5.0, 1e-3);
    }
    for i in 0..4000 {
        let t = (f64::from(i) + 0.5) * 1e-6;
        reference.advance(4.0 + (700.0 * t).min(1.0), 1e-6);
    }
    assert!((chain.bead_um() - reference.bead_um()).abs() < 1e-7);
    assert_eq!(chain.pzt_um(), 5.0);
}

#[test]
fn saturation_clips_to_absolute_levels_and_the_camera_sees_flat_tops() {
    let mut model = unity().with_effect(effects::saturation(3.5, 5.0));
    model.working_point_um = 4.0;
    let u: Vec<f64> = sine(10.0, 2.0, 1e-3, 200).iter().map(|u| u + 4.0).collect();
    let y = run(&model, &u, 1e-3);
    let (low, high) = y
        .iter()
        .fold((9.0_f64, -9.0_f64), |(l, h), y| (l.min(*y), h.max(*y)));
    assert_eq!((low, high), (-0.5, 1.0));
    assert!(y.iter().filter(|y| **y == high).count() > 50);
}

#[test]
fn bouc_wen_is_its_differential_equation_whatever_the_steps() {
    let path = [0.0, 1.5, -2.0, 0.3, 0.1, 3.0, -0.5];
    let y = run(&unity().with_effect(bouc_wen(false)), &path, 1e-3);
    let mut h = 0.0_f64;
    for k in 1..path.len() {
        // Fine Euler integration of dh = du - beta |du| h - gamma du |h| along the straight way.
        let n = 200_000;
        let du = (path[k] - path[k - 1]) / f64::from(n);
        if k + 1 < path.len() {
            for _ in 0..n {
                h += du - 0.9 * du.abs() * h - 0.2 * du * h.abs();
            }
            assert!((y[k + 1] - (path[k] - 0.3 * h)).abs() < 1e-5, "{k}");
        }
    }
    // The explicit form takes one step per change, and becomes the exact one when the changes are small.
    let fine: Vec<f64> = path
        .windows(2)
        .flat_map(|w| (1..=2000).map(move |i| w[0] + (w[1] - w[0]) * f64::from(i) / 2000.0))
        .collect();
    let exact = run(&unity().with_effect(bouc_wen(false)), &fine, 1e-3);
    let explicit = run(&unity().with_effect(bouc_wen(true)), &fine, 1e-3);
    let worst = exact
        .iter()
        .zip(&explicit)
        .fold(0.0_f64, |m, (a, b)| m.max((a - b).abs()));
    assert!(worst < 1e-3, "{worst}");
    let coarse = run(
        &unity().with_effect(bouc_wen(true)),
        &[1.5, -2.0, 0.0],
        1e-3,
    );
    assert!((coarse[1] - (1.5 - 0.3 * 1.5)).abs() < 1e-12);
}

#[test]
fn hysteresis_lags_alike_at_all_frequencies_and_the_gain_rises_with_amplitude() {
    let model = unity().with_effect(bouc_wen(false));
    let of = |f: f64, a: f64| {
        let u = sine(f, a, 1e-3, 4000);
        harmonic(&run(&model, &u, 1e-3), f, 1e-3, 1000)
            / harmonic(&run(&unity(), &u, 1e-3), f, 1e-3, 1000)
    };
    assert!((of(2.0, 1.0) / of(20.0, 1.0) - 1.0).norm() < 0.01);
    assert!(of(5.0, 2.0).norm() > of(5.0, 0.2).norm() + 0.05);
    assert!(of(5.0, 0.01).norm() < 0.71);
}

#[test]
fn play_operators_have_the_loop_of_their_sum() {
    let model = unity().with_effect(play(vec![0.0, 0.5], vec![0.6, 0.4], 0.1));
    let y = run(&model, &[1.0, 0.8, 0.0, -1.0, 0.0, 0.0], 1e-3);
    // p0 = u; p1: 0.5, 0.5 (0.8 + 0.5 > 0.5), 0.5, -0.5, -0.5.
    for (y, (p0, p1)) in y[1..].iter().zip([
        (1.0, 0.5),
        (0.8, 0.5),
        (0.0, 0.5),
        (-1.0, -0.5),
        (0.0, -0.5),
    ]) {
        let v: f64 = 0.6 * p0 + 0.4 * p1;
        assert!((y - (v + 0.1 * v * v)).abs() < 1e-12);
    }
}

#[test]
fn curved_play_operators_lose_more_at_one_end_of_the_stroke() {
    let curve = effects::Curve {
        quadratic_per_um: -0.03,
        cubic_per_um2: 0.002,
        input_quadratic_per_um: 0.05,
    };
    let effect = effects::curved_play(&[0.0, 0.5], &[0.6, 0.4], curve);
    assert_eq!(effect.get("cubic_per_um2"), Some(0.002));
    let y = run(
        &unity().with_effect(effect),
        &[2.0, 0.0, -2.0, 0.0, 0.0],
        1e-3,
    );
    let of = |u: f64, p1: f64| {
        let v = 0.6 * u + 0.4 * p1;
        v - 0.03 * v.powi(2) + 0.002 * v.powi(3) + 0.05 * u.powi(2)
    };
    for (y, (u, p1)) in y[1..]
        .iter()
        .zip([(2.0, 1.5), (0.0, 0.5), (-2.0, -1.5), (0.0, -0.5)])
    {
        assert!((y - of(u, p1)).abs() < 1e-12);
    }
    // Width of the loop between -2 and 2, near either end: on the way out the wide operator lags by 0.5, on the way back it leads.
    let width = |u: f64| of(u, u + 0.5) - of(u, u - 0.5);
    assert!(width(-1.5) > 1.1 * width(1.5));
    // The plain form is the one without curves.
    let flat = effects::curved_play(&[0.0, 0.5], &[0.6, 0.4], effects::Curve::default());
    assert_eq!(flat, play(vec![0.0, 0.5], vec![0.6, 0.4], 0.0));
}

#[test]
fn many_play_operators_show_rayleighs_third_harmonic_one_fifth_of_the_quadrature() {
    // Uniform density of thresholds: the loop's branches are parabolas, which is Rayleigh's law.
    let n = 60;
    let r: Vec<f64> = (0..n).map(|i| 0.02 * f64::from(i)).collect();
    let mut w = vec![0.002; n as usize];
    w[0] = 1.0;
    let model = unity().with_effect(play(r, w, 0.0));
    let of = |a: f64| {
        let u = sine(5.0, a, 1e-3, 4000);
        let y = run(&model, &u, 1e-3);
        // Rotated so that the input's samples (one row late) are the phase reference.
        let rotate = |m: f64| Complex::from_polar(1.0, TAU * 5.0 * m * 1e-3);
        (
            harmonic(&y, 5.0, 1e-3, 2000) * rotate(1.0),
            harmonic(&y, 15.0, 1e-3, 2000) * rotate(3.0),
        )
    };
    // A sine's reference phase is -90 deg: the part in quadrature is the real one.
    let (first, third) = of(0.5);
    assert!(first.re < 0.0, "the loop lags: {first}");
    let ratio = third.norm() / first.re.abs();
    assert!((ratio - 0.2).abs() < 0.02, "{ratio}");
    // And the lag grows with the amplitude.
    let lag = |(first, _): (Complex<f64>, Complex<f64>)| -first.re / -first.im;
    assert!((lag(of(0.5)) / lag(of(0.25)) - 2.0).abs() < 0.2);
}

#[test]
fn creep_gains_its_share_per_decade_and_lags_by_39_degrees_times_it() {
    let g = 0.02;
    let model = unity().with_effect(effects::pzt_creep(g));
    let mut chain = Chain::new(&model).unwrap();
    let mut now = 0.0;
    for t in [1e-3, 1e-2, 0.1, 1.0, 10.0, 100.0, 300.0] {
        chain.advance(5.0, t - now);
        now = t;
        let expected = 5.0 * (1.0 + g * (t / 0.1_f64).log10());
        assert!((chain.pzt_um() - expected).abs() < 5.0 * g * 0.02, "{t} s");
    }
    // Reversing the step flips the tail.
    let mut other = Chain::new(&model).unwrap();
    other.advance(-5.0, 300.0);
    assert!((other.pzt_um() + chain.pzt_um()).abs() < 1e-9);
    for f in [0.1, 1.0, 10.0, 100.0] {
        let phase = model.linear_response(Hertz(f)).arg().to_degrees();
        assert!(
            (phase + 39.0 * g).abs() < 0.05 * 39.0 * g,
            "{f} Hz: {phase}"
        );
    }
}

#[test]
fn negative_creep_is_the_same_law_with_the_sign_reversed() {
    let model = unity().with_effect(effects::pzt_creep(-0.05));
    let mut chain = Chain::new(&model).unwrap();
    chain.advance(1.0, 10.0);
    assert!((chain.bead_um() - 0.9).abs() < 0.002, "{}", chain.bead_um());
}

#[test]
fn a_resonance_rings_at_its_frequency_with_its_damping() {
    let (f, zeta) = (200.0, 0.05);
    let model = unity().with_effect(effects::pzt_resonance(f, zeta));
    let y = run(&model, &[1.0; 50], 1e-3);
    let (w, wd) = (TAU * f, TAU * f * (1.0 - zeta * zeta).sqrt());
    for (k, y) in y.iter().enumerate() {
        let t = k as f64 * 1e-3;
        let expected =
            1.0 - (-zeta * w * t).exp() * ((wd * t).cos() + zeta * w / wd * (wd * t).sin());
        assert!((y - expected).abs() < 1e-10, "{k}");
    }
    let peak = model.linear_response(Hertz(f));
    assert!((peak.norm() - 1.0 / (2.0 * zeta)).abs() < 1e-9);
    assert!((peak.arg().to_degrees() + 90.0).abs() < 1e-9);
    // Critically damped: a double pole.
    let model = unity().with_effect(effects::pzt_resonance(f, 1.0));
    for (k, y) in run(&model, &[1.0; 20], 1e-3).iter().enumerate() {
        let wt = w * k as f64 * 1e-3;
        assert!((y - (1.0 - (1.0 + wt) * (-wt).exp())).abs() < 1e-8);
    }
}

#[test]
fn backlash_is_flat_after_reversals_and_matters_less_for_larger_strokes() {
    let model = unity().with_effect(effects::backlash(0.4));
    let y = run(&model, &[1.0, 0.9, 0.7, 0.5, -1.0, -0.9, 0.0], 1e-3);
    for (y, expected) in y.iter().zip([0.0, 0.8, 0.8, 0.8, 0.7, -0.8, -0.8]) {
        assert!((y - expected).abs() < 1e-12);
    }
    let lag = |a: f64| {
        let u = sine(5.0, a, 1e-3, 2000);
        let ratio = harmonic(&run(&model, &u, 1e-3), 5.0, 1e-3, 1000)
            / harmonic(&run(&unity(), &u, 1e-3), 5.0, 1e-3, 1000);
        -ratio.arg()
    };
    assert!(lag(0.4) > 2.0 * lag(1.0) && lag(1.0) > 2.0 * lag(4.0) && lag(4.0) > 0.0);
}
