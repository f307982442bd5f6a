//! The PI loop on the simulated rig: hold, step, drift, spread, lost and stuck beads.

use cellpos_control::design::{
    DesignPlant, bound_rms_um, cycle_figures, default_lead, disturbance_figures, noise_figures,
    step_figures,
};
use cellpos_control::*;

const PUBLISHED: (f64, f64) = (0.46, 19.5);

fn config(pi: Pi, delay_s: f64) -> LoopConfig {
    LoopConfig {
        model: LoopModel::eq6(delay_s),
        estimator: EstimatorConfig::default(),
        controller: ControllerConfig::Pi(pi),
        limits: Limits::default(),
    }
}

fn published() -> LoopConfig {
    config(Pi::new(PUBLISHED.0, PUBLISHED.1), 2e-3)
}

/// Runs a loop on a rig; `each(tick, rig, output)` sees every tick after its command was decided.
fn run(
    config: LoopConfig,
    rig: &mut SimulatedRig,
    ticks: usize,
    mut input: impl FnMut(usize, Measurement, &mut SimulatedRig) -> LoopInput<'static>,
    mut each: impl FnMut(usize, &SimulatedRig, &LoopOutput),
) -> Controller {
    let mut controller = Controller::new(config).unwrap();
    let neutral = rig.config().neutral_um;
    controller.start(neutral, neutral);
    for k in 0..ticks {
        let fix = rig.measure();
        let input = input(k, fix, rig);
        let out = controller.step(&input);
        each(k, rig, &out);
        rig.advance(out.command_um);
    }
    controller
}

fn to(reference_um: f64, measurement: Measurement) -> LoopInput<'static> {
    LoopInput {
        measurement: Some(measurement),
        reference_um,
        ..LoopInput::default()
    }
}

fn hold_rms_um(config: LoopConfig, rig: RigConfig, seconds: usize) -> f64 {
    let mut rig = SimulatedRig::new(rig).unwrap();
    let (mut sum, mut n) = (0.0, 0usize);
    run(
        config,
        &mut rig,
        seconds * 1000,
        |_, fix, _| to(0.0, fix),
        |k, rig, _| {
            if k >= 2000 {
                sum += rig.true_um().powi(2);
                n += 1;
            }
        },
    );
    (sum / n as f64).sqrt()
}

#[test]
fn pi_holds_within_1_45_times_the_minimum_variance_bound_and_as_predicted() {
    for (delay_s, pi) in [(2e-3, Pi::new(0.46, 19.5)), (3e-3, Pi::new(0.33, 9.6))] {
        let bound = bound_rms_um(0.33, 0.020, delay_s, 1e-3);
        let plant = DesignPlant::eq6(delay_s + 0.5e-3);
        let law = LinearLaw::Pi {
            pi,
            sample_time_s: 1e-3,
        };
        let predicted = noise_figures(&plant, &law).unwrap().unwrap().rms_um;
        assert!(predicted <= 1.45 * bound, "{predicted} against {bound}");
        let mut squares = 0.0;
        for seed in 0..5 {
            let rms = hold_rms_um(
                config(pi, delay_s),
                RigConfig {
                    delay_s,
                    ..RigConfig::eq6(seed)
                },
                12,
            );
            assert!(rms <= 1.45 * bound, "seed {seed}: {rms} against {bound}");
            squares += rms * rms / 5.0;
        }
        // 50 s with a correlation time of about 10 ms: 5000 independent values, 1 % of the RMS.
        assert!(
            (squares.sqrt() / predicted - 1.0).abs() < 0.05,
            "{} against {predicted}",
            squares.sqrt()
        );
    }
}

#[test]
fn a_10_um_step_settles_to_5_percent_within_60_ms_with_less_than_15_percent_overshoot() {
    let plant = DesignPlant::eq6(2.5e-3);
    for size_um in [10.0, -10.0] {
        let f = step_figures(&plant, &published(), size_um).unwrap();
        assert!(f.settling_5_percent_s < 0.060, "{f:?}");
        assert!(f.overshoot_percent < 15.0, "{f:?}");
    }
}

/// A held command moves an integrator along the chords of the reference: at the ticks nothing is missed, between them much.
#[test]
fn the_predicted_error_of_a_sine_is_that_between_ticks() {
    let plant = DesignPlant {
        plant: cellpos_plant::TransferFunction::integrator(428.0).unwrap(),
        ..DesignPlant::eq6(2.5e-3)
    };
    let config = LoopConfig {
        model: plant.loop_model().unwrap(),
        ..published()
    };
    for frequency_hz in [20.0, 100.0, 250.0, 400.0] {
        let sine = Profile::Wave {
            shape: Shape::Sine,
            centre_um: 0.0,
            amplitude_um: 0.1,
            frequency_hz,
            fade_s: 0.2,
        };
        let f = cycle_figures(&plant, &config, &sine, 0.2, frequency_hz).unwrap();
        let w = std::f64::consts::TAU * frequency_hz * 1e-3;
        let square = |phase: f64, s: f64| {
            let chord = (1.0 - s) * phase.sin() + s * (phase + w).sin();
            ((phase + w * s).sin() - chord).powi(2)
        };
        let grid = |n: usize| (0..n).map(move |i| (i as f64 + 0.5) / n as f64);
        let mean = grid(64)
            .flat_map(|a| grid(64).map(move |s| square(std::f64::consts::TAU * a, s)))
            .sum::<f64>()
            / 4096.0;
        let chords_um = 0.1 * mean.sqrt();
        assert!(
            (f.rms_um - chords_um).abs() < 0.05 * chords_um,
            "{frequency_hz} Hz: {} um for {chords_um}",
            f.rms_um
        );
    }
}

#[test]
fn a_10_um_per_s_drift_leaves_no_steady_error() {
    let plant = DesignPlant::eq6(2.5e-3);
    let f = disturbance_figures(&plant, &published(), 10.0).unwrap();
    // The error integrated over time is the drift over K ki: 10 / (428 19.5) um s.
    assert!(f.steady_error_um.abs() < 1e-4, "{f:?}");
    assert!(
        f.peak_um > 0.01 && f.peak_um < 0.1 && f.recovery_s < 0.2,
        "{f:?}"
    );
}

#[test]
fn the_loop_stays_stable_from_half_to_twice_the_gain() {
    for factor in [0.5, 0.7, 1.4, 2.0] {
        for lead in [None, Some(default_lead(2.5e-3))] {
            let pi = if lead.is_some() {
                Pi {
                    lead,
                    ..Pi::new(0.3, 15.0)
                }
            } else {
                Pi::new(PUBLISHED.0, PUBLISHED.1)
            };
            let rig = RigConfig {
                plant: cellpos_plant::TransferFunction::eq6()
                    .scaled(factor)
                    .unwrap(),
                ..RigConfig::eq6(3)
            };
            let rms = hold_rms_um(config(pi, 2e-3), rig.clone(), 6);
            assert!(rms < 0.12, "hold at {factor} x the gain: {rms} um");
            let mut rig = SimulatedRig::new(rig).unwrap();
            run(
                config(pi, 2e-3),
                &mut rig,
                3000,
                |k, fix, _| to(if k < 1000 { 0.0 } else { 10.0 }, fix),
                |k, rig, _| {
                    assert!(
                        k < 2000 || (rig.true_um() - 10.0).abs() < 0.6,
                        "{factor}, tick {k}: {}",
                        rig.true_um()
                    );
                },
            );
        }
    }
}

#[test]
fn a_lost_bead_is_coasted_and_neither_the_integral_nor_neutral_winds_up() {
    let mut rig = SimulatedRig::new(RigConfig::eq6(5)).unwrap();
    let mut at_loss = None;
    run(
        published(),
        &mut rig,
        6000,
        |k, fix, _| LoopInput {
            measurement: (!(3000..5000).contains(&k)).then_some(fix),
            ..to(5.0, fix)
        },
        |k, rig, out| {
            assert_eq!(out.flags.coasting, (3000..5000).contains(&k), "tick {k}");
            if k == 2999 {
                at_loss = Some(out.neutral_um);
            }
            if (3000..5000).contains(&k) {
                let before = at_loss.unwrap();
                assert!(
                    (out.neutral_um - before).abs() < 1e-12,
                    "neutral stays while blind"
                );
                assert!(
                    (out.command_um - before).abs() < 0.3,
                    "tick {k}: {}",
                    out.command_um
                );
            }
            if k > 5200 {
                assert!(
                    (rig.true_um() - 5.0).abs() < 0.6,
                    "back on target: {}",
                    rig.true_um()
                );
            }
        },
    );
}

#[test]
fn a_stuck_bead_that_comes_free_is_never_flung() {
    // Held at 0 while the target is 3 um away, for seconds; PI would wind up to the end of the range.
    for (target_um, hold_ticks) in [(0.3, 4000), (3.0, 3000), (-12.0, 2000), (0.0, 6000)] {
        for seed in 0..3 {
            let mut rig = SimulatedRig::new(RigConfig::eq6(seed)).unwrap();
            let (stuck_from, free_from) = (1000, 1000 + hold_ticks);
            let mut last = 0.0;
            let mut flagged = false;
            run(
                published(),
                &mut rig,
                free_from + 1500,
                |k, fix, rig| {
                    rig.stuck = (stuck_from..free_from).contains(&k);
                    to(if k < stuck_from + 5 { 0.0 } else { target_um }, fix)
                },
                |k, rig, out| {
                    let speed = (rig.true_um() - last).abs();
                    last = rig.true_um();
                    flagged |= out.flags.stuck && k < free_from;
                    if k >= free_from {
                        assert!(
                            speed <= 2.0,
                            "target {target_um}, seed {seed}, tick {k}: {speed} um in a frame"
                        );
                    }
                    if k > free_from + 1200 {
                        assert!(
                            (rig.true_um() - target_um).abs() < 0.6,
                            "goes on to {target_um}: {}",
                            rig.true_um()
                        );
                    }
                },
            );
            assert!(
                flagged || target_um == 0.0,
                "target {target_um}, seed {seed}"
            );
        }
    }
}

#[test]
fn freeze_brings_the_bead_to_rest_and_run_resumes_without_a_bump() {
    let mut rig = SimulatedRig::new(RigConfig {
        neutral_um: 17.0,
        ..RigConfig::eq6(2).noise_free()
    })
    .unwrap();
    let mut positions = Vec::new();
    let mut commands = Vec::new();
    run(
        published(),
        &mut rig,
        4000,
        |k, fix, _| {
            let mode = if (2000..3000).contains(&k) {
                Mode::Freeze
            } else {
                Mode::Run
            };
            LoopInput {
                mode,
                ..to(if k < 1990 { 2.0 } else { 8.0 }, fix)
            }
        },
        |_, rig, out| {
            positions.push(rig.true_um());
            commands.push(out.command_um);
        },
    );
    assert!(
        (positions[2999] - positions[2100]).abs() < 0.01,
        "the bead rests while frozen"
    );
    assert!((commands[2500] - 17.0).abs() < 0.01, "{}", commands[2500]);
    assert!((positions[3999] - 8.0).abs() < 0.05);
}

#[test]
fn park_ramps_to_the_park_displacement_at_no_more_than_the_slew() {
    let limits = Limits {
        slew_um_per_s: 500.0,
        park_um: 1.5,
        ..Limits::default()
    };
    let mut rig = SimulatedRig::new(RigConfig::eq6(2)).unwrap();
    let mut last = 20.0;
    run(
        LoopConfig {
            limits,
            ..published()
        },
        &mut rig,
        100,
        |k, fix, _| LoopInput {
            mode: if k < 10 { Mode::Run } else { Mode::Park },
            ..to(0.0, fix)
        },
        |k, _, out| {
            assert!((out.command_um - last).abs() <= 0.5 + 1e-9);
            if k > 60 {
                assert!((out.command_um - 1.5).abs() < 1e-5, "{}", out.command_um);
            }
            last = out.command_um;
        },
    );
}

#[test]
fn a_copy_of_the_state_goes_on_to_the_same_bits() {
    let pi = Pi {
        lead: Some(default_lead(2.5e-3)),
        ..Pi::new(0.4, 10.0)
    };
    let law = PiLaw::new(pi, 1e-3).unwrap();
    let control = ControlLoop::new(config(pi, 2.4e-3).with(law)).unwrap();
    let mut rig = SimulatedRig::new(RigConfig {
        delay_s: 2.4e-3,
        ..RigConfig::eq6(11)
    })
    .unwrap();
    let mut state = control.start(20.0, 19.0);
    for k in 0..3000 {
        let measurement = (k % 7 != 3).then(|| rig.measure());
        let reference_um = if k % 500 < 250 { 0.0 } else { 3.0 };
        let input = LoopInput {
            measurement,
            reference_um,
            ..LoopInput::default()
        };
        let mut copy = state;
        let out = control.step(&mut state, &input);
        assert_eq!(control.step(&mut copy, &input), out);
        rig.advance(out.command_um);
    }
}

/// True positions over 60 ticks after a loop closes on a reference that stood 10 um away all along.
fn closing_10_um_away(setpoint_weight: f64, seed: u64) -> Vec<f64> {
    let pi = Pi {
        setpoint_weight,
        ..Pi::new(PUBLISHED.0, PUBLISHED.1)
    };
    let law = PiLaw::new(pi, 1e-3).unwrap();
    let control = ControlLoop::new(config(pi, 2e-3).with(law)).unwrap();
    let mut state = control.start(20.0, 20.0);
    let mut rig = SimulatedRig::new(RigConfig::eq6(seed)).unwrap();
    (0..160)
        .filter_map(|k| {
            let mut input = to(10.0, rig.measure());
            if k < 100 {
                // As in arming: something else decides, and the reference is already where it will be.
                input.mode = Mode::Direct(20.0);
            }
            let at = rig.true_um();
            let out = control.step(&mut state, &input);
            rig.advance(out.command_um);
            (k >= 100).then_some(at)
        })
        .collect()
}

#[test]
fn a_loop_that_closes_away_from_its_reference_goes_there_as_on_a_step() {
    for seed in 0..20 {
        let path = closing_10_um_away(Pi::DEFAULT_SETPOINT_WEIGHT, seed);
        let last_outside = path.iter().rposition(|p| (p - 10.0).abs() > 0.5).unwrap();
        assert!(last_outside < 20, "seed {seed}: {last_outside} ms");
        let highest = path.iter().copied().fold(0.0, f64::max);
        assert!(highest < 11.0, "seed {seed}: {highest} um");
    }
    let (low, high) = (closing_10_um_away(0.5, 1), closing_10_um_away(0.9, 1));
    let most = |path: &[f64]| path.iter().copied().fold(0.0, f64::max);
    assert!(
        most(&high) > most(&low) + 0.5,
        "the set-point weight decides: {} and {}",
        most(&low),
        most(&high)
    );
}
