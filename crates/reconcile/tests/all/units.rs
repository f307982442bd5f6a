//! What is said of records must not depend on the units that they are in.

use cellpos_numeric::Random;
use cellpos_plant::effects::{self, Place};
use cellpos_plant::{Effect, Model, Noise, SimulateOptions, TransferFunction, simulate};
use cellpos_reconcile::{Options, Reconciliation, Record, Units, Verdict, reconcile};

const STEP_S: f64 = 1e-2;

/// A lag of 0.2 s that turns volts into something of about the same size.
fn plant() -> Model {
    Model {
        name: "lag".to_owned(),
        plant: TransferFunction::new(vec![3.0], vec![0.2, 1.0]).unwrap(),
        working_point_um: 1.0,
        noise: Noise {
            diffusion_um2_per_s: 0.0,
            localisation_um: 0.02,
        },
        ..Model::eq6()
    }
}

/// The same plant where the numbers of input and output are so many times larger.
fn times(input: f64, output: f64) -> Model {
    let plant = plant();
    Model {
        plant: plant.plant.scaled(output / input).unwrap(),
        working_point_um: input * plant.working_point_um,
        noise: Noise {
            localisation_um: output * plant.noise.localisation_um,
            ..plant.noise
        },
        ..plant
    }
}

/// Two records of held levels about the working point, with what is hidden.
fn records(hidden: Effect, [input, output]: [f64; 2]) -> Vec<Record> {
    let model = plant().with_effect(hidden);
    (0..2)
        .map(|seed| {
            let mut random = Random::new(seed);
            let mut u = Vec::new();
            while u.len() < 1500 {
                u.extend(std::iter::repeat_n(1.0 + random.normal(), 25));
            }
            let options = SimulateOptions {
                seed: Some(seed + 7),
                ..SimulateOptions::default()
            };
            let y = simulate(&model, &u, STEP_S, &options).unwrap();
            let t: Vec<f64> = (0..u.len()).map(|k| k as f64 * STEP_S).collect();
            let of = |values: &[f64], factor: f64| -> Vec<f64> {
                values.iter().map(|v| v * factor).collect()
            };
            Record::from_rows(&format!("r{seed}"), &t, &of(&u, input), &of(&y, output)).unwrap()
        })
        .collect()
}

fn look(hidden: &Effect, [input, output]: [f64; 2]) -> Reconciliation {
    let options = Options {
        free_start: true,
        max_effects: 2,
        units: Units {
            input: "V".to_owned(),
            output: "rpm".to_owned(),
        },
        ..Options::default()
    };
    let records = records(hidden.clone(), [input, output]);
    reconcile(&times(input, output), &records, &options, &mut |_| {}).unwrap()
}

fn near(a: f64, b: f64) -> bool {
    (a - b).abs() <= 1e-4 * a.abs().max(b.abs())
}

/// The power of the length in a unit of this test.
fn power(unit: &str) -> i32 {
    match unit {
        "V" | "rpm" | "rpm/s" => 1,
        "1/V^2" => -2,
        _ => 0,
    }
}

fn same_but_for_units(hidden: &Effect, one: &Reconciliation, scale: [f64; 2]) {
    let other = look(hidden, scale);
    let [_, output] = scale;
    assert_eq!(one.verdict, other.verdict, "{scale:?}: {:?}", other.places);
    assert!(near(output * one.gap.before, other.gap.before), "{scale:?}");
    assert!(near(output * one.gap.after, other.gap.after), "{scale:?}");
    assert_eq!(other.gap.unit, "rpm");
    // The file that is written is read and simulated, however large its numbers are.
    let text = other.augmented.to_toml_string();
    let read = Model::from_toml_str(&text, "augmented.toml").unwrap();
    assert_eq!(read, other.augmented, "{scale:?}");
    simulate(&read, &[scale[0]; 3], STEP_S, &SimulateOptions::default()).unwrap();
    let ids =
        |r: &Reconciliation| -> Vec<String> { r.effects.iter().map(|e| e.id.clone()).collect() };
    assert_eq!(ids(one), ids(&other), "{scale:?}");
    for (a, b) in one.effects.iter().zip(&other.effects) {
        for (name, p) in &a.parameters {
            let q = &b.parameters[name];
            assert_eq!(p.unit, q.unit);
            let of_input = effects::find(&a.id)
                .is_some_and(|k| k.spec().place <= Place::Pzt || k.spec().ahead_of_plant);
            let factor = scale[usize::from(!of_input)].powi(power(&p.unit));
            assert!(
                near(factor * p.value, q.value),
                "{name} of {} at {scale:?}: {} and {} {}",
                a.id,
                p.value,
                q.value,
                q.unit
            );
            // What goes into the model is what is told.
            let written = other.augmented.effect(&b.id).and_then(|e| e.get(name));
            if let Some(written) = written {
                assert!(near(written, q.value), "{written} {}", q.value);
            }
        }
    }
}

#[test]
fn a_record_times_a_thousand_is_the_same_record() {
    let hidden = effects::saturation(-0.2, 2.2);
    let one = look(&hidden, [1.0, 1.0]);
    assert!(
        matches!(one.verdict, Verdict::Named | Verdict::NamedWithRemainder),
        "{:?} {:?}",
        one.verdict,
        one.places
    );
    assert_eq!(one.effects[0].id, "saturation");
    let high = &one.effects[0].parameters["high_um"];
    assert_eq!(high.unit, "V");
    assert!((high.value - 2.2).abs() < 0.02, "{high:?}");
    for scale in [[1e3, 1.0], [1.0, 1e-3], [1e-3, 1e3], [1e9, 1e9]] {
        same_but_for_units(&hidden, &one, scale);
    }
}

#[test]
fn play_of_millivolts_is_play_of_volts() {
    let hidden = effects::backlash(0.4);
    let one = look(&hidden, [1.0, 1.0]);
    assert_eq!(one.effects.len(), 1, "{:?}", one.places);
    assert_eq!(one.effects[0].id, "backlash");
    for scale in [[1e-3, 1.0], [1e-9, 1e-12], [1e6, 1e-6]] {
        same_but_for_units(&hidden, &one, scale);
    }
}

#[test]
fn a_slow_plant_may_be_later_than_a_fast_one() {
    // A heater of 60 s, a row a second, 35 s later than its model says.
    let heater = Model {
        plant: TransferFunction::new(vec![2.0], vec![60.0, 1.0]).unwrap(),
        working_point_um: 50.0,
        noise: Noise {
            diffusion_um2_per_s: 0.0,
            localisation_um: 0.1,
        },
        ..plant()
    };
    let mut random = Random::new(3);
    let mut u = Vec::new();
    while u.len() < 2400 {
        u.extend(std::iter::repeat_n(50.0 + 20.0 * random.normal(), 80));
    }
    let hidden = heater.clone().with_effect(effects::time_delay(35.0));
    let options = SimulateOptions {
        seed: Some(4),
        ..SimulateOptions::default()
    };
    let y = simulate(&hidden, &u, 1.0, &options).unwrap();
    let t: Vec<f64> = (0..u.len()).map(|k| k as f64).collect();
    let record = Record::from_rows("heater", &t, &u, &y).unwrap();
    let options = Options {
        free_start: true,
        ..Options::default()
    };
    let found = reconcile(&heater, &[record], &options, &mut |_| {}).unwrap();
    let ids: Vec<&str> = found.effects.iter().map(|e| e.id.as_str()).collect();
    assert_eq!(
        ids,
        ["time-delay"],
        "{:?} {:?}",
        found.verdict,
        found.places
    );
    let delay = &found.effects[0].parameters["delay_s"];
    assert!((delay.value - 35.0).abs() < 0.5, "{delay:?}");
}
