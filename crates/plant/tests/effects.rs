//! Every effect against its closed form and the signature by which it is told from the others.

use cellpos_plant::{
    Chain, Complex, Effect, Hertz, Hysteresis, Model, SimulateOptions, TransferFunction, simulate,
    simulate_at,
};
use std::f64::consts::{PI, TAU};

/// A static gain of one about zero: what comes out is the displacement itself.
fn unity() -> Model {
    let mut model = Model::eq6();
    model.plant = TransferFunction::new(vec![1.0], vec![1.0]).unwrap();
    model.working_point_um = 0.0;
    model
}

fn run(model: &Model, u: &[f64], sample_s: f64) -> Vec<f64> {
    simulate(model, u, sample_s, &SimulateOptions::default()).unwrap()
}

fn sine(f: f64, amplitude: f64, sample_s: f64, n: usize) -> Vec<f64> {
    (0..n)
        .map(|k| amplitude * (TAU * f * k as f64 * sample_s).sin())
        .collect()
}

/// Complex amplitude of the harmonic at `f` over the last `n` samples (a whole number of periods).
fn harmonic(y: &[f64], f: f64, sample_s: f64, n: usize) -> Complex<f64> {
    let start = y.len() - n;
    let mean = y[start..].iter().sum::<f64>() / n as f64;
    (start..y.len())
        .map(|k| Complex::from_polar(y[k] - mean, -TAU * f * k as f64 * sample_s))
        .sum::<Complex<f64>>()
        * (2.0 / n as f64)
}

/// Response of a model at `f` relative to the input's samples, without the hold's half sample and the record's one
/// sample of waiting: measured against the same chain without the effects.
fn relative_response(model: &Model, f: f64, amplitude: f64) -> Complex<f64> {
    let sample_s = 1e-3;
    let n = (1000.0_f64).round() as usize;
    let u: Vec<f64> = sine(f, amplitude, sample_s, 3 * n)
        .iter()
        .map(|u| u + model.working_point_um)
        .collect();
    let mut base = model.clone();
    base.effects.clear();
    let with = harmonic(&run(model, &u, sample_s), f, sample_s, n);
    let without = harmonic(&run(&base, &u, sample_s), f, sample_s, n);
    with / without
}

#[test]
fn a_delay_shifts_the_phase_by_360_f_d_and_leaves_the_gain() {
    for delay_s in [2e-3, 1.5e-3, 0.37e-3] {
        let model = Model::eq6().with_effect(Effect::TimeDelay { delay_s });
        // The held command has images; on a fine grid the delay must be exact to the sample.
        let u: Vec<f64> = sine(20.0, 1.0, 1e-3, 400).iter().map(|u| u + 4.0).collect();
        let fine: Vec<f64> = u.iter().flat_map(|u| [*u; 100]).collect();
        let plain = run(&Model::eq6(), &fine, 1e-5);
        let delayed = run(&model, &u, 1e-3);
        let shift = (delay_s / 1e-5).round() as usize;
        for (k, delayed) in delayed.iter().enumerate() {
            let expected = (k * 100).checked_sub(shift).map_or(0.0, |i| plain[i]);
            assert!((delayed - expected).abs() < 1e-9, "{delay_s} {k}");
        }
    }
    // Whole samples: the phase, to rounding.
    for f in [5.0, 50.0, 300.0] {
        let model = Model::eq6().with_effect(Effect::TimeDelay { delay_s: 2e-3 });
        let phase = -TAU * f * 2e-3;
        let ratio = relative_response(&model, f, 0.5) * Complex::from_polar(1.0, -phase);
        assert!((ratio - 1.0).norm() < 2e-3, "{f} {ratio}");
    }
}

#[test]
fn an_exposure_is_the_exact_mean_of_the_position_over_the_exposure() {
    let exposure_s = 0.9e-3;
    let u: Vec<f64> = sine(37.0, 1.0, 1e-3, 100).iter().map(|u| u + 4.0).collect();
    for delay_s in [0.0, 0.25e-3, 2e-3] {
        let model = Model::eq6()
            .with_effect(Effect::ExposureAveraging { exposure_s })
            .with_effect(Effect::TimeDelay { delay_s });
        let got = run(&model, &u, 1e-3);
        let mut chain = Chain::new(&Model::eq6()).unwrap();
        let mut fine = vec![0.0];
        for u in &u {
            for _ in 0..1000 {
                // The mid-point of each microsecond.
                chain.advance(*u, 0.5e-6);
                fine.push(chain.bead_um());
                chain.advance(*u, 0.5e-6);
            }
        }
        let (d, e) = ((delay_s * 1e6) as usize, 900);
        for (k, got) in got.iter().enumerate().skip(4) {
            let end = k * 1000 - d;
            let mean = fine[end - e + 1..=end].iter().sum::<f64>() / e as f64;
            assert!((got - mean).abs() < 1e-7, "{k}: {} {mean}", got);
        }
    }
}

#[test]
fn an_exposure_has_the_gain_of_a_sinc_and_half_the_exposure_as_delay() {
    let exposure_s = 0.8e-3;
    for f in [20.0, 100.0] {
        // A command rate of 20 kHz makes the hold's images harmless.
        let sample_s = 5e-5;
        let n = 20_000;
        let u: Vec<f64> = sine(f, 1.0, sample_s, 2 * n)
            .iter()
            .map(|u| u + 4.0)
            .collect();
        let with = Model::eq6().with_effect(Effect::ExposureAveraging { exposure_s });
        let ratio = harmonic(&run(&with, &u, sample_s), f, sample_s, n)
            / harmonic(&run(&Model::eq6(), &u, sample_s), f, sample_s, n);
        let x = PI * f * exposure_s;
        let expected = Complex::from_polar(x.sin() / x, -x);
        assert!(
            (ratio / expected - 1.0).norm() < 1e-3,
            "{f}: {ratio} {expected}"
        );
    }
}

#[test]
fn a_driver_lag_is_an_exponential_with_its_time_constant() {
    let model = unity().with_effect(Effect::DriverLag {
        bandwidth_hz: 100.0,
    });
    let y = run(&model, &[1.0; 20], 1e-3);
    for (k, y) in y.iter().enumerate() {
        let expected = 1.0 - (-TAU * 100.0 * k as f64 * 1e-3).exp();
        assert!((y - expected).abs() < 1e-12);
    }
}

#[test]
fn a_slew_limit_makes_straight_ramps_and_passes_slower_inputs_untouched() {
    let model = unity().with_effect(Effect::SlewLimit {
        rate_um_per_s: 250.0,
    });
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
    let model = Model::eq6().with_effect(Effect::SlewLimit {
        rate_um_per_s: 700.0,
    });
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
    let mut model = unity().with_effect(Effect::Saturation {
        low_um: 3.5,
        high_um: 5.0,
    });
    model.working_point_um = 4.0;
    let u: Vec<f64> = sine(10.0, 2.0, 1e-3, 200).iter().map(|u| u + 4.0).collect();
    let y = run(&model, &u, 1e-3);
    let (low, high) = y
        .iter()
        .fold((9.0_f64, -9.0_f64), |(l, h), y| (l.min(*y), h.max(*y)));
    assert_eq!((low, high), (-0.5, 1.0));
    assert!(y.iter().filter(|y| **y == high).count() > 50);
}

fn bouc_wen(explicit: bool) -> Effect {
    let (fraction, beta_per_um, gamma_per_um) = (0.3, 0.9, 0.2);
    Effect::PztHysteresis(if explicit {
        Hysteresis::BoucWenExplicit {
            fraction,
            beta_per_um,
            gamma_per_um,
        }
    } else {
        Hysteresis::BoucWen {
            fraction,
            beta_per_um,
            gamma_per_um,
        }
    })
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

fn play(thresholds_um: Vec<f64>, weights: Vec<f64>, quadratic_per_um: f64) -> Effect {
    Effect::PztHysteresis(Hysteresis::Play {
        thresholds_um,
        weights,
        quadratic_per_um,
    })
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
    let model = unity().with_effect(Effect::PztCreep { per_decade: g });
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
    let model = unity().with_effect(Effect::PztCreep { per_decade: -0.05 });
    let mut chain = Chain::new(&model).unwrap();
    chain.advance(1.0, 10.0);
    assert!((chain.bead_um() - 0.9).abs() < 0.002, "{}", chain.bead_um());
}

#[test]
fn a_resonance_rings_at_its_frequency_with_its_damping() {
    let (f, zeta) = (200.0, 0.05);
    let model = unity().with_effect(Effect::PztResonance {
        frequency_hz: f,
        damping: zeta,
    });
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
    let model = unity().with_effect(Effect::PztResonance {
        frequency_hz: f,
        damping: 1.0,
    });
    for (k, y) in run(&model, &[1.0; 20], 1e-3).iter().enumerate() {
        let wt = w * k as f64 * 1e-3;
        assert!((y - (1.0 - (1.0 + wt) * (-wt).exp())).abs() < 1e-8);
    }
}

#[test]
fn backlash_is_flat_after_reversals_and_matters_less_for_larger_strokes() {
    let model = unity().with_effect(Effect::Backlash { width_um: 0.4 });
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

#[test]
fn relaxation_is_a_step_in_gain_with_a_bump_in_phase_at_its_frequency() {
    let (time_s, strength) = (0.2, 0.3);
    let model = Model::eq6().with_effect(Effect::PdmsRelaxation { time_s, strength });
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
        &unity().with_effect(Effect::PdmsRelaxation { time_s, strength }),
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
    let lasting = unity().with_effect(Effect::Bubble {
        lag_s,
        dissolution_per_s: 0.0,
    });
    for (k, y) in run(&lasting, &[1.0; 20], 1e-3).iter().enumerate() {
        assert!((y - (1.0 - (-(k as f64) * 1e-3 / lag_s).exp())).abs() < 1e-11);
    }
    let dissolving = Model::eq6().with_effect(Effect::Bubble {
        lag_s,
        dissolution_per_s: 0.5,
    });
    let constant = |lag: f64| {
        Model::eq6().with_effect(Effect::Bubble {
            lag_s: lag,
            dissolution_per_s: 0.0,
        })
    };
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
    let model = unity().with_effect(Effect::Leak {
        corner_rad_per_s: 2.0,
    });
    for (k, y) in run(&model, &[1.0; 500], 1e-3).iter().enumerate().skip(1) {
        assert!((y - (-2.0 * k as f64 * 1e-3).exp()).abs() < 1e-12);
    }
    let lead = model.linear_response(Hertz(2.0 / TAU)).arg().to_degrees();
    assert!((lead - 45.0).abs() < 1e-9);
}

#[test]
fn a_gain_error_is_the_same_at_all_frequencies_amplitudes_and_times() {
    let model = Model::eq6().with_effect(Effect::GainError { factor: 1.7 });
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
    let drifting = run(
        &Model::eq6().with_effect(Effect::GainDrift { per_s: r }),
        &u,
        1e-3,
    );
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
    let stuck = model.clone().with_effect(Effect::WallAdhesion {
        speed_um_per_s: 35.0,
    });
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
        .with_effect(Effect::DriverLag { bandwidth_hz: 20.0 })
        .with_effect(Effect::WallAdhesion {
            speed_um_per_s: 35.0,
        });
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
    let model = Model::eq6().with_effect(Effect::FlowDrift { um_per_s: 8.0 });
    let y = run(&model, &[4.0; 1000], 1e-3);
    assert!((y[999] - 8.0 * 0.999).abs() < 1e-9);
    // The flow that adhesion sees includes the drift.
    let held = model.with_effect(Effect::WallAdhesion {
        speed_um_per_s: 10.0,
    });
    assert!(run(&held, &[4.0; 100], 1e-3).iter().all(|y| *y == 0.0));
}

#[test]
fn a_skewed_clock_errs_in_proportion_to_time_and_frequency() {
    let ppm = 400.0;
    let model = Model::eq6().with_effect(Effect::ClockSkew { ppm });
    let u: Vec<f64> = sine(10.0, 1.0, 1e-3, 4000)
        .iter()
        .map(|u| u + 4.0)
        .collect();
    let skewed = run(&model, &u, 1e-3);
    // Reference: the true position at (1 + e) t.
    let mut chain = Chain::new(&Model::eq6()).unwrap();
    let mut k = 0;
    for (j, u) in u.iter().enumerate() {
        let (from, until) = (j as f64 * 1e-3, (j + 1) as f64 * 1e-3);
        let mut now = from;
        while k < 4000 && k as f64 * 1e-3 * (1.0 + 1e-6 * ppm) <= until {
            let at = k as f64 * 1e-3 * (1.0 + 1e-6 * ppm);
            chain.advance(*u, (at - now).max(0.0));
            now = at.max(now);
            assert!((chain.bead_um() - skewed[k]).abs() < 1e-7, "row {k}");
            k += 1;
        }
        chain.advance(*u, until - now);
    }
    // The last rows lie beyond the record: the last command is held for them.
    assert!(k > 3990);
    let other = Model::eq6().with_effect(Effect::ClockSkew { ppm: -400.0 });
    let y = run(&other, &u, 1e-3);
    assert!((y[3999] - skewed[3999]).abs() > 1e-3);
}

#[test]
fn pixel_locking_is_periodic_in_position() {
    let model = unity().with_effect(Effect::PixelLocking {
        pixel_um: 0.2,
        amplitude: 0.05,
        phase_deg: 30.0,
    });
    let u: Vec<f64> = (0..200).map(|k| 0.013 * k as f64).collect();
    for (y, x) in run(&model, &u, 1e-3).iter().skip(1).zip(&u) {
        let expected = x + 0.05 * 0.2 * (TAU * x / 0.2 + PI / 6.0).sin();
        assert!((y - expected).abs() < 1e-12);
    }
}

#[test]
fn hum_is_a_line_that_does_not_know_the_input() {
    let hum = Effect::MainsHum {
        hz: 50.0,
        um: 0.15,
        phase_deg: 90.0,
    };
    let model = Model::eq6().with_effect(hum);
    let moved: Vec<f64> = sine(7.0, 1.0, 1e-3, 300).iter().map(|u| u + 4.0).collect();
    for u in [vec![4.0; 300], moved] {
        let difference: Vec<f64> = run(&model, &u, 1e-3)
            .iter()
            .zip(run(&Model::eq6(), &u, 1e-3))
            .map(|(a, b)| a - b)
            .collect();
        for (k, d) in difference.iter().enumerate() {
            assert!((d - 0.15 * (TAU * 50.0 * k as f64 * 1e-3).cos()).abs() < 1e-9);
        }
    }
}

#[test]
fn a_model_means_the_same_in_whatever_order_its_effects_are_written() {
    let a = Effect::DriverLag {
        bandwidth_hz: 150.0,
    };
    let b = bouc_wen(false);
    let c = Effect::WallAdhesion {
        speed_um_per_s: 20.0,
    };
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
        .with_effect(Effect::DriverLag {
            bandwidth_hz: 300.0,
        })
        .with_effect(bouc_wen(false))
        .with_effect(Effect::Backlash { width_um: 0.05 })
        .with_effect(Effect::WallAdhesion {
            speed_um_per_s: 35.0,
        });
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
fn rows_at_irregular_times_see_the_same_positions_as_a_regular_record() {
    let model = Model::eq6()
        .with_effect(Effect::TimeDelay { delay_s: 1.3e-3 })
        .with_effect(Effect::ExposureAveraging { exposure_s: 0.4e-3 });
    let u: Vec<f64> = sine(21.0, 1.0, 1e-3, 400).iter().map(|u| u + 4.0).collect();
    let regular = run(&model, &u, 1e-3);
    let times: Vec<f64> = (0..400).map(|k| 17.0 + k as f64 * 1e-3).collect();
    let at = simulate_at(&model, &times, &u, &SimulateOptions::default()).unwrap();
    for (a, b) in regular.iter().zip(&at) {
        assert!((a - b).abs() < 1e-8);
    }
    // A missing row where the command did not change changes nothing in the others.
    let mut flat = u.clone();
    flat[201] = flat[200];
    let whole = simulate_at(&model, &times, &flat, &SimulateOptions::default()).unwrap();
    let (mut t, mut v) = (times, flat);
    t.remove(201);
    v.remove(201);
    let gap = simulate_at(&model, &t, &v, &SimulateOptions::default()).unwrap();
    assert!((gap[300] - whole[301]).abs() < 1e-9);
    // Times that do not rise and displacements that are not finite are refused.
    assert!(simulate_at(&model, &[0.0, 0.0], &[4.0, 4.0], &Default::default()).is_err());
    assert!(simulate_at(&model, &[0.0, 1.0], &[4.0, f64::NAN], &Default::default()).is_err());
    assert!(simulate_at(&model, &[0.0], &[4.0, 4.0], &Default::default()).is_err());
}

#[test]
fn a_parameter_is_changed_by_name_within_its_bounds_only() {
    let lag = Effect::DriverLag {
        bandwidth_hz: 100.0,
    };
    let changed = lag.with_parameter("bandwidth_hz", 200.0).unwrap();
    assert_eq!(
        changed,
        Effect::DriverLag {
            bandwidth_hz: 200.0
        }
    );
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
