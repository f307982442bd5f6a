//! A step of the loop allocates nothing, shown by an allocator that counts.

use cellpos_counting_alloc::allocations_of;
use cellpos_plant::{
    Chain, DiscretePlant, Effect, Model, Seconds, Simulator, TransferFunction, effects,
};

fn everything() -> Model {
    let mut model = Model::load(concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../../examples/model.toml"
    ))
    .unwrap();
    for effect in [
        effects::play(&[0.0, 0.1], &[0.9, 0.1], 0.0),
        effects::pzt_resonance(900.0, 0.05),
        effects::backlash(0.05),
        effects::bubble(1e-3, 0.01),
        effects::gain_drift(1e-3),
        effects::wall_adhesion(20.0),
        effects::mains_hum(50.0, 0.1, 0.0),
    ] {
        model = model.with_effect(effect);
    }
    model
}

/// Effects of the user's own: fed back into the plant with a state, and at the bead.
fn written_down() -> Model {
    let text = r#"
[[effects]]
id = "counted-spring"
place = "chip"
output = "input - cubic*position^3 - sqrt(abs(late))"
[effects.states]
late = { rate = "velocity - late", start = "cubic" }
[effects.parameters]
cubic = { unit = "1/um^2", lower = -10.0, upper = 10.0, start = 0.1 }

[[effects]]
id = "counted-friction"
place = "bead"
output = "max(input - r, min(input + r, output)) + 0*velocity"
[effects.parameters]
r = { unit = "um", lower = 0.0, upper = 10.0, start = 0.1 }
"#;
    let mut model = Model::eq6();
    for kind in effects::Definition::from_toml_str(text, "counted.toml").unwrap() {
        let name = kind.spec().forms[0].scalars[0].name;
        model = model.with_effect(Effect::of_kind(kind, &[(name, 0.1)]).unwrap());
    }
    model
}

#[test]
fn the_counter_counts() {
    assert_eq!(allocations_of(|| drop(std::hint::black_box(vec![1_u8]))), 1);
}

#[test]
fn no_step_allocates_whatever_its_length_and_the_effects() {
    for model in [everything(), written_down()] {
        assert_eq!(allocated(&model), 0);
    }
}

fn allocated(model: &Model) -> u64 {
    let mut chain = Chain::with_brownian_motion(model, 1).unwrap();
    let mut simulator = Simulator::new(model, 1e-3, Some(1)).unwrap();
    let plant =
        DiscretePlant::new(&TransferFunction::eq6(), Seconds(1e-3), Seconds(2.5e-3)).unwrap();
    let mut state = plant.state(0.0);
    allocations_of(|| {
        for k in 0..200 {
            let command = 4.0 + f64::from(k % 13) * 0.3;
            chain.advance(command, 1e-3 + 1e-6 * f64::from(k % 7));
            std::hint::black_box((chain.bead_um(), chain.pzt_um(), chain.flow_um_per_s()));
            std::hint::black_box(simulator.measure());
            simulator.hold(command);
            plant.step(&mut state, command);
            std::hint::black_box(plant.output_um(&state));
        }
    })
}
