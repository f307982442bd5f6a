//! The predictor and the program's simulator take the same equations in another order: one property over the whole table
//! of effects holds them together.

use super::catalogue::{Variant, variants};
use crate::simulate::{Base, Input, Sampling, simulate};
use cellpos_plant::effects::{self, Action, Definition, Scope};
use cellpos_plant::{Model, SimulateOptions, Zpk};

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

const SCOPE: Scope = Scope {
    working_point_um: 4.0,
    low_um: 2.0,
    high_um: 6.0,
    stroke_um: 2.0,
    travel_um: 20.0,
    sample_s: 1e-3,
    length_s: 6.0,
    sampled_input: false,
    per_unit: [1.0, 1.0],
};

fn predicted(model: &Model, pzt_um: &[f64]) -> Vec<f64> {
    carried(model, pzt_um, &[])
}

/// With the flows that act next to the displacement.
fn carried(model: &Model, pzt_um: &[f64], flow_um: &[f64]) -> Vec<f64> {
    let base = Base {
        zpk: Zpk::of(&model.plant),
        working_point_um: 4.0,
        sample_s: 1e-3,
        interpolated_input: false,
        free_start: false,
        free_working_point: false,
        frame_age_s: None,
    };
    let u: Vec<f64> = pzt_um.iter().map(|v| v - 4.0).collect();
    let mut y = Vec::new();
    let sampling = Sampling::default();
    let input = Input {
        flow_um,
        ..Input::new(&u, &sampling)
    };
    simulate(&base, input, &model.effects, &mut y, None);
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
fn the_predictor_and_the_simulator_of_the_program_agree_on_every_effect_that_is_looked_for() {
    let u = command_um();
    let bare = simulated(&Model::eq6(), &u);
    let own = apart_um(&predicted(&Model::eq6(), &u), &bare);
    assert!(own < 1e-6, "Eq. (6) alone: {own} um apart");
    let bad = apart(&variants(&[]), &u, &bare, 1e-3);
    assert!(bad.is_empty(), "{}", bad.join("\n"));
}

/// The starts of all variants at which predictor and simulator differ by more than this share of the effect's size (at least 10 nm).
fn apart(variants: &[Variant], u: &[f64], bare: &[f64], part: f64) -> Vec<String> {
    let mut bad = Vec::new();
    for variant in variants {
        for start in variant.starts(&SCOPE) {
            let effect = start.effect(&SCOPE);
            if matches!(effect.act(), Action::Show(_)) {
                continue;
            }
            let model = Model::eq6().with_effect(effect.clone());
            let truth = simulated(&model, u);
            let size = apart_um(&truth, bare);
            let error = apart_um(&predicted(&model, u), &truth);
            if error > part * size.max(0.01) {
                bad.push(format!(
                    "{effect:?}: {error:.2e} um of an effect of {size:.2e} um"
                ));
            }
        }
    }
    bad
}

/// An effect of a user's own at every place, with memory, states, time and feedback.
const OWN: &str = r#"
[[effects]]
id = "agree-curve"
place = "driver"
says = "a driver that bends"
output = "input + bend*input^2"
[effects.parameters]
bend = { unit = "1/um", lower = -1.0, upper = 1.0, start = [0.02, -0.1] }

[[effects]]
id = "agree-play"
place = "pzt"
says = "a coupling with play"
output = "max(input - half, min(input + half, output))"
[effects.parameters]
half = { unit = "um", lower = 0.001, upper = 1.0, start = [0.01, 0.1] }

[[effects]]
id = "agree-spring"
place = "chip"
says = "a force that grows with the position"
output = "input - spring*position - cubic*position^3"
[effects.parameters]
spring = { unit = "1", lower = -1.0, upper = 1.0, start = 0.002 }
cubic = { unit = "1/um^2", lower = -1.0, upper = 1.0, start = 1e-5 }

[[effects]]
id = "agree-swell"
place = "plant"
says = "a position that takes its time"
output = "position - late"
[effects.states]
late = { rate = "(share*position - late)/lag", start = "0" }
[effects.parameters]
share = { unit = "", lower = 0.0, upper = 1.0, start = [0.05, 0.3] }
lag = { unit = "s", lower = 0.01, upper = 10.0, start = 0.2 }

[[effects]]
id = "agree-level"
place = "plant"
says = "a level that is there from the start"
output = "level"
[effects.states]
level = { rate = "filling*input - drain*sqrt(max(level, 0))", start = "begin" }
[effects.parameters]
filling = { unit = "1/s", lower = 0.0, upper = 10.0, start = 0.1 }
drain = { unit = "um/s", lower = 0.0, upper = 10.0, start = 0.5 }
begin = { unit = "um", lower = 0.0, upper = 10.0, start = [3.0, 8.0] }

[[effects]]
id = "agree-tire"
place = "bead"
says = "a bead that follows less and less"
output = "input*(1 - fade*time)"
[effects.parameters]
fade = { unit = "1/s", lower = -0.1, upper = 0.1, start = [0.003, 0.03] }

[[effects]]
id = "agree-lens"
place = "camera"
says = "an image that bends"
output = "input + bend*input^3"
[effects.parameters]
bend = { unit = "1/um^2", lower = -0.01, upper = 0.01, start = 1e-5 }
"#;

#[test]
fn the_two_agree_on_effects_of_a_user_s_own_at_every_place() {
    let defined = Definition::from_toml_str(OWN, "own.toml").unwrap_or_else(|e| panic!("{e}"));
    assert_eq!(defined.len(), 7);
    let own: Vec<&str> = OWN
        .lines()
        .filter_map(|l| l.strip_prefix("id = \"")?.strip_suffix('"'))
        .collect();
    let of_file: Vec<Variant> = variants(&own).into_iter().filter(|v| v.is_own()).collect();
    assert_eq!(of_file.len(), own.len());
    let u = command_um();
    let bare = simulated(&Model::eq6(), &u);
    // Equations that both take in steps, and not at the same instants.
    let bad = apart(&of_file, &u, &bare, 1e-2);
    assert!(bad.is_empty(), "{}", bad.join("\n"));

    // What does not begin at 0 is seen from the first row on, whatever the frames do.
    let level = of_file.iter().find(|v| v.id() == "agree-level").unwrap();
    let level = level.starts(&SCOPE)[0].effect(&SCOPE);
    for further in [
        None,
        Some(effects::time_delay(0.0025)),
        Some(effects::exposure_averaging(0.0007)),
        Some(effects::gain_error(1.1)),
    ] {
        let mut model = Model::eq6().with_effect(level.clone());
        let factor = further.as_ref().and_then(|e| e.get("factor"));
        model.effects.extend(further);
        for y in [predicted(&model, &u), simulated(&model, &u)] {
            let shown = 3.0 * factor.unwrap_or(1.0);
            let off: Vec<f64> = y[..4].iter().map(|y| (y - shown).abs()).collect();
            assert!(off.iter().all(|off| *off < 0.02), "{model:?}: {off:?}");
        }
    }
}

#[test]
fn what_a_bead_does_of_its_own_it_does_with_the_flow_that_carries_it() {
    let u = command_um();
    // 0.2 um of further flow: 80 um/s, enough to free a bead that sticks.
    let flow_um = vec![0.2; ROWS];
    let of_flow = predicted(&Model::eq6(), &vec![4.2; ROWS]);
    for effect in [
        effects::wall_adhesion(40.0),
        effects::gain_drift(-0.05),
        effects::valve_asymmetry(0.05),
    ] {
        let model = Model::eq6().with_effect(effect);
        let mut chain = cellpos_plant::Chain::new(&model).unwrap_or_else(|e| panic!("{e}"));
        chain.set_beside_um(0.2);
        let truth: Vec<f64> = (u.iter())
            .map(|u| {
                let at = chain.bead_um();
                chain.advance(*u, 1e-3);
                at
            })
            .collect();
        // The motion that the plant alone makes of the flow is left to the noise.
        let whole: Vec<f64> = (carried(&model, &u, &flow_um).iter().zip(&of_flow))
            .map(|(y, flow)| y + flow)
            .collect();
        let (with, without) = (
            apart_um(&whole, &truth),
            apart_um(&predicted(&model, &u), &truth),
        );
        assert!(with < 0.01 && without > 1.0, "{model:?}: {with} {without}");
    }
}

#[test]
fn a_delay_goes_through_whole_frames_without_a_cliff() {
    let u = command_um();
    let at = |delay_s: f64| predicted(&Model::eq6().with_effect(effects::time_delay(delay_s)), &u);
    let whole = at(0.002);
    for off_s in [1e-12, 1e-10, 1e-8, 1e-6] {
        for delay_s in [0.002 - off_s, 0.002 + off_s] {
            // The bead moves at up to some 400 um/s per um of displacement.
            let apart = apart_um(&at(delay_s), &whole);
            assert!(apart < 1000.0 * off_s + 1e-9, "{delay_s} s: {apart} um");
        }
    }
}
