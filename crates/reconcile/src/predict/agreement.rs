//! The fast predictor and the program's simulator are two programs of the same equations.

use super::{Base, simulate};
use crate::augment::{exponential_play, place_of};
use crate::catalogue::{Scope, block_of};
use crate::predict::Zpk;
use cellpos_plant::{Effect, Hysteresis, Model, SimulateOptions};

const ROWS: usize = 6000;

/// A command with slow and fast parts about 4 um.
fn command_um() -> Vec<f64> {
    (0..ROWS)
        .map(|k| {
            let t = k as f64 * 1e-3;
            let sine = |hz: f64| (std::f64::consts::TAU * hz * t).sin();
            let wave =
                4.0 + 0.8 * sine(1.7) + 0.5 * sine(11.0) + 0.3 * sine(43.0) + 0.2 * sine(131.0);
            if k < 20 {
                4.0
            } else {
                (wave * 1e4).round() / 1e4
            }
        })
        .collect()
}

fn predicted(model: &Model, pzt_um: &[f64]) -> Vec<f64> {
    let zpk = Zpk {
        zeros: model.plant.zeros(),
        poles: model.plant.poles(),
        gain: model.plant.num()[0] / model.plant.den()[0],
    };
    let base = Base {
        zpk,
        working_point_um: 4.0,
        sample_s: 1e-3,
        interpolated_input: false,
    };
    let scope = Scope {
        working_point_um: 4.0,
        low_um: 2.0,
        high_um: 6.0,
        stroke_um: 2.0,
        sample_s: 1e-3,
    };
    let mut blocks: Vec<_> = model
        .ordered_effects()
        .into_iter()
        .filter_map(|e| block_of(e, &scope))
        .collect();
    blocks.sort_by_key(super::Block::rank);
    let u: Vec<f64> = pzt_um.iter().map(|v| v - 4.0).collect();
    let mut y = Vec::new();
    simulate(&base, &u, &blocks, &mut y, None);
    y
}

fn simulated(model: &Model, pzt_um: &[f64]) -> Vec<f64> {
    match cellpos_plant::simulate(model, pzt_um, 1e-3, &SimulateOptions::default()) {
        Ok(y) => y,
        Err(e) => panic!("{}: {e}", model.name),
    }
}

/// RMS of the difference, each from its own start \[um\].
fn apart_um(a: &[f64], b: &[f64]) -> f64 {
    let sum: f64 = a
        .iter()
        .zip(b)
        .map(|(x, y)| ((x - a[0]) - (y - b[0])).powi(2))
        .sum();
    (sum / a.len() as f64).sqrt()
}

#[test]
fn the_predictor_and_the_simulator_of_the_program_agree_on_every_effect_of_the_response() {
    let u = command_um();
    let bare = simulated(&Model::eq6(), &u);
    let own = apart_um(&predicted(&Model::eq6(), &u), &bare);
    assert!(own < 1e-6, "Eq. (6) alone: {own} um apart");
    let effects = [
        Effect::Saturation {
            low_um: 2.9,
            high_um: 5.1,
        },
        Effect::SlewLimit {
            rate_um_per_s: 120.0,
        },
        Effect::DriverLag {
            bandwidth_hz: 200.0,
        },
        Effect::PztHysteresis(Hysteresis::BoucWenExplicit {
            fraction: 0.2,
            beta_per_um: 0.8,
            gamma_per_um: 0.2,
        }),
        Effect::PztHysteresis(Hysteresis::Play {
            thresholds_um: crate::predict::PLAY_LEVELS
                .iter()
                .map(|l| l * 2.0)
                .collect(),
            weights: vec![0.7, 0.05, 0.05, 0.05, 0.05, 0.05, 0.05, 0.05],
            quadratic_per_um: 0.0,
        }),
        Effect::PztHysteresis(exponential_play(0.2, 0.7)),
        Effect::PztCreep { per_decade: 0.02 },
        Effect::PztResonance {
            frequency_hz: 300.0,
            damping: 0.1,
        },
        Effect::Backlash { width_um: 0.1 },
        Effect::PdmsRelaxation {
            time_s: 0.2,
            strength: 0.2,
        },
        Effect::Bubble {
            lag_s: 0.005,
            dissolution_per_s: 0.0,
        },
        Effect::Leak {
            corner_rad_per_s: 1.5,
        },
        Effect::GainError { factor: 1.3 },
        Effect::GainDrift { per_s: 0.01 },
        Effect::FlowDrift { um_per_s: 5.0 },
        Effect::WallAdhesion {
            speed_um_per_s: 20.0,
        },
        Effect::TimeDelay { delay_s: 0.0017 },
        Effect::ExposureAveraging { exposure_s: 0.0008 },
        Effect::ClockSkew { ppm: 200.0 },
    ];
    let mut bad = Vec::new();
    for effect in effects {
        let id = effect.id();
        assert!(!place_of(id).is_empty());
        let model = Model::eq6().with_effect(effect);
        let truth = simulated(&model, &u);
        let size = apart_um(&truth, &bare);
        let error = apart_um(&predicted(&model, &u), &truth);
        println!("{id:20} effect {size:9.4} um, predictor {error:10.3e} um");
        if error > 1e-3 * size {
            bad.push(format!(
                "{id}: {error:.2e} um of an effect of {size:.2e} um"
            ));
        }
    }
    assert!(bad.is_empty(), "{}", bad.join("; "));
}

#[test]
fn a_delay_goes_through_whole_frames_without_a_cliff() {
    let u = command_um();
    let at = |delay_s: f64| predicted(&Model::eq6().with_effect(Effect::TimeDelay { delay_s }), &u);
    let whole = at(0.002);
    for off_s in [1e-12, 1e-10, 1e-8, 1e-6] {
        for delay_s in [0.002 - off_s, 0.002 + off_s] {
            // The bead moves at up to some 400 um/s per um of displacement.
            let apart = apart_um(&at(delay_s), &whole);
            assert!(apart < 1000.0 * off_s + 1e-9, "{delay_s} s: {apart} um");
        }
    }
}
