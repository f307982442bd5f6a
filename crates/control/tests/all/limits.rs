//! Whatever comes in, the command is finite, within range and within slew of the previous one.

use cellpos_control::*;
use proptest::prelude::*;

fn any_number() -> impl Strategy<Value = f64> {
    prop_oneof![
        6 => -100.0..100.0_f64,
        1 => any::<f64>(),
        1 => prop_oneof![
            Just(f64::NAN), Just(f64::INFINITY), Just(f64::NEG_INFINITY), Just(1e300), Just(-1e300), Just(0.0),
            Just(f64::MIN_POSITIVE)
        ],
    ]
}

fn any_measurement() -> impl Strategy<Value = Option<Measurement>> {
    proptest::option::weighted(
        0.8,
        (any_number(), any_number(), 0u16..9, any_offset()).prop_map(
            |(position_um, variance_um2, age_samples, offset_samples)| Measurement {
                position_um,
                variance_um2,
                age_samples,
                offset_samples,
            },
        ),
    )
}

fn any_offset() -> impl Strategy<Value = f64> {
    prop_oneof![2 => Just(0.0), 4 => -0.5..=0.5_f64, 1 => any::<f64>()]
}

fn any_model() -> impl Strategy<Value = LoopModel> {
    (
        prop_oneof![-3000.0..-1.0_f64, 1.0..3000.0_f64],
        0.0..5e-3_f64,
        0.0..7.0_f64,
        -1.0..1.0_f64,
        -1.0..1.0_f64,
    )
        .prop_map(|(gain_per_s, delay_s, decade, residue, feedthrough)| {
            let mut model = LoopModel {
                gain_per_s,
                feedthrough,
                ..LoopModel::eq6(delay_s)
            };
            model.modes[0] = LoopMode {
                pole_rad_per_s: -10f64.powf(decade),
                residue_per_s: residue * gain_per_s,
            };
            model
        })
}

fn any_mode() -> impl Strategy<Value = Mode> {
    prop_oneof![6 => Just(Mode::Run), 1 => Just(Mode::Freeze), 1 => Just(Mode::Park)]
}

prop_compose! {
    fn any_config()(
        model in any_model(),
        adapt in any::<bool>(),
        noise_decade in -5.0..0.0_f64,
        kp in -5.0..5.0_f64,
        ki in -500.0..500.0_f64,
        weight in 0.0..=1.0_f64,
        lead in proptest::option::of(0.1..300.0_f64),
        low in -50.0..50.0_f64,
        span in 0.001..100.0_f64,
        slew in 0.01..1e6_f64,
        park in 0.0..=1.0_f64,
        law in 0..3,
        effort in 1e-3..100.0_f64,
    ) -> LoopConfig {
        let pi = Pi {
            setpoint_weight: weight,
            lead: lead.map(|zero_hz| Lead { zero_hz, pole_hz: 4.0 * zero_hz }),
            tracking_time_s: 0.05,
            ..Pi::new(kp, ki)
        };
        let controller = match law {
            0 => ControllerConfig::Pi(pi),
            1 => ControllerConfig::Lqg(Lqg { effort }),
            _ => ControllerConfig::Mpc(Mpc { effort, solver: SolverKind::ActiveSet, ..Mpc::default() }, pi),
        };
        LoopConfig {
            model,
            estimator: EstimatorConfig {
                adapt,
                fix_noise_um: 10f64.powf(noise_decade),
                ..EstimatorConfig::default()
            },
            controller,
            limits: Limits {
                low_um: low,
                high_um: low + span,
                slew_um_per_s: slew,
                park_um: (low + park * span).clamp(low, low + span),
            },
        }
    }
}

#[test]
fn a_first_belief_of_neutral_that_no_actuator_reaches_is_none() {
    let config = LoopConfig {
        model: LoopModel::eq6(0.0),
        estimator: EstimatorConfig::default(),
        controller: ControllerConfig::Pi(Pi::new(0.46, 19.5)),
        limits: Limits::default(),
    };
    for neutral_um in [1.7e308, -1.7e308, f64::INFINITY, f64::NAN] {
        let mut controller = Controller::new(config).unwrap();
        controller.start(20.0, neutral_um);
        let out = controller.step(&LoopInput::default());
        assert!(out.estimate_um.is_finite(), "{neutral_um}: {out:?}");
        assert!((out.neutral_um - 20.0).abs() < 1.0, "{neutral_um}: {out:?}");
    }
}

proptest! {
    // A debug build draws fewer: the nightly run, a release build, draws all, and others each night.
    #![proptest_config(ProptestConfig { cases: if cfg!(debug_assertions) { 100 } else { 400 }, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn no_command_leaves_range_or_slew_whatever_the_measurements(
        config in any_config(),
        start in any_number(),
        ticks in proptest::collection::vec((any_measurement(), any_number(), any_mode(), 0u8..8), 1..200),
    ) {
        // A model or law that no loop can be built on is refused at once.
        let Ok(mut controller) = Controller::new(config) else {
            return Ok(());
        };
        controller.start(start, start);
        let Limits { low_um, high_um, slew_um_per_s, .. } = config.limits;
        let mut last = controller.previous_command_um();
        prop_assert!((low_um..=high_um).contains(&last));
        for (measurement, reference_um, mode, skipped) in ticks {
            (5..skipped).for_each(|_| controller.skip());
            let input = LoopInput { measurement, reference_um, mode, ..LoopInput::default() };
            let out = controller.step(&input);
            prop_assert!(out.command_um.is_finite());
            prop_assert!((low_um..=high_um).contains(&out.command_um));
            let rounding = 1e-12 * (1.0 + last.abs());
            prop_assert!((out.command_um - last).abs() <= slew_um_per_s * 1e-3 + rounding);
            prop_assert!(out.estimate_um.is_finite() && out.neutral_um.is_finite());
            last = out.command_um;
        }
    }

    #[test]
    fn a_loop_comes_back_from_any_garbage(
        garbage in proptest::collection::vec((any_measurement(), any_number(), any_mode()), 1..100),
        seed in 0u64..1000,
    ) {
        let config = LoopConfig {
            model: LoopModel::eq6(2e-3),
            estimator: EstimatorConfig::default(),
            controller: ControllerConfig::Pi(Pi::new(0.46, 19.5)),
            limits: Limits::default(),
        };
        let mut controller = Controller::new(config).unwrap();
        controller.start(20.0, 20.0);
        for (measurement, reference_um, mode) in garbage {
            controller.step(&LoopInput { measurement, reference_um, mode, ..LoopInput::default() });
        }
        let mut rig = SimulatedRig::new(RigConfig::eq6(seed)).unwrap();
        let mut worst: f64 = 0.0;
        for k in 0..8000 {
            let input = LoopInput { measurement: Some(rig.measure()), ..LoopInput::default() };
            let out = controller.step(&input);
            rig.advance(out.command_um);
            if k > 7500 {
                worst = worst.max(rig.true_um().abs());
            }
        }
        prop_assert!(worst < 0.5, "{worst} um from the target");
    }
}
