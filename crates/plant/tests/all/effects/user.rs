//! Effects of the user's own: the same numbers as those of the catalogue and of the equations they write down, through
//! every command that runs a model.

use super::{relative_response, run, sine, unity};
use cellpos_plant::effects::{self, Definition};
use cellpos_plant::{Effect, Hertz, Model, TransferFunction};
use std::f64::consts::TAU;

/// Makes the one effect of a text known.
fn define(text: &str) {
    if let Err(e) = Definition::from_toml_str(text, "test.toml") {
        panic!("{e}");
    }
}

fn effect(id: &str, parameters: &[(&str, f64)]) -> Effect {
    Effect::of(id, parameters).unwrap()
}

fn apart(a: &[f64], b: &[f64]) -> f64 {
    a.iter()
        .zip(b)
        .map(|(a, b)| (a - b).abs())
        .fold(0.0, f64::max)
}

fn size(a: &[f64]) -> f64 {
    a.iter().fold(0.0, |m: f64, x| m.max(x.abs()))
}

#[test]
fn a_play_written_down_is_backlash() {
    define(
        r#"
[[effects]]
id = "own-play"
place = "pzt"
output = "max(input - width/2, min(input + width/2, output))"
[effects.parameters]
width = { unit = "um", lower = 0.0, upper = 5.0, start = 0.1 }
"#,
    );
    let u: Vec<f64> = sine(3.0, 1.0, 1e-3, 2000);
    let own = run(
        &unity().with_effect(effect("own-play", &[("width", 0.3)])),
        &u,
        1e-3,
    );
    let of_catalogue = run(&unity().with_effect(effects::backlash(0.3)), &u, 1e-3);
    assert!(
        apart(&own, &of_catalogue) < 1e-12,
        "{}",
        apart(&own, &of_catalogue)
    );
}

#[test]
fn a_lag_written_down_as_a_state_is_the_lag_of_the_driver_wherever_it_is() {
    for (place, step) in [("chip", "step_s = 1e-4"), ("driver", ""), ("pzt", "")] {
        define(&format!(
            r#"
[[effects]]
id = "own-lag-{place}"
place = "{place}"
output = "reached"
{step}
[effects.states]
reached = {{ rate = "(input - reached)/lag", start = "0" }}
[effects.parameters]
lag = {{ unit = "s", lower = 1e-4, upper = 1.0, start = 0.01 }}
"#
        ));
        for bandwidth_hz in [20.0, 200.0] {
            let lag_s = 1.0 / (TAU * bandwidth_hz);
            let u: Vec<f64> = sine(3.0, 0.05 * bandwidth_hz, 1e-3, 2000)
                .iter()
                .map(|u| 4.0 + u)
                .collect();
            let own = effect(&format!("own-lag-{place}"), &[("lag", lag_s)]);
            let own = run(&Model::eq6().with_effect(own), &u, 1e-3);
            let lag = effects::driver_lag(bandwidth_hz);
            let of_catalogue = run(&Model::eq6().with_effect(lag), &u, 1e-3);
            let (apart, size) = (apart(&own, &of_catalogue), size(&of_catalogue));
            assert!(
                apart < 1e-3 * size,
                "{place}, {bandwidth_hz} Hz: {apart} of {size}"
            );
        }
    }
}

/// The Duffing equation `y'' + 20 y' + 400 y + 400 c y^3 = 400 u` by Runge and Kutta.
fn duffing(c: f64, u: &[f64], sample_s: f64) -> Vec<f64> {
    const STEPS: usize = 50;
    let h = sample_s / STEPS as f64;
    let rate = |y: f64, v: f64, u: f64| (v, 400.0 * u - 20.0 * v - 400.0 * (y + c * y * y * y));
    let (mut y, mut v) = (0.0, 0.0);
    let mut out = Vec::with_capacity(u.len());
    for &u in u {
        out.push(y);
        for _ in 0..STEPS {
            let a = rate(y, v, u);
            let b = rate(y + 0.5 * h * a.0, v + 0.5 * h * a.1, u);
            let d = rate(y + 0.5 * h * b.0, v + 0.5 * h * b.1, u);
            let e = rate(y + h * d.0, v + h * d.1, u);
            y += h / 6.0 * (a.0 + 2.0 * b.0 + 2.0 * d.0 + e.0);
            v += h / 6.0 * (a.1 + 2.0 * b.1 + 2.0 * d.1 + e.1);
        }
    }
    out
}

/// A plant of second order, 20 rad/s, about zero.
fn second_order() -> Model {
    Model {
        name: "second order".to_owned(),
        plant: TransferFunction::new(vec![400.0], vec![1.0, 20.0, 400.0]).unwrap(),
        ..unity()
    }
}

#[test]
fn a_cubic_spring_fed_back_into_the_plant_is_the_equation_of_duffing() {
    define(
        r#"
[[effects]]
id = "own-spring"
place = "chip"
says = "a spring that hardens with the position"
output = "input - cubic*position^3 - softer*position"
[effects.parameters]
cubic = { unit = "1/um^2", lower = -10.0, upper = 10.0, start = 0.1 }
softer = { unit = "1", lower = -1.0, upper = 1.0, start = 0.0 }
"#,
    );
    let u: Vec<f64> = sine(1.0, 1.5, 1e-3, 4000);
    let spring = effect("own-spring", &[("cubic", 0.8), ("softer", 0.0)]);
    let own = run(&second_order().with_effect(spring), &u, 1e-3);
    let truth = duffing(0.8, &u, 1e-3);
    let linear = run(&second_order(), &u, 1e-3);
    assert!(apart(&linear, &truth) > 0.1, "the spring does nothing here");
    assert!(apart(&own, &truth) < 1e-3, "{} um", apart(&own, &truth));

    // Small motions: P/(1 + P k), in the formula and in the simulation.
    let softer =
        second_order().with_effect(effect("own-spring", &[("cubic", 0.0), ("softer", 0.5)]));
    let closed = Model {
        plant: TransferFunction::new(vec![400.0], vec![1.0, 20.0, 600.0]).unwrap(),
        ..second_order()
    };
    for hz in [0.5, 3.0, 20.0] {
        let (a, b) = (
            softer.linear_response(Hertz(hz)),
            closed.linear_response(Hertz(hz)),
        );
        assert!((a - b).norm() < 1e-9 * b.norm(), "{hz} Hz: {a} and {b}");
    }
    let ratio = relative_response(&softer, 3.0, 0.5);
    let wanted = closed.linear_response(Hertz(3.0)) / second_order().linear_response(Hertz(3.0));
    assert!((ratio - wanted).norm() < 2e-3, "{ratio} and {wanted}");
}

#[test]
fn equations_in_the_stead_of_the_plant_are_those_that_are_written() {
    define(
        r#"
[[effects]]
id = "own-plant"
place = "plant"
output = "y"
step_s = 2e-4
[effects.states]
v = { rate = "400*input - 20*v - 400*(y + cubic*y^3)", start = "0" }
y = { rate = "v" }
[effects.parameters]
cubic = { unit = "1/um^2", lower = -10.0, upper = 10.0, start = 0.1 }
"#,
    );
    let u: Vec<f64> = sine(1.0, 1.5, 1e-3, 4000);
    let own = run(
        &second_order().with_effect(effect("own-plant", &[("cubic", 0.8)])),
        &u,
        1e-3,
    );
    let truth = duffing(0.8, &u, 1e-3);
    assert!(apart(&own, &truth) < 1e-3, "{} um", apart(&own, &truth));
    let linear = second_order().with_effect(effect("own-plant", &[("cubic", 0.0)]));
    for hz in [0.5, 3.0, 20.0] {
        let (a, b) = (
            linear.linear_response(Hertz(hz)),
            second_order().linear_response(Hertz(hz)),
        );
        assert!((a - b).norm() < 1e-6 * b.norm(), "{hz} Hz: {a} and {b}");
    }
}

#[test]
fn a_rectifier_at_the_camera_and_friction_at_the_bead_act_where_they_stand() {
    define(
        r#"
[[effects]]
id = "own-rectifier"
place = "camera"
output = "gain*abs(input)"
[effects.parameters]
gain = { unit = "", lower = 0.1, upper = 10.0, start = 1.0 }

[[effects]]
id = "own-image"
place = "bead"
output = "position + late*velocity"
[effects.parameters]
late = { unit = "s", lower = -0.1, upper = 0.1, start = 0.0 }
"#,
    );
    let u: Vec<f64> = sine(2.0, 1.0, 1e-3, 1000);
    let plain = run(&second_order(), &u, 1e-3);
    let own = run(
        &second_order().with_effect(effect("own-rectifier", &[("gain", 2.0)])),
        &u,
        1e-3,
    );
    let by_hand: Vec<f64> = plain.iter().map(|y| 2.0 * y.abs()).collect();
    assert!(apart(&own, &by_hand) < 1e-12);
    let late = run(
        &second_order().with_effect(effect("own-image", &[("late", 0.01)])),
        &u,
        1e-3,
    );
    let slope: Vec<f64> = (1..999)
        .map(|k| plain[k] + 0.01 * (plain[k + 1] - plain[k - 1]) / 2e-3)
        .collect();
    assert!(
        apart(&late[1..999], &slope) < 2e-3,
        "{}",
        apart(&late[1..999], &slope)
    );
}

#[test]
fn a_model_with_an_effect_of_the_users_own_reads_back_to_the_bit() {
    define(
        r#"
[[effects]]
id = "own-creep"
place = "plant"
says = "what \"comes\" late"
output = "position + part*late"
step_s = 0.001
[effects.states]
late = { rate = "(position - late)/time_s", start = "part" }
[effects.parameters]
part = { unit = "", lower = 0.0, upper = 1.0, start = [0.1, 0.3] }
time_s = { unit = "s", lower = 0.01, upper = 100.0, start = 1.0 }
"#,
    );
    let model = Model::eq6().with_effect(effect("own-creep", &[("part", 0.1), ("time_s", 2.5)]));
    let text = model.to_toml_string();
    assert_eq!(text.matches("[[definitions]]").count(), 1, "{text}");
    let back = Model::from_toml_str(&text, "again.toml").unwrap();
    assert_eq!(back, model);
    assert_eq!(back.to_toml_string(), text);
    let definition = back.effects[0].kind().definition().unwrap();
    assert_eq!(definition.says, "what \"comes\" late");
    assert_eq!(definition.states[0].rate, "(position - late)/time_s");
}

#[test]
fn a_wrong_definition_is_told_with_line_key_value_and_what_would_be_right() {
    let good = r#"[[effects]]
id = "own-wrong"
place = "chip"
output = "input - cubic*position^3"
[effects.parameters]
cubic = { unit = "1/um^2", lower = -1.0, upper = 1.0, start = 0.1 }
"#;
    let words = |from: &str, to: &str| {
        let text = good.replace(from, to);
        assert_ne!(text, good);
        match Definition::from_toml_str(&text, "own.toml") {
            Ok(_) => panic!("{to} is taken"),
            Err(e) => e.to_string(),
        }
    };
    let e = words("cubic*position", "cubic*positon");
    assert!(
        e.starts_with("own.toml:4:")
            && e.contains("effects[0].output")
            && e.contains("did you mean `position`?"),
        "{e}"
    );
    let e = words("\"chip\"", "\"cip\"");
    assert!(
        e.starts_with("own.toml:3:") && e.contains("did you mean `chip`?"),
        "{e}"
    );
    let e = words("\"chip\"", "\"driver\"");
    assert!(
        e.starts_with("own.toml:4:") && e.contains("`position` is not known at the driver"),
        "{e}"
    );
    let e = words("start = 0.1", "start = 3.0");
    assert!(
        e.starts_with("own.toml:6:")
            && e.contains("effects[0].parameters.cubic.start")
            && e.contains("3 lies outside of -1 .. 1"),
        "{e}"
    );
    let e = words("upper = 1.0", "upper = -2.0");
    assert!(e.contains("the lower one below the upper one"), "{e}");
    let e = words("\"own-wrong\"", "\"backlash\"");
    assert!(
        e.starts_with("own.toml:2:") && e.contains("effect of the catalogue"),
        "{e}"
    );
    let e = words("cubic = {", "input = {");
    assert!(e.contains("has a meaning already"), "{e}");
    let e = words("place = \"chip\"\n", "");
    assert!(e.contains("`effects[0].place` is missing"), "{e}");
    let e = words("start = 0.1", "strat = 0.1");
    assert!(e.contains("did you mean `start`?"), "{e}");
    let e = words("position^3\"", "position^3");
    assert!(e.starts_with("own.toml:4:"), "{e}");
    let e = words("input - cubic*position^3", "-position^2 + cubic");
    assert!(e.contains("two ways"), "{e}");
}
