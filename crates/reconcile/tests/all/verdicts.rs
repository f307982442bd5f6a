//! What a verdict rests on: a floor, numbers that hold everywhere, and a list of effects that grows from outside.

use cellpos_numeric::Random;
use cellpos_plant::effects::{
    self, Action, Block, Candidate, EffectKind, Experiment, Form, ParameterSpec, Piece, Place,
    Scope, Spec, lin,
};
use cellpos_plant::{Effect, Model, Noise, SimulateOptions, TransferFunction, simulate};
use cellpos_reconcile::{FloorSource, Options, Reconciliation, Record, Verdict, reconcile};
use std::f64::consts::TAU;

/// A lag of 20 ms about zero, sampled at 1 kHz, with white noise.
fn plant() -> Model {
    Model {
        name: "lag".to_owned(),
        plant: TransferFunction::new(vec![1.0], vec![0.02, 1.0]).unwrap(),
        working_point_um: 0.0,
        noise: Noise {
            diffusion_um2_per_s: 1e-4,
            localisation_um: 0.01,
        },
        ..Model::eq6()
    }
}

/// Held levels at random, 20 rows each.
fn levels(rows: usize, size: f64, seed: u64) -> Vec<f64> {
    let mut random = Random::new(seed);
    let mut u = Vec::with_capacity(rows);
    while u.len() < rows {
        let level = size * random.normal();
        u.extend(std::iter::repeat_n(level, 20));
    }
    u.truncate(rows);
    u
}

fn record(name: &str, model: &Model, u: &[f64], seed: u64) -> Record {
    let options = SimulateOptions {
        seed: Some(seed),
        ..SimulateOptions::default()
    };
    let y = simulate(model, u, 1e-3, &options).unwrap();
    let t: Vec<f64> = (0..u.len()).map(|k| k as f64 * 1e-3).collect();
    Record::from_rows(name, &t, u, &y).unwrap()
}

fn run(model: &Model, records: &[Record]) -> Reconciliation {
    let options = Options {
        free_start: true,
        ..Options::default()
    };
    reconcile(model, records, &options, &mut |_| {}).unwrap()
}

fn named(r: &Reconciliation) -> Vec<&str> {
    r.effects.iter().map(|e| e.id.as_str()).collect()
}

#[test]
fn one_effect_in_another_anchoring_is_one_effect() {
    anchored_otherwise([(effects::pdms_relaxation(0.3, 0.2), 1.0 / 1.2)]);
}

#[test]
#[ignore = "nightly: a creep; the fast one has a relaxation"]
fn a_creep_in_another_anchoring_is_one_effect() {
    anchored_otherwise([(effects::pzt_creep(0.05 / 1.1), 1.1)]);
}

/// The model's gain is that of fast motion: beside it the slow one is off, which is no gain error.
fn anchored_otherwise(cases: [(Effect, f64); 1]) {
    for (slow, gain) in cases {
        let id = slow.id();
        let hidden = plant()
            .with_effect(slow)
            .with_effect(effects::gain_error(gain));
        let mut records: Vec<Record> = (0..3)
            .map(|k| {
                record(
                    &format!("levels-{k}"),
                    &hidden,
                    &levels(6000, 1.0, k),
                    k + 40,
                )
            })
            .collect();
        records.push(record("rest", &hidden, &vec![0.0; 6000], 50));
        let r = run(&plant(), &records);
        assert_eq!(r.verdict, Verdict::Named, "{id}: {:?}", r.places);
        assert_eq!(named(&r), [id], "{:?}", r.effects);
    }
}

/// What is named of levels that go through `before` and then through the plant, which knows nothing of it.
fn behind(before: impl Fn(&[f64]) -> Vec<f64>) -> Reconciliation {
    let mut records: Vec<Record> = (0..3)
        .map(|k| {
            let u = levels(6000, 1.0, 1 + 10 * k);
            let y = record("y", &plant(), &before(&u), 41 + k).bead_um;
            let t: Vec<f64> = (0..u.len()).map(|k| k as f64 * 1e-3).collect();
            Record::from_rows(&format!("levels-{k}"), &t, &u, &y).unwrap()
        })
        .collect();
    records.push(record("rest", &plant(), &vec![0.0; 6000], 50));
    run(&plant(), &records)
}

#[test]
#[ignore = "slow: a third of a minute of processor time; for the nightly run"]
fn a_small_effect_that_another_form_of_the_large_one_explains_is_no_name() {
    // A resonance whose damping grows with its speed: beside one of constant damping a lag at another place explains the rest, or two.
    for (hz, drag) in [(60.0, 0.001), (90.0, 0.002)] {
        let r = behind(|u| {
            let w = TAU * hz;
            let (mut x, mut v) = (u[0], 0.0f64);
            u.iter()
                .map(|u| {
                    for _ in 0..100 {
                        v += 1e-5 * (w * w * (u - x) - 0.4 * w * v * (1.0 + drag * v.abs()));
                        x += 1e-5 * v;
                    }
                    x
                })
                .collect()
        });
        assert_eq!(
            r.verdict,
            Verdict::NamedWithRemainder,
            "{hz}: {:?} {:?}",
            named(&r),
            r.places
        );
        assert_eq!(named(&r), ["pzt-resonance"], "{hz}");
        let how = r.remainder.unwrap().how;
        assert!(how.contains("camera-shake"), "{hz}: {how}");
    }
}

/// Records of this rig: levels about the working point, and a rest.
fn on_this_rig(hidden: &Model, rows: usize) -> Vec<Record> {
    let mut records: Vec<Record> = (0..3)
        .map(|k| {
            let u: Vec<f64> = levels(rows, 1.0, k).iter().map(|u| 4.0 + u).collect();
            record(&format!("levels-{k}"), hidden, &u, k + 50)
        })
        .collect();
    records.push(record("rest", hidden, &vec![4.0; 10_000], 60));
    records
}

#[test]
fn an_effect_of_the_size_that_may_hide_shows_and_a_third_of_it_does_not() {
    let look = |hidden: &Model| {
        let records = on_this_rig(hidden, 2000);
        reconcile(&Model::eq6(), &records, &Options::default(), &mut |_| {}).unwrap()
    };
    let quiet = look(&Model::eq6());
    assert_eq!(quiet.verdict, Verdict::NothingMissing, "{:?}", quiet.places);
    let said = quiet.places.iter().find(|p| p.contains("need not show"));
    let (_, after) = said.unwrap().split_once("gain-drift per_s ").unwrap();
    let number: String = (after.chars())
        .take_while(|c| c.is_ascii_digit() || *c == '.')
        .collect();
    let size: f64 = number.parse().unwrap();
    // Which effect it is, such a small one need not tell.
    let shows = |size| {
        let r = look(&Model::eq6().with_effect(effects::gain_drift(size)));
        r.verdict != Verdict::NothingMissing
    };
    assert!(shows(size) && !shows(size / 3.0), "{size}");
}

#[test]
#[ignore = "26 s of a debug build: for .ci/nightly"]
fn a_small_effect_of_its_own_is_named_beside_a_large_one() {
    let hidden = Model::eq6()
        .with_effect(effects::time_delay(0.006))
        .with_effect(effects::pzt_creep(0.015));
    let records = on_this_rig(&hidden, 16_000);
    let r = reconcile(&Model::eq6(), &records, &Options::default(), &mut |_| {}).unwrap();
    assert_eq!(named(&r), ["time-delay", "pzt-creep"]);
    assert!(
        r.effects[1].explained < 0.0015,
        "{}",
        r.effects[1].explained
    );
}

#[test]
fn what_a_search_had_no_time_to_weigh_is_no_name() {
    let hidden = Model::eq6().with_effect(effects::time_delay(0.0039));
    let options = Options {
        work: 1e-4,
        ..Options::default()
    };
    let records = on_this_rig(&hidden, 6000);
    let r = reconcile(&Model::eq6(), &records, &options, &mut |_| {}).unwrap();
    assert_eq!(r.verdict, Verdict::Unknown);
    assert!(
        r.places
            .iter()
            .any(|p| p.contains("before others were tried")),
        "{:?}",
        r.places
    );
}

#[test]
fn pixels_see_what_a_hum_shakes() {
    // Both names and no search for a third.
    a_hum_shakes_pixels(&Options {
        max_effects: 2,
        ..Options::default()
    });
}

#[test]
#[ignore = "nightly: a third name is looked for as well; the fast one looks for two"]
fn pixels_see_what_a_hum_shakes_and_nothing_else() {
    a_hum_shakes_pixels(&Options::default());
}

fn a_hum_shakes_pixels(options: &Options) {
    // The hum moves the image by more than a pixel: the error within a pixel turns with it.
    let model = Model::eq6();
    let hidden = model
        .clone()
        .with_effect(effects::mains_hum(50.0, 0.35, 20.0))
        .with_effect(effects::pixel_locking(0.25, 0.08, 0.0));
    let records = on_this_rig(&hidden, 6000);
    let r = reconcile(&model, &records, options, &mut |_| {}).unwrap();
    assert_eq!(named(&r), ["mains-hum", "pixel-locking"]);
    let amplitude = &r.effects[1].parameters["amplitude"];
    assert!((amplitude.value - 0.08).abs() < 0.008, "{amplitude:?}");
}

#[test]
#[ignore = "16 s of a debug build: for .ci/nightly"]
fn a_hysteresis_that_any_curve_explains_is_no_name() {
    // A clip whose knee is round, nearly as wide as the clip: beside a sharp one a hysteresis would explain it.
    let r = behind(|u| {
        let soft = |x: f64| 0.6 * (1.0 + (x / 0.6).exp()).ln();
        u.iter()
            .map(|u| u - soft(u - 1.0) + soft(-1.2 - u))
            .collect()
    });
    assert_eq!(r.verdict, Verdict::NamedWithRemainder, "{:?}", r.places);
    assert_eq!(named(&r), ["saturation"]);
    let how = r.remainder.unwrap().how;
    assert!(
        how.contains("pzt-hysteresis beside it would explain"),
        "{how}"
    );
}

/// Random records without rest, repeat or stated noise, three of four with an effect: none may be named, and only where none is hidden
/// may nothing be missing.
fn never_named(count: u64) {
    let silent = Model {
        noise: Noise::NONE,
        ..plant()
    };
    let mut nothing = 0;
    for seed in 0..count {
        let truth = match seed % 4 {
            0 => plant(),
            1 => plant().with_effect(effects::time_delay(4e-3)),
            2 => plant().with_effect(effects::gain_error(1.3)),
            _ => plant().with_effect(effects::backlash(0.2)),
        };
        let r = run(
            &silent,
            &[record("only", &truth, &levels(900, 1.0, seed), seed + 1000)],
        );
        assert_eq!(r.floor, FloorSource::Unknown, "seed {seed}");
        assert!(r.effects.is_empty(), "seed {seed}: {:?}", named(&r));
        if seed % 4 == 0 && r.verdict == Verdict::NothingMissing {
            nothing += 1;
            continue;
        }
        assert_eq!(r.verdict, Verdict::Unknown, "seed {seed}");
        assert!(
            r.places.iter().any(|p| p.contains("record a rest of 10 s")),
            "{:?}",
            r.places
        );
    }
    assert!(10 * nothing >= 9 * count / 4, "{nothing} of {}", count / 4);
}

#[test]
fn without_a_floor_nothing_is_named() {
    never_named(24);
}

#[test]
#[ignore = "minutes: cargo test --release -p cellpos-reconcile --test all verdicts -- --include-ignored"]
fn without_a_floor_nothing_is_named_in_a_thousand_records() {
    never_named(1000);
}

#[test]
fn a_measured_input_rests_and_repeats_within_its_own_noise() {
    let mut random = Random::new(3);
    let mut noisy = |u: f64| u + 0.01 * random.normal();
    let t: Vec<f64> = (0..4000).map(|k| k as f64 * 1e-3).collect();
    let sine: Vec<f64> = (0..4000)
        .map(|k| noisy((TAU * 2.0 * f64::from(k) * 1e-3).sin()))
        .collect();
    let y = vec![0.5; 4000];
    let of = |u: &[f64]| Record::from_rows("r", &t, u, &y).unwrap();
    assert_eq!(of(&sine).period_rows(), Some(500));
    // A sine that swells by a twentieth a period comes back nowhere.
    let swelling: Vec<f64> = (0..4000)
        .map(|k| {
            let t = f64::from(k) * 1e-3;
            (1.0 + 0.1 * t) * (TAU * 2.0 * t).sin()
        })
        .collect();
    assert_eq!(of(&swelling).period_rows(), None);
    let wander = levels(4000, 1.0, 9);
    assert_eq!(of(&wander).period_rows(), None);
}

/// One moving record and a measured rest: the floor comes from the rest, the held-out check from the end of the record.
#[test]
fn a_rest_that_is_measured_gives_the_floor_of_one_moving_record() {
    let mut random = Random::new(4);
    let mut noisy = |u: f64| u + 0.01 * random.normal();
    // A rest that is measured: the floor comes from it.
    let truth = plant().with_effect(effects::gain_error(1.2));
    let rest: Vec<f64> = (0..2000).map(|_| noisy(0.0) * 0.03).collect();
    let silent = Model {
        noise: Noise::NONE,
        ..plant()
    };
    let r = run(
        &silent,
        &[
            record("moving", &truth, &levels(4000, 1.0, 5), 6),
            record("rest", &truth, &rest, 7),
        ],
    );
    assert_eq!(r.floor, FloorSource::Rest);
    // Four seconds do not tell a gain from the crest of a slow swing of it.
    assert!(
        matches!(r.verdict, Verdict::Named | Verdict::Ambiguous),
        "{:?}",
        r.places
    );
    assert_eq!(named(&r), ["gain-error"]);
    let factor = &r.effects[0].parameters["factor"];
    assert!((factor.value - 1.2).abs() < 0.01, "{factor:?}");
}

#[test]
fn numbers_that_change_with_the_part_of_the_data_are_no_name() {
    let with = |factor: f64| plant().with_effect(effects::gain_error(factor));
    let r = run(
        &plant(),
        &[
            record("large", &with(0.8), &levels(2000, 1.0, 1), 1),
            record("small", &with(1.25), &levels(2000, 0.5, 2), 2),
            record("rest", &plant(), &vec![0.0; 1500], 3),
        ],
    );
    assert_eq!(r.verdict, Verdict::Unknown, "{:?}", named(&r));
    assert!(r.effects.is_empty());
}

/// An effect of another crate: the drive's square.
#[derive(Debug)]
struct SquareDrive;

static SQUARE_DRIVE: SquareDrive = SquareDrive;

static SPEC: Spec = Spec {
    id: "square-drive",
    place: Place::Driver,
    shown_at: "",
    equation: "u + c u^2",
    signature: "even harmonics",
    ahead_of_plant: false,
    forms: &[Form::only(&[ParameterSpec::new(
        "per_um", "1/um", -1.0, 1.0,
    )])],
    confused_with: &[],
    inseparable_from: &[],
    experiment: Experiment::Amplitudes,
    separate_by: "the second harmonic at two amplitudes",
};

#[derive(Debug, Clone)]
struct Square {
    per_um: f64,
}

impl Block for Square {
    fn advance(&mut self, _: f64, h_s: f64, input: Piece) -> Piece {
        let at = |u: f64| u + self.per_um * u * u;
        Piece::line(at(input.start), at(input.end), h_s)
    }

    fn duplicate(&self) -> Box<dyn Block> {
        Box::new(self.clone())
    }
}

impl EffectKind for SquareDrive {
    fn spec(&self) -> &'static Spec {
        &SPEC
    }

    fn act(&self, effect: &Effect) -> Action {
        Action::Block(Box::new(Square {
            per_um: effect.scalar(0),
        }))
    }

    fn candidates(&self) -> &'static [Candidate] {
        const ALL: &[Candidate] = &[Candidate::chain(&[lin("per_um", -0.5, 0.5, 1e-4)])];
        ALL
    }

    fn starts(&self, _: usize, _: &Scope) -> Vec<Vec<f64>> {
        vec![vec![-0.05], vec![0.05]]
    }

    fn build(&'static self, _: usize, values: &[f64], _: &Scope) -> Effect {
        Effect::new(self, 0, values, &[])
    }
}

#[test]
fn an_effect_from_elsewhere_is_searched_named_written_and_read_like_any_other() {
    effects::register(&SQUARE_DRIVE).unwrap();
    effects::register(&SQUARE_DRIVE).unwrap();
    let truth = plant().with_effect(Effect::of("square-drive", &[("per_um", 0.1)]).unwrap());
    let r = run(
        &plant(),
        &[
            record("one", &truth, &levels(4000, 1.0, 11), 11),
            record("two", &truth, &levels(4000, 0.5, 12), 12),
            record("rest", &truth, &vec![0.0; 3000], 13),
        ],
    );
    assert_eq!(r.verdict, Verdict::Named, "{:?}", r.places);
    assert_eq!(named(&r), ["square-drive"]);
    let found = &r.effects[0].parameters["per_um"];
    assert!((found.value - 0.1).abs() < 0.003, "{found:?}");
    let text = r.augmented.to_toml_string();
    let back = Model::from_toml_str(&text, "augmented.toml").unwrap();
    assert!(back.effect("square-drive").is_some());
}

#[test]
#[ignore = "14 s of a release build: for .ci/nightly"]
fn what_a_wrong_equation_leaves_at_the_multiples_of_a_drive_is_no_pump() {
    let hidden = |size: f64, seed: u64| {
        let u: Vec<f64> = (0..8000)
            .map(|k| size * (TAU * 1.5 * f64::from(k) * 1e-3).sin())
            .collect();
        // Friction that eases the faster it goes: a stroke comes late and with a kink.
        let rises = |k: usize| u[(k + 1).min(u.len() - 1)] - u[k];
        let bent: Vec<f64> = (0..u.len())
            .map(|k| u[k] - 0.08 * (rises(k) / (2e-3 + 0.3 * rises(k).abs())))
            .collect();
        let mut r = record("drive", &plant(), &bent, seed);
        r.pzt_um.copy_from_slice(&u);
        r
    };
    let records = [hidden(1.0, 1), hidden(0.5, 2), hidden(0.0, 3)];
    let r = run(&plant(), &records);
    assert!(!named(&r).contains(&"pump-pulsation"), "{:?}", r.effects);
}
