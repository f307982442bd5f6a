//! Brownian motion, localisation noise, and that a seed fixes every bit.

use cellpos_plant::{Chain, Model, SimulateOptions, Simulator, effects, simulate};

fn noisy(model: &Model, n: usize, seed: u64) -> Vec<f64> {
    let options = SimulateOptions {
        seed: Some(seed),
        ..SimulateOptions::default()
    };
    simulate(model, &vec![4.0; n], 1e-3, &options).unwrap()
}

fn variance_of_increments(y: &[f64], lag: usize) -> f64 {
    let d: Vec<f64> = y.windows(lag + 1).map(|w| w[lag] - w[0]).collect();
    d.iter().map(|d| d * d).sum::<f64>() / d.len() as f64
}

#[test]
fn brownian_increments_have_the_variance_2_d_dt() {
    let mut model = Model::eq6();
    model.noise.localisation_um = 0.0;
    let y = noisy(&model, 40_000, 5);
    for lag in [1, 5, 20] {
        let expected = 2.0 * 0.33 * 1e-3 * lag as f64;
        let ratio = variance_of_increments(&y, lag) / expected;
        // Relative standard error: sqrt(2 lag / n) or so.
        assert!(
            (ratio - 1.0).abs() < 5.0 * (2.0 * lag as f64 / 4e4).sqrt(),
            "{lag}: {ratio}"
        );
    }
}

#[test]
fn steps_of_any_length_diffuse_alike() {
    let model = Model::eq6();
    let travel = |dt: f64, n: usize| {
        let mut chain = Chain::with_brownian_motion(&model, 11).unwrap();
        let mut last = 0.0;
        (0..20_000 / n)
            .map(|_| {
                for _ in 0..n {
                    chain.advance(4.0, dt);
                }
                let d = chain.bead_um() - last;
                last = chain.bead_um();
                d * d
            })
            .sum::<f64>()
            / (20_000 / n) as f64
    };
    let (once, often) = (travel(1e-3, 1), travel(2.5e-4, 4));
    assert!((once / 0.66e-3 - 1.0).abs() < 0.05 && (often / 0.66e-3 - 1.0).abs() < 0.1);
}

#[test]
fn localisation_noise_is_white_and_of_its_size() {
    let mut model = Model::eq6();
    model.noise.diffusion_um2_per_s = 0.0;
    let y = noisy(&model, 20_000, 6);
    let n = y.len() as f64;
    let variance = y.iter().map(|y| y * y).sum::<f64>() / n;
    assert!((variance / 9e-4 - 1.0).abs() < 0.05);
    let neighbours = y.windows(2).map(|w| w[0] * w[1]).sum::<f64>() / n / variance;
    assert!(neighbours.abs() < 5.0 / n.sqrt());
}

#[test]
fn an_exposure_takes_a_third_of_itself_from_the_brownian_increments() {
    let mut model = Model::eq6().with_effect(effects::exposure_averaging(0.9e-3));
    model.noise.localisation_um = 0.0;
    let y = noisy(&model, 40_000, 7);
    let expected = 2.0 * 0.33 * (1e-3 - 0.9e-3 / 3.0);
    let ratio = variance_of_increments(&y, 1) / expected;
    assert!((ratio - 1.0).abs() < 0.04, "{ratio}");
    // Over long times nothing is lost.
    let ratio = variance_of_increments(&y, 20) / (2.0 * 0.33 * (20e-3 - 0.3e-3));
    assert!((ratio - 1.0).abs() < 0.2, "{ratio}");
}

#[test]
fn a_seed_fixes_every_bit_and_no_seed_means_no_noise() {
    let model = Model::eq6();
    let bits = |seed| {
        noisy(&model, 500, seed)
            .iter()
            .map(|y| y.to_bits())
            .collect::<Vec<_>>()
    };
    assert_eq!(bits(1), bits(1));
    assert_ne!(bits(1), bits(2));
    let still = simulate(&model, &[4.0; 100], 1e-3, &SimulateOptions::default()).unwrap();
    assert!(still.iter().all(|y| *y == 0.0));
}

#[test]
fn row_by_row_and_whole_records_are_the_same_to_the_bit() {
    let model = Model::eq6()
        .with_effect(effects::time_delay(2.4e-3))
        .with_effect(effects::exposure_averaging(0.7e-3));
    let u: Vec<f64> = (0..200).map(|k| 4.0 + f64::from(k % 17) * 0.05).collect();
    let options = SimulateOptions {
        seed: Some(3),
        ..SimulateOptions::default()
    };
    let whole = simulate(&model, &u, 1e-3, &options).unwrap();
    let mut simulator = Simulator::new(&model, 1e-3, Some(3)).unwrap();
    for (u, y) in u.iter().zip(&whole) {
        assert_eq!(simulator.measure().to_bits(), y.to_bits());
        simulator.hold(*u);
    }
}

#[test]
fn commands_and_times_that_are_not_finite_hold_the_last_command() {
    let mut chain = Chain::new(&Model::eq6()).unwrap();
    let mut other = chain.clone();
    chain.advance(5.0, 1e-3);
    chain.advance(f64::NAN, 1e-3);
    chain.advance(5.0, f64::INFINITY);
    chain.advance(5.0, -1.0);
    other.advance(5.0, 1e-3);
    other.advance(5.0, 1e-3);
    assert_eq!(chain.bead_um().to_bits(), other.bead_um().to_bits());
    assert!(chain.flow_um_per_s() > 350.0);
}
