//! A board's output has steps, and where in a step commands come wanders from line to line: no effect of the plant.

use crate::common::{PERIOD_S, measured};
use cellpos_ident::candidate_model::CandidateModel;
use cellpos_ident::excitation::{ExcitationLimits, PAPER_FREQUENCIES_HZ};
use cellpos_ident::experiment::Measured;
use cellpos_ident::sampled::Sampling;
use cellpos_ident::summary::{Identification, summarise};
use cellpos_numeric::Random;
use cellpos_plant::Complex;

fn of_seed(seed: u64) -> Measured {
    let limits = ExcitationLimits {
        bead_um_per_s: 400.0,
        bead_um: 3.0,
        pzt_um: 2.0,
        slew_um_per_s: 40_000.0,
    };
    measured(&PAPER_FREQUENCIES_HZ, limits, seed)
}

fn result(measured: Measured) -> Identification {
    let sampling = Sampling::held(1.0 / PERIOD_S);
    summarise(measured, sampling, None, 0, 1, None, false).unwrap()
}

fn holds_more_than_eq4(result: &Identification) -> bool {
    result
        .warnings
        .iter()
        .any(|w| w.contains("times the noise"))
}

/// The effective delay's truth and interval, ms.
fn delay(result: &Identification) -> (f64, [f64; 2]) {
    let truth = CandidateModel::eq6(0.002);
    let of = result.judged.parameter("effective_delay_ms").unwrap();
    ((truth.delay_s - truth.far_lead_s) * 1e3, of.ci95)
}

#[test]
fn delays_that_stray_within_a_step_of_the_output_widen_the_phase_and_are_no_effect_of_the_plant() {
    let (mut held, mut said) = (0, 0);
    const SEEDS: u64 = 20;
    for seed in 0..SEEDS {
        let mut measured = of_seed(500 + seed);
        let mut random = Random::new(seed);
        for p in &mut measured.points {
            let later_s = 1e-4 * (random.uniform() - 0.5);
            let angle = -std::f64::consts::TAU * p.frequency_hz * later_s;
            p.response *= Complex::from_polar(1.0, angle);
        }
        let result = result(measured);
        let (truth, [low, high]) = delay(&result);
        held += u64::from((low..=high).contains(&truth));
        said += u64::from(holds_more_than_eq4(&result));
    }
    println!("{held} of {SEEDS} intervals hold the delay; {said} say that the plant holds more");
    assert!(held >= 17 && said <= 2, "{held} {said}");
}

#[test]
fn a_delay_that_varies_by_more_than_a_step_is_named_as_a_cause() {
    let mut measured = of_seed(78);
    for (n, p) in measured.points.iter_mut().enumerate() {
        let later_s = if n % 2 == 0 { 3e-4 } else { -3e-4 };
        let angle = -std::f64::consts::TAU * p.frequency_hz * later_s;
        p.response *= Complex::from_polar(1.0, angle);
    }
    let warnings = result(measured).warnings;
    let said = warnings.iter().find(|w| w.contains("times the noise"));
    assert!(
        said.is_some_and(|w| w.contains("the delay varied")),
        "{warnings:?}"
    );
}

#[test]
fn a_resonance_is_more_than_delays_that_stray() {
    let mut measured = of_seed(77);
    // 250 Hz, damping 0.1: at 200 Hz three decibels too much and 25 degrees too late.
    for p in &mut measured.points {
        let r = p.frequency_hz / 250.0;
        p.response /= Complex::new(1.0 - r * r, 0.2 * r);
    }
    assert!(holds_more_than_eq4(&result(measured)));
}

#[test]
fn on_a_plant_whose_delay_stays_nothing_changes() {
    let (mut width, mut said) = (0.0, 0);
    for seed in 0..10 {
        let result = result(of_seed(900 + seed));
        let (_, [low, high]) = delay(&result);
        width += 0.1 * (high - low);
        said += usize::from(holds_more_than_eq4(&result));
    }
    println!("{width:.4} ms wide; {said} of 10 say that the plant holds more");
    assert!(width < 0.015 && said == 0, "{width} {said}");
}
