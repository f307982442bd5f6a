use crate::effects::{self, Effect};
use crate::error::ModelProblem;
use crate::model::{Covariance, Model, Noise};
use proptest::prelude::*;

const SMALL: &str = "working_point_um = 4\n[plant]\nnum = [428.0]\nden = [1, 0]\n";

fn problem(text: &str) -> (String, ModelProblem) {
    let error = Model::from_toml_str(text, "m.toml").unwrap_err();
    (error.to_string(), *error.problem)
}

/// One effect of each kind, with numbers that need all their digits.
pub(crate) fn one_of_each() -> Vec<Effect> {
    let x = 1.0 / 3.0;
    vec![
        effects::mains_hum(50.0, 0.1 * x, -71.3),
        effects::saturation(0.0, 40.0),
        effects::slew_limit(1e4 * x),
        effects::driver_lag(200.0 + x),
        effects::bouc_wen(0.3, 0.9, 0.2),
        effects::bouc_wen_explicit(0.3, 0.9, -0.2),
        effects::play(&[0.0, x, 1.0], &[0.7, 0.2, 0.1 * x], -1e-3),
        effects::pzt_creep(0.015),
        effects::pzt_resonance(1234.5, 0.02),
        effects::backlash(0.1),
        effects::pdms_relaxation(0.2, 0.1),
        effects::bubble(1e-3, 1e-2),
        effects::leak(1.5),
        effects::gain_error(1.1),
        effects::gain_drift(-1e-3),
        effects::flow_drift(8.0),
        effects::wall_adhesion(35.0),
        effects::clock_skew(100.0),
        effects::time_delay(2e-3),
        effects::exposure_averaging(9e-4),
        effects::pixel_locking(0.1625, 0.05, 10.0),
        effects::frame_drops(0.01),
        effects::frame_repeats(1e-300),
        effects::stiffening(0.05),
        effects::stiffening_by_square(0.05),
        effects::gain_swing(0.1, 7.0, 30.0),
        effects::valve_asymmetry(0.01),
        effects::stick_slip(40.0, 8.0),
        effects::flow_wander(5.0, 2.0),
        effects::pump_pulsation(2.5, 0.3, 0.4, 12.0),
        effects::jumps(0.2, 0.8),
        effects::camera_shake(80.0, 0.05, 0.02),
        effects::lens_distortion(1e-5, 3.0),
        effects::frame_jitter(3e-4),
    ]
}

fn full() -> Model {
    let mut model = Model::eq6();
    model.name = "a \"quoted\" \\ name".to_owned();
    model.description = "two\nlines, \u{b5}m, '''".to_owned();
    model.effects = one_of_each();
    model.covariance = Some(Covariance {
        parameters: vec!["plant.num[0]".to_owned(), "time-delay.delay_s".to_owned()],
        matrix: vec![vec![1e-7, 1.0 / 3.0], vec![1.0 / 3.0, f64::MIN_POSITIVE]],
    });
    model
        .intervals
        .insert("time-delay.delay_s".to_owned(), [0.0019, 0.0021]);
    model
        .provenance
        .insert("strange key\n".to_owned(), "a\tb".to_owned());
    model
        .provenance
        .insert("command".to_owned(), "cellpos identify".to_owned());
    model
}

#[test]
fn every_effect_is_written_and_read_back_to_the_bit() {
    let model = full();
    let text = model.to_toml_string();
    let back = Model::from_toml_str(&text, "m.toml").unwrap();
    assert_eq!(back, model);
    assert_eq!(back.to_toml_string(), text);
    for id in effects::ids() {
        assert!(
            model.effect(id).is_some(),
            "{id} is not among the effects tested"
        );
    }
}

#[test]
fn whole_numbers_serve_as_numbers_and_missing_noise_means_none() {
    let model = Model::from_toml_str(SMALL, "m.toml").unwrap();
    assert_eq!(model.working_point_um, 4.0);
    assert_eq!(model.noise, crate::Noise::NONE);
    assert!(model.effects.is_empty());
}

#[test]
fn an_unknown_key_is_refused_with_its_place_and_the_nearest_key() {
    let text = format!("{SMALL}\n[[effects]]\nid = \"time-delay\"\ndelay_ms = 2.0\n");
    let (message, problem) = problem(&text);
    assert_eq!(
        message,
        "m.toml:8:1: unknown key `effects[0].delay_ms`: did you mean `delay_s`?"
    );
    assert!(matches!(problem, ModelProblem::UnknownKey { .. }));
}

#[test]
fn an_unknown_effect_is_refused_with_the_nearest_id() {
    let text = format!("{SMALL}[[effects]]\nid = \"time_delays\"\n");
    let (message, _) = problem(&text);
    assert_eq!(
        message,
        "m.toml:6:6: `effects[0].id` = \"time_delays\" is not known: did you mean `time-delay`?"
    );
}

#[test]
fn numbers_that_are_not_finite_or_out_of_range_name_key_value_unit_and_range() {
    for (value, said) in [
        ("nan", "NaN s"),
        ("inf", "inf s"),
        ("-0.002", "-0.002 s"),
        ("4000", "4000 s"),
    ] {
        let text = format!("{SMALL}[[effects]]\nid = \"time-delay\"\ndelay_s = {value}\n");
        let (message, _) = problem(&text);
        assert_eq!(
            message,
            format!(
                "m.toml:7:11: `effects[0].delay_s` = {said}: it must be a finite number in 0..3600 s"
            )
        );
    }
    let (message, _) = problem("working_point_um = 4.0\n[plant]\nnum = [nan]\nden = [1, 0]\n");
    assert_eq!(
        message,
        "m.toml:3:8: `plant.num[0]` = NaN: it must be a finite number"
    );
}

#[test]
fn missing_keys_wrong_types_and_wrong_plants_say_what_to_write() {
    let (message, _) = problem("");
    assert!(message.starts_with("m.toml:1:1: `working_point_um` is missing"));
    let (message, _) = problem("working_point_um = \"4um\"");
    assert_eq!(
        message,
        "m.toml:1:20: `working_point_um` is of type string: a number is wanted"
    );
    let (message, _) = problem("working_point_um = 4\nplant = { num = [1, 2, 3], den = [1, 0] }");
    assert!(
        message.contains("degree 2") && message.contains("m.toml:2"),
        "{message}"
    );
    let (message, _) = problem(&format!(
        "{SMALL}[[effects]]\nid = \"saturation\"\nlow_um = 5\n"
    ));
    assert!(
        message.contains("`effects[0].high_um` is missing"),
        "{message}"
    );
    let text = format!("{SMALL}[[effects]]\nid = \"saturation\"\nlow_um = 5\nhigh_um = 1\n");
    assert!(problem(&text).0.contains("low_um must be below high_um"));
    let text = format!("{SMALL}[noise]\ndiffusion_um2_per_s = -1\n");
    assert!(problem(&text).0.contains("in 0..10000 um^2/s"));
    let text = format!("{SMALL}[covariance]\nparameters = [\"a\"]\nmatrix = [[1, 2]]\n");
    assert!(problem(&text).0.contains("square"));
    assert!(matches!(problem("a = = 1").1, ModelProblem::Syntax { .. }));
}

#[test]
fn a_file_that_is_not_there_is_named() {
    let error = Model::load("no-such-model.toml").unwrap_err();
    assert!(
        error
            .to_string()
            .starts_with("no-such-model.toml: there is no such file")
    );
    assert_eq!(Model::load("eq6").unwrap(), Model::eq6());
}

#[test]
fn the_example_model_loads_and_says_nothing_that_is_not_kept() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../examples/model.toml");
    let model = Model::load(path).unwrap();
    for (a, b) in model.plant.num().iter().zip(Model::eq6().plant.num()) {
        assert!((a / b - 1.0).abs() < 1e-15);
    }
    assert_eq!(model.plant.den(), Model::eq6().plant.den());
    assert!(model.effects.len() >= 5);
    let back = Model::from_toml_str(&model.to_toml_string(), "again").unwrap();
    assert_eq!(back, model);
    crate::simulate(&model, &[4.0, 5.0, 4.0], 1e-3, &Default::default()).unwrap();
}

proptest! {
    #[test]
    fn no_text_makes_the_reader_panic(text in "\\PC{0,200}") {
        let _ = Model::from_toml_str(&text, "m.toml");
    }

    #[test]
    fn no_mutilated_model_makes_the_reader_panic(
        at in 0usize..3000, length in 0usize..60, put in "[\\[\\]=\"'{}.,#\na-z0-9_-]{0,12}"
    ) {
        let text: Vec<char> = full().to_toml_string().chars().collect();
        let at = at.min(text.len());
        let end = (at + length).min(text.len());
        let mangled: String = text[..at].iter().copied().chain(put.chars())
            .chain(text[end..].iter().copied()).collect();
        if let Ok(model) = Model::from_toml_str(&mangled, "m.toml") {
            // A model that is accepted can be run.
            prop_assert!(crate::Chain::new(&model).is_ok());
        }
    }

    #[test]
    fn any_finite_number_is_written_and_read_back_to_the_bit(bits in any::<u64>()) {
        let value = f64::from_bits(bits);
        prop_assume!(value.is_finite() && value != 0.0);
        let mut model = Model::eq6();
        model.plant = crate::TransferFunction::new(vec![value], vec![1.0, 0.0]).unwrap();
        let back = Model::from_toml_str(&model.to_toml_string(), "m.toml").unwrap();
        prop_assert_eq!(back.plant.num()[0].to_bits(), bits);
    }
}

#[test]
fn a_plant_of_other_units_has_lengths_of_any_size() {
    let model = Model {
        working_point_um: 3e7,
        noise: Noise {
            diffusion_um2_per_s: 1e12,
            localisation_um: 4e5,
        },
        effects: vec![
            effects::saturation(-2e9, 7e9).in_any_unit(),
            effects::stiffening(641.0).in_any_unit(),
        ],
        ..Model::eq6()
    };
    let refused = Model::from_toml_str(&model.to_toml_string(), "m.toml").unwrap_err();
    assert!(
        refused.to_string().contains("working_point_um"),
        "{refused}"
    );
    assert!(crate::Chain::new(&model).is_err());
    let provenance = [(Model::UNITS.to_owned(), "nm -> nm".to_owned())];
    let model = Model {
        provenance: provenance.into(),
        ..model
    };
    let read = Model::from_toml_str(&model.to_toml_string(), "m.toml").unwrap();
    assert_eq!(read, model);
    crate::Chain::new(&read).unwrap();
    // A sign and a pure number have bounds in any unit.
    let text = model.to_toml_string();
    for (was, wrong) in [
        (
            "diffusion_um2_per_s = 1000000000000.0",
            "diffusion_um2_per_s = -1.0",
        ),
        ("localisation_um = 400000.0", "localisation_um = -0.1"),
    ] {
        assert!(text.contains(was), "{text}");
        let refused = Model::from_toml_str(&text.replace(was, wrong), "m.toml").unwrap_err();
        assert!(refused.to_string().contains("in 0.."), "{refused}");
    }
}
