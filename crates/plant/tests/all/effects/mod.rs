//! Every effect against its closed form and the signature that separates it from the others.

mod camera;
mod chip_and_bead;
mod driver_and_pzt;
mod further;
mod model;
mod user;

use cellpos_plant::{
    Chain, Complex, Effect, Hertz, Model, SimulateOptions, TransferFunction, effects, simulate,
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

fn play(thresholds_um: Vec<f64>, weights: Vec<f64>, quadratic_per_um: f64) -> Effect {
    effects::play(&thresholds_um, &weights, quadratic_per_um)
}

fn bouc_wen(explicit: bool) -> Effect {
    if explicit {
        effects::bouc_wen_explicit(0.3, 0.9, 0.2)
    } else {
        effects::bouc_wen(0.3, 0.9, 0.2)
    }
}
