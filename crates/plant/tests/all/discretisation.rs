//! The exact discretisation and the chain against fine numerical integration and against each other.

use cellpos_numeric::Random;
use cellpos_plant::{
    Chain, Complex, DiscretePlant, Hertz, Model, Seconds, StateSpace, TransferFunction, effects,
};
use std::f64::consts::TAU;

/// Runge-Kutta integration of a state-space form with the command held; positions just before each command.
fn integrate(
    g: &TransferFunction,
    u: &[f64],
    sample_s: f64,
    delay_steps: usize,
    n: usize,
) -> Vec<f64> {
    let ss = StateSpace::from_transfer_function(g);
    let h = sample_s / n as f64;
    let mut x = nalgebra::DVector::zeros(ss.order());
    let held = |i: isize| {
        if i < 0 { 0.0 } else { u[i as usize / n] }
    };
    let mut out = Vec::new();
    let mut last = 0.0;
    for k in 0..u.len() {
        out.push((&ss.c * &x)[0] + ss.d * last);
        for i in 0..n {
            let v = held((k * n + i) as isize - delay_steps as isize);
            let f = |x: &nalgebra::DVector<f64>| &ss.a * x + &ss.b * v;
            let k1 = f(&x);
            let k2 = f(&(&x + &k1 * (0.5 * h)));
            let k3 = f(&(&x + &k2 * (0.5 * h)));
            let k4 = f(&(&x + &k3 * h));
            x += (k1 + k2 * 2.0 + k3 * 2.0 + k4) * (h / 6.0);
            last = v;
        }
    }
    out
}

fn noise(n: usize, seed: u64) -> Vec<f64> {
    let mut g = Random::new(seed);
    (0..n).map(|_| g.normal()).collect()
}

fn plants() -> Vec<TransferFunction> {
    vec![
        TransferFunction::eq6(),
        TransferFunction::integrator(396.0).unwrap(),
        TransferFunction::new(vec![2.0, 3e4], vec![1.0, 50.0, 1e5]).unwrap(),
        TransferFunction::new(vec![400.0 * 100.0], vec![1.0, 200.0, 1e4, 0.0]).unwrap(),
    ]
}

#[test]
fn steps_agree_with_fine_numerical_integration_for_any_delay() {
    let u = noise(60, 5);
    for g in plants() {
        for delay_steps in [0, 7, 20, 31, 60] {
            let expected = integrate(&g, &u, 1e-3, delay_steps, 20);
            let delay = Seconds(delay_steps as f64 * 5e-5);
            let plant = DiscretePlant::new(&g, Seconds(1e-3), delay).unwrap();
            let mut state = plant.state(0.0);
            for (k, (u, y)) in u.iter().zip(&expected).enumerate() {
                let got = plant.output_um(&state);
                assert!(
                    (got - y).abs() < 1e-6 * (1.0 + y.abs()),
                    "{g:?} {delay_steps} {k}: {got} {y}"
                );
                plant.step(&mut state, *u);
            }
        }
    }
}

#[test]
fn matrices_and_step_are_the_same_system() {
    let u = noise(50, 6);
    for g in plants() {
        for delay in [0.0, 0.4e-3, 2e-3, 2.5e-3] {
            let plant = DiscretePlant::new(&g, Seconds(1e-3), Seconds(delay)).unwrap();
            let (a, b, c) = plant.matrices();
            assert_eq!(a.nrows(), plant.order());
            let mut x = nalgebra::DVector::zeros(plant.order());
            let mut state = plant.state(0.0);
            for u in &u {
                let (y, expected) = (plant.output_um(&state), (&c * &x)[0]);
                assert!((y - expected).abs() < 1e-9 * (1.0 + y.abs()));
                plant.step(&mut state, *u);
                x = &a * x + &b * *u;
            }
            // And the frequency response is that of the matrices.
            let z = Complex::from_polar(1.0, TAU * 40.0 * 1e-3);
            let n = plant.order();
            let system = nalgebra::DMatrix::from_fn(n, n, |i, j| {
                (if i == j { z } else { Complex::new(0.0, 0.0) }) - a[(i, j)]
            });
            let x = system.lu().solve(&b.map(|v| Complex::new(v, 0.0))).unwrap();
            let expected: Complex<f64> = c.iter().zip(x.iter()).map(|(c, x)| x * *c).sum();
            assert!((plant.response(Hertz(40.0)) - expected).norm() < 1e-9 * expected.norm());
        }
    }
}

#[test]
fn far_below_the_sampling_rate_the_response_is_the_plants_with_half_a_sample_of_hold() {
    let g = TransferFunction::eq6();
    let plant = DiscretePlant::new(&g, Seconds(1e-4), Seconds(2.3e-4)).unwrap();
    for f in [1.0, 10.0, 100.0] {
        let hold = Complex::from_polar(1.0, -TAU * f * (2.3e-4 + 0.5e-4));
        let expected = g.response(Hertz(f)) * hold;
        let ratio = plant.response(Hertz(f)) / expected;
        assert!((ratio - 1.0).norm() < 2e-3, "{f} Hz {ratio}");
    }
}

#[test]
fn a_sample_time_or_delay_out_of_range_is_refused() {
    let g = TransferFunction::eq6();
    for (sample, delay) in [(0.0, 0.0), (f64::NAN, 0.0), (1e-3, -1e-3), (1e-3, 2.0)] {
        assert!(DiscretePlant::new(&g, Seconds(sample), Seconds(delay)).is_err());
    }
}

#[test]
fn the_chain_takes_any_steps_to_the_same_place() {
    let mut model = Model::eq6()
        .with_effect(effects::driver_lag(300.0))
        .with_effect(effects::pzt_creep(0.02))
        .with_effect(effects::pzt_resonance(900.0, 0.05))
        .with_effect(effects::leak(1.5))
        .with_effect(effects::flow_drift(5.0));
    model.effects.push(effects::gain_drift(0.05));
    let mut whole = Chain::new(&model).unwrap();
    let mut parts = Chain::new(&model).unwrap();
    for (k, u) in noise(200, 8).into_iter().enumerate() {
        whole.advance(4.0 + u, 1e-3);
        let cut = 1e-3 * (0.1 + 0.8 * ((k * 7 % 11) as f64 / 11.0));
        parts.advance(4.0 + u, 0.0);
        parts.advance(4.0 + u, cut);
        parts.advance(4.0 + u, 1e-3 - cut);
        assert!((whole.bead_um() - parts.bead_um()).abs() < 1e-9);
        assert!((whole.pzt_um() - parts.pzt_um()).abs() < 1e-9);
        assert!((whole.flow_um_per_s() - parts.flow_um_per_s()).abs() < 1e-5);
    }
}

#[test]
fn the_chain_without_effects_is_the_discrete_plant() {
    for g in plants() {
        let mut model = Model::eq6();
        model.plant = g.clone();
        let plant = DiscretePlant::new(&g, Seconds(1e-3), Seconds(0.0)).unwrap();
        let mut state = plant.state(0.0);
        let mut chain = Chain::new(&model).unwrap();
        for u in noise(300, 9) {
            chain.advance(4.0 + u, 1e-3);
            plant.step(&mut state, u);
            let y = plant.output_um(&state);
            assert!((chain.bead_um() - y).abs() < 1e-9 * (1.0 + y.abs()));
            assert!((chain.pzt_um() - 4.0 - u).abs() < 1e-12);
        }
    }
}

#[test]
fn a_static_gain_is_a_plant_too() {
    let mut model = Model::eq6();
    model.plant = TransferFunction::new(vec![5.5], vec![1.0]).unwrap();
    model.working_point_um = 0.0;
    let y = cellpos_plant::simulate(&model, &[1.0, 2.0, 3.0], 5e-3, &Default::default()).unwrap();
    assert_eq!(y, [0.0, 5.5, 11.0]);
}
