//! Effects of the camera.

use super::*;

#[test]
fn a_delay_shifts_the_phase_by_360_f_d_and_leaves_the_gain() {
    for delay_s in [2e-3, 1.5e-3, 0.37e-3] {
        let model = Model::eq6().with_effect(effects::time_delay(delay_s));
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
        let model = Model::eq6().with_effect(effects::time_delay(2e-3));
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
            .with_effect(effects::exposure_averaging(exposure_s))
            .with_effect(effects::time_delay(delay_s));
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
        let with = Model::eq6().with_effect(effects::exposure_averaging(exposure_s));
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
fn a_skewed_clock_errs_in_proportion_to_time_and_frequency() {
    let ppm = 400.0;
    let model = Model::eq6().with_effect(effects::clock_skew(ppm));
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
    let other = Model::eq6().with_effect(effects::clock_skew(-400.0));
    let y = run(&other, &u, 1e-3);
    assert!((y[3999] - skewed[3999]).abs() > 1e-3);
}

#[test]
fn pixel_locking_is_periodic_in_position() {
    let model = unity().with_effect(effects::pixel_locking(0.2, 0.05, 30.0));
    let u: Vec<f64> = (0..200).map(|k| 0.013 * k as f64).collect();
    for (y, x) in run(&model, &u, 1e-3).iter().skip(1).zip(&u) {
        let expected = x + 0.05 * 0.2 * (TAU * x / 0.2 + PI / 6.0).sin();
        assert!((y - expected).abs() < 1e-12);
    }
}

#[test]
fn hum_is_a_line_that_does_not_know_the_input() {
    let hum = effects::mains_hum(50.0, 0.15, 90.0);
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
