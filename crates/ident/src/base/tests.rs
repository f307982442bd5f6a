use super::*;
use crate::sampled::Hold;
use cellpos_numeric::Random;

/// Steps held for `held` rows each.
fn steps(rows: usize, held: usize, seed: u64) -> Vec<f64> {
    let mut random = Random::new(seed);
    let mut value = 0.0;
    (0..rows)
        .map(|k| {
            if k % held == 0 {
                value = random.normal();
            }
            value
        })
        .collect()
}

/// A mass on a spring with damper by small explicit steps: another integrator than the fit's. Force in, position out.
fn spring(force: &[f64], period_s: f64, stiffness: f64, damping: f64) -> Vec<f64> {
    let fine = 200;
    let h = period_s / f64::from(fine);
    let (mut x, mut v) = (0.003, 0.0);
    force
        .iter()
        .map(|f| {
            let seen = x;
            for _ in 0..fine {
                v += h * (f - stiffness * x - damping * v);
                x += h * v;
            }
            seen
        })
        .collect()
}

fn with_noise(mut y: Vec<f64>, sd: f64) -> Vec<f64> {
    let mut random = Random::new(77);
    y.iter_mut().for_each(|y| *y += sd * random.normal());
    y
}

#[test]
fn a_spring_under_held_steps_gets_its_stiffness_and_damping_within_their_intervals() {
    let input = steps(3000, 25, 1);
    let output = with_noise(spring(&input, 2e-3, 400.0, 4.0), 2e-5);
    let record = Series { input, output };
    let fits = choose(&[record], 500.0, Hold::ZeroOrder, None, 4).unwrap();
    let best = &fits[0];
    assert_eq!(
        (best.form.order, best.form.integrating),
        (2, false),
        "{best:?}"
    );
    assert!(!best.form.delay, "{best:?}");
    let m = &best.model;
    for (i, truth) in [(1, 4.0), (2, 400.0)] {
        let off = (m.denominator[i] - truth).abs();
        // The explicit steps of the record are themselves off by a part in a thousand.
        assert!(off < 3.0 * m.denominator_sd[i] + 2e-3 * truth, "{m:?}");
        assert!(m.denominator_sd[i] < 0.01 * truth, "{m:?}");
    }
    assert!(best.residual_rms < 3e-5, "{best:?}");
}

#[test]
fn a_motor_that_integrates_is_told_from_one_that_does_not_and_its_resting_input_is_found() {
    let input = steps(2500, 40, 3);
    let (mut x, mut v) = (0.0, 0.0);
    let output: Vec<f64> = input
        .iter()
        .map(|u| {
            let seen = x;
            for _ in 0..100 {
                v += 1e-4 * (20.0 * (u - 0.4) - v) / 0.1;
                x += 1e-4 * v;
            }
            seen
        })
        .collect();
    let record = Series {
        input,
        output: with_noise(output, 0.01),
    };
    let fits = choose(&[record], 100.0, Hold::ZeroOrder, None, 3).unwrap();
    let best = &fits[0];
    assert!(best.form.integrating && best.form.order == 2, "{best:?}");
    assert!(
        (best.model.denominator[1] / 10.0 - 1.0).abs() < 0.01,
        "{best:?}"
    );
    assert!((best.rest_input.unwrap() - 0.4).abs() < 0.01, "{best:?}");
}

#[test]
fn a_delay_between_rows_is_found_through_gaps_and_from_several_records() {
    let (late, lag_s, period_s) = (6.5, 0.4, 0.05);
    let record = |seed: u64| {
        let input = steps(900, 11, seed);
        let mut x = 0.0;
        let output: Vec<f64> = (0..900)
            .map(|k| {
                let seen = x;
                for i in 0..100 {
                    let at = f64::from(k) + f64::from(i) / 100.0 - late;
                    let u = input[at.floor().max(0.0) as usize];
                    x += period_s / 100.0 * (2.0 * u - x) / lag_s;
                }
                // Every ninth row came without an output.
                if k % 9 == 4 { f64::NAN } else { seen }
            })
            .collect();
        Series {
            input,
            output: with_noise(output, 0.005),
        }
    };
    let form: Form = "order=1,delay".parse().unwrap();
    let records = [record(4), record(5)];
    let fits = choose(&records, 20.0, Hold::ZeroOrder, Some(form), 4).unwrap();
    let m = &fits[0].model;
    assert!((m.delay_s / (late * period_s) - 1.0).abs() < 0.01, "{m:?}");
    assert!((m.denominator[1] * lag_s - 1.0).abs() < 0.02, "{m:?}");
    assert!(m.delay_sd_s > 0.0 && m.delay_sd_s < 0.01, "{m:?}");
}

#[test]
fn a_static_sensor_is_static_and_a_sampled_input_is_taken_as_sampled() {
    let input: Vec<f64> = (0..600)
        .map(|k| (0.11 * f64::from(k)).sin() + 0.5 * (0.037 * f64::from(k)).cos())
        .collect();
    let output = with_noise(input.iter().map(|u| 7.0 - 3.0 * u).collect(), 0.01);
    let record = Series { input, output };
    let fits = choose(&[record], 1.0, Hold::None, None, 2).unwrap();
    let best = &fits[0];
    assert_eq!(best.form.order, 0, "{best:?}");
    assert!((best.model.numerator[0] + 3.0).abs() < 0.01, "{best:?}");
}

#[test]
fn records_that_cannot_be_fitted_are_told_so() {
    let still = Series {
        input: vec![2.0; 500],
        output: vec![1.0; 500],
    };
    let words = |r: Series| {
        choose(&[r], 10.0, Hold::None, None, 2)
            .unwrap_err()
            .to_string()
    };
    assert!(words(still).contains("moves"));
    let short = Series {
        input: steps(30, 3, 1),
        output: steps(30, 3, 2),
    };
    assert!(words(short).contains("50"));
    for (text, says) in [
        ("order=2,lag", "lag"),
        ("delay", "order is missing"),
        ("static,integrating", "integrate"),
        ("order=2,zeros=3", "at most 2 zeros"),
        ("order=99", "up to 8"),
    ] {
        let wrong = text.parse::<Form>().unwrap_err().to_string();
        assert!(wrong.contains(says), "{wrong}");
    }
}
