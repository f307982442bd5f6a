//! Learning over cycles on a rig whose gain is 20 % and whose delay is 0.25 ms off the model.

use crate::common::{config, mpc};
use cellpos_control::design::{DesignPlant, MarginSource, Uncertainty, harmonic_responses};
use cellpos_control::*;
use cellpos_plant::Model;

pub(crate) const FADE_S: f64 = 0.2;

fn wrong_rig(seed: u64) -> RigConfig {
    let eq6 = RigConfig::eq6(seed);
    RigConfig {
        plant: eq6.plant.scaled(1.2).unwrap(),
        delay_s: 2.25e-3,
        ..eq6
    }
}

pub(crate) fn sine(amplitude_um: f64, frequency_hz: f64) -> Profile {
    Profile::Wave {
        shape: Shape::Sine,
        centre_um: 0.0,
        amplitude_um,
        frequency_hz,
        fade_s: FADE_S,
    }
}

pub(crate) fn learner(
    controller: ControllerConfig,
    profile: &Profile,
    frequency_hz: f64,
) -> Learner {
    let responses = harmonic_responses(
        &DesignPlant::eq6(2.5e-3),
        &config(controller),
        profile,
        FADE_S,
        frequency_hz,
        3,
        Uncertainty::default(),
    )
    .unwrap();
    Learner::new(LearnConfig::default(), frequency_hz, 1e-3, &responses).unwrap()
}

/// A run along a profile; `each(k, true error, learner's state)` at each tick. What was learned in the end.
pub(crate) fn run(
    config: LoopConfig,
    rig: RigConfig,
    profile: &Profile,
    learning: Option<(&Learner, LearnerState)>,
    ticks: u64,
    lost: impl Fn(u64) -> bool,
    mut each: impl FnMut(u64, f64, Option<LearnedTable>),
) -> Option<LearnedTable> {
    let delay_s = rig.delay_s;
    let mut rig = SimulatedRig::new(rig).unwrap();
    let mut controller = Controller::new(config).unwrap();
    controller.start(20.0, 20.0);
    let mut preview = vec![0.0; controller.preview_len()];
    let mut learning = learning.map(|(l, state)| CycleLearning::new(l.clone(), state));
    for k in 0..ticks {
        let time_s = k as f64 * 1e-3;
        let reference_um = profile.at_um(time_s);
        fill_preview(profile, k, 1e-3, &mut preview);
        each(
            k,
            rig.true_um() - reference_um,
            learning.as_ref().map(CycleLearning::table),
        );
        let mut fix = rig.measure();
        // What the frame's time stamp says against the model's delay.
        fix.offset_samples = (delay_s - 2e-3) / 1e-3;
        let fix = Some(fix).filter(|_| !lost(k));
        let mut input = LoopInput {
            measurement: fix,
            reference_um,
            preview_um: &preview,
            ..LoopInput::default()
        };
        if let Some(learning) = &mut learning {
            input.learned_um = learning.addition_um(profile.phase(time_s), reference_um);
            input.feed_forward_gain = learning.feed_forward_gain();
        }
        let out = controller.step(&input);
        if let Some(learning) = &mut learning {
            let fix = fix.map(|fix| (fix.position_um, delay_s / 1e-3));
            learning.learn(fix, &out.driven);
        }
        rig.advance(out.command_um);
    }
    learning.map(|learning| learning.table())
}

fn rms_um(
    controller: ControllerConfig,
    seed: u64,
    profile: &Profile,
    learner: Option<&Learner>,
    (from, to): (u64, u64),
) -> f64 {
    let (mut sum, mut n) = (0.0, 0.0);
    run(
        config(controller),
        wrong_rig(seed),
        profile,
        learner.map(|l| (l, l.start())),
        to,
        |_| false,
        |k, error_um, _| {
            if k >= from {
                sum += error_um * error_um;
                n += 1.0;
            }
        },
    );
    f64::sqrt(sum / n)
}

#[test]
fn learning_brings_cyclic_motion_to_twice_the_hold_error_within_20_cycles() {
    let hold = Profile::Hold { position_um: 0.0 };
    for controller in [
        ControllerConfig::Lqg(Lqg::default()),
        mpc(SolverKind::ActiveSet),
    ] {
        let hold_um = rms_um(controller, 1, &hold, None, (1000, 5000));
        for (amplitude_um, frequency_hz) in [
            (5.0, 50.0),
            (5.0, 100.0),
            (1.0, 130.0),
            (1.0, 200.0),
            (0.5, 300.0),
        ] {
            let profile = sine(amplitude_um, frequency_hz);
            let learner = learner(controller, &profile, frequency_hz);
            let start = (FADE_S * 1e3) as u64;
            let learned = start + (20.0 * 1e3 / frequency_hz) as u64;
            let span = (learned, learned + 1000);
            for seed in 0..5 {
                let without = rms_um(controller, seed, &profile, None, span);
                let with = rms_um(controller, seed, &profile, Some(&learner), span);
                println!(
                    "{amplitude_um} um at {frequency_hz} Hz, seed {seed}: hold {:.1} nm, without {:.1} nm, learned {:.1} nm",
                    hold_um * 1e3,
                    without * 1e3,
                    with * 1e3
                );
                assert!(
                    with <= 2.0 * hold_um && with < without,
                    "{controller:?}, {amplitude_um} um at {frequency_hz} Hz, seed {seed}: {with} um against a hold of {hold_um} um, {without} um without learning"
                );
            }
        }
    }
}

#[test]
fn a_table_learned_before_serves_from_the_first_cycle() {
    let controller = ControllerConfig::Lqg(Lqg::default());
    let profile = sine(5.0, 100.0);
    let learner = learner(controller, &profile, 100.0);
    let mut learned = None;
    run(
        config(controller),
        wrong_rig(1),
        &profile,
        Some((&learner, learner.start())),
        1500,
        |_| false,
        |_, _, table| learned = table,
    );
    let table = learned.unwrap();
    assert_eq!(table.retreats, 0);
    let text = toml::to_string(&table).unwrap();
    let read: LearnedTable = toml::from_str(&text).unwrap();
    assert_eq!(read, table);
    let state = learner.resume(&read).unwrap();
    let first_cycles = |state| {
        let mut sum = 0.0;
        run(
            config(controller),
            wrong_rig(2),
            &profile,
            Some((&learner, state)),
            260,
            |_| false,
            |k, e, _| {
                if k >= 215 {
                    sum += e * e / 45.0;
                }
            },
        );
        f64::sqrt(sum)
    };
    let (with, without) = (first_cycles(state), first_cycles(learner.start()));
    assert!(with < 0.2 * without, "{with} against {without}");
    let other = Learner::new(
        LearnConfig::default(),
        50.0,
        1e-3,
        &[HarmonicResponse {
            harmonic: 1,
            re_um_per_um: 0.0,
            im_um_per_um: -1.0,
            relative_uncertainty: 0.3,
        }],
    )
    .unwrap();
    assert!(matches!(
        other.resume(&read),
        Err(LearnError::OtherFrequency { .. })
    ));
}

#[test]
fn nothing_is_learned_while_the_bead_is_lost_and_shortly_after() {
    let controller = ControllerConfig::Lqg(Lqg::default());
    let profile = sine(1.0, 100.0);
    let learner = learner(controller, &profile, 100.0);
    let mut seen: Vec<LearnedTable> = Vec::new();
    run(
        config(controller),
        wrong_rig(1),
        &profile,
        Some((&learner, learner.start())),
        1500,
        |k| (450..460).contains(&k),
        |_, _, table| seen.push(table.unwrap()),
    );
    assert_ne!(seen[300].harmonics, seen[450].harmonics, "learning before");
    for tick in 451..480 {
        assert_eq!(seen[451].harmonics, seen[tick].harmonics, "frozen");
    }
    assert_ne!(seen[479].harmonics, seen[1499].harmonics, "learning again");
}

#[test]
fn a_learner_told_the_opposite_response_retreats_and_gives_up_instead_of_growing() {
    let controller = ControllerConfig::Lqg(Lqg::default());
    let profile = sine(1.0, 100.0);
    let right = harmonic_responses(
        &DesignPlant::eq6(2.5e-3),
        &config(controller),
        &profile,
        FADE_S,
        100.0,
        1,
        Uncertainty::default(),
    )
    .unwrap();
    let wrong: Vec<_> = right
        .iter()
        .map(|r| HarmonicResponse {
            re_um_per_um: -r.re_um_per_um,
            im_um_per_um: -r.im_um_per_um,
            ..*r
        })
        .collect();
    let learner = Learner::new(LearnConfig::default(), 100.0, 1e-3, &wrong).unwrap();
    let (mut worst, mut last) = (0.0_f64, None);
    run(
        config(controller),
        wrong_rig(1),
        &profile,
        Some((&learner, learner.start())),
        6000,
        |_| false,
        |_, e, table| {
            worst = worst.max(e.abs());
            last = table;
        },
    );
    assert_eq!(last.unwrap().retreats, 3);
    assert!(worst < 5.0, "{worst} um");
}

#[test]
fn a_harmonic_whose_response_is_too_uncertain_is_refused() {
    let response = |harmonic, relative_uncertainty| HarmonicResponse {
        harmonic,
        re_um_per_um: 0.1,
        im_um_per_um: -0.5,
        relative_uncertainty,
    };
    let learner = |responses: &[HarmonicResponse]| {
        Learner::new(LearnConfig::default(), 60.0, 1e-3, responses)
    };
    let kept = learner(&[response(1, 0.4), response(2, 1.1)]).unwrap();
    assert_eq!(kept.refused(), &[response(2, 1.1)]);
    let error = learner(&[response(1, 1.3), response(2, f64::NAN)]).unwrap_err();
    assert!(matches!(error, LearnError::NotConvergent { uncertainty, .. } if uncertainty == 1.3));
    let plant = DesignPlant::eq6(2.5e-3);
    let vague = Uncertainty {
        gain_factor: 2.0,
        delay_s: 1e-3,
        ..Uncertainty::default()
    };
    let at_300_hz = harmonic_responses(
        &plant,
        &config(ControllerConfig::Lqg(Lqg::default())),
        &sine(0.5, 300.0),
        FADE_S,
        300.0,
        1,
        vague,
    )
    .unwrap();
    assert!(
        at_300_hz[0].relative_uncertainty > 1.0,
        "1 ms is 108 deg at 300 Hz: {at_300_hz:?}"
    );
}

fn identified(gain_per_s: [f64; 2], delay_ms: [f64; 2]) -> Model {
    let mut model = Model::eq6();
    for (name, interval) in [("gain_per_s", gain_per_s), ("delay_ms", delay_ms)] {
        model.intervals.insert(name.to_owned(), interval);
    }
    model
}

#[test]
fn margins_are_three_standard_deviations_of_the_identified_model_and_never_less_than_the_least() {
    assert_eq!(
        Uncertainty::of_model(&Model::eq6(), 2e-3),
        Uncertainty::default()
    );
    // 1.96 standard deviations of 6 % of the gain, and of 0.1 ms.
    let spread = (1.96 * 0.06_f64).exp();
    let vague = identified([428.0 / spread, 428.0 * spread], [2.0 - 0.196, 2.0 + 0.196]);
    let margins = Uncertainty::of_model(&vague, 2e-3);
    assert!((margins.gain_factor.ln() - 0.18).abs() < 1e-9, "{margins}");
    assert!((margins.delay_s - 0.3e-3).abs() < 1e-9, "{margins}");
    assert_eq!(margins.gain_source, MarginSource::Identified);
    assert_eq!(margins.delay_source, MarginSource::Identified);
    // A loop that reckons with another delay than the identified one is off by as much.
    let off = Uncertainty::of_model(&vague, 1.8e-3);
    assert!((off.delay_s - 0.5e-3).abs() < 1e-9, "{off}");
    // Whatever the sign of the gain.
    let reversed = identified([-428.0 * spread, -428.0 / spread], [1.804, 2.196]);
    assert!(
        (Uncertainty::of_model(&reversed, 2e-3).gain_factor - margins.gain_factor).abs() < 1e-9
    );
    let sharp = Uncertainty::of_model(&identified([426.4, 429.1], [1.9995, 2.0005]), 2e-3);
    assert_eq!((sharp.gain_factor, sharp.delay_s), (1.1, 0.05e-3));
    assert_eq!(sharp.gain_source, MarginSource::Floor);
    assert_eq!(sharp.delay_source, MarginSource::Floor);
    // An interval across zero, and one without end, say nothing.
    let useless = identified([-1.0, 800.0], [0.0, f64::INFINITY]);
    assert_eq!(
        Uncertainty::of_model(&useless, 2e-3),
        Uncertainty::default()
    );
}

#[test]
fn a_model_known_well_lets_more_be_learned_and_one_known_badly_less() {
    let at_300_hz = |margins| {
        let responses = harmonic_responses(
            &DesignPlant::eq6(2.5e-3),
            &config(ControllerConfig::Lqg(Lqg::default())),
            &sine(0.5, 300.0),
            FADE_S,
            300.0,
            1,
            margins,
        )
        .unwrap();
        let learner = Learner::new(LearnConfig::default(), 300.0, 1e-3, &responses);
        (responses[0].relative_uncertainty, learner.is_ok())
    };
    let well = Uncertainty::of_model(&identified([426.4, 429.1], [1.9995, 2.0005]), 2e-3);
    let badly = Uncertainty::of_model(&identified([300.0, 600.0], [1.6, 2.4]), 2e-3);
    let ((sharp, learned), (fixed, learned_too), (vague, refused)) = (
        at_300_hz(well),
        at_300_hz(Uncertainty::default()),
        at_300_hz(badly),
    );
    println!("uncertainty of the response at 300 Hz: {sharp:.3}, {fixed:.3}, {vague:.3}");
    assert!(learned && learned_too && !refused);
    assert!(sharp < 0.4 * fixed && vague > 1.0);
}

#[test]
fn where_the_slew_does_not_carry_the_motion_nothing_learned_stays_in_force_that_does_not_help() {
    // 1.5 um at 300 Hz asks for 12 um of PZT a tick, and the slew allows 10.
    for (amplitude_um, gain, adapt) in [
        (1.5, 0.8, true),
        (1.5, 0.8, false),
        (1.5, 1.0, true),
        (1.5, 1.2, true),
        (1.5, 1.2, false),
        (1.2, 0.8, true),
        (1.2, 0.8, false),
        (1.0, 0.8, true),
    ] {
        let frequency_hz = 300.0;
        let lqg = ControllerConfig::Lqg(Lqg::default());
        let profile = sine(amplitude_um, frequency_hz);
        let learner = learner(lqg, &profile, frequency_hz);
        let mut config = config(lqg);
        config.estimator.adapt = adapt;
        for seed in 0..3 {
            let eq6 = RigConfig::eq6(seed);
            let rig = RigConfig {
                plant: eq6.plant.scaled(gain).unwrap(),
                delay_s: 2.25e-3,
                ..eq6
            };
            let rms_um = |learning: Option<(&Learner, LearnerState)>| {
                let (mut squares, mut ticks) = (0.0, 0.0_f64);
                let each = |k: u64, error_um: f64, _| {
                    if k >= 600 {
                        squares += error_um * error_um;
                        ticks += 1.0;
                    }
                };
                let table = run(
                    config,
                    rig.clone(),
                    &profile,
                    learning,
                    4000,
                    |_| false,
                    each,
                );
                ((squares / ticks).sqrt(), table)
            };
            let (without_um, _) = rms_um(None);
            let (with_um, table) = rms_um(Some((&learner, learner.start())));
            let table = table.expect("a learner");
            assert!(
                with_um < 1.05 * without_um,
                "{amplitude_um} um, gain {gain}, {adapt}: {without_um} um, {with_um} um"
            );
            // Of those without adaptation only that within the slew can be mended.
            let carried = amplitude_um < 1.5 || gain > 1.0;
            if !carried {
                // The slew leaves a part that a table makes smaller if gain and delay are known.
                let helps = adapt && with_um < without_um;
                assert!(table.harmonics.is_empty() || helps, "{table:?}");
            } else if !adapt {
                assert!(with_um < 0.4 * without_um, "{without_um} um, {with_um} um");
            }
        }
    }
}
