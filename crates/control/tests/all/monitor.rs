//! The plant monitor: silent in normal work, right about a stuck bead, a bubble and a constriction.

use crate::common::config;
use cellpos_control::*;
use cellpos_plant::TransferFunction;
use std::f64::consts::TAU;

fn pi() -> ControllerConfig {
    ControllerConfig::Pi(Pi::new(0.46, 19.5))
}

fn lqg() -> ControllerConfig {
    ControllerConfig::Lqg(Lqg::default())
}

fn sine(amplitude_um: f64, frequency_hz: f64) -> Profile {
    Profile::Wave {
        shape: Shape::Sine,
        centre_um: 0.0,
        amplitude_um,
        frequency_hz,
        fade_s: 0.1,
    }
}

/// 5 um to and fro every 0.4 s.
fn steps() -> Profile {
    Profile::Wave {
        shape: Shape::Square,
        centre_um: 0.0,
        amplitude_um: 2.5,
        frequency_hz: 1.25,
        fade_s: 0.0,
    }
}

/// What happens to the plant half way.
enum Change {
    None,
    Stuck,
    To(TransferFunction),
}

/// Verdicts over a run of 6 s with a change after 3 s, and the last estimate. Gain of the plant by `factor` all along.
fn verdicts(
    controller: ControllerConfig,
    profile: &Profile,
    factor: f64,
    change: &Change,
    seed: u64,
) -> (Vec<PlantVerdict>, Option<PlantEstimate>) {
    const HALF: u64 = 3000;
    let eq6 = RigConfig::eq6(seed);
    let plant = eq6.plant.scaled(factor).unwrap();
    let rig_of = |plant: &TransferFunction| {
        SimulatedRig::new(RigConfig {
            plant: plant.clone(),
            ..eq6.clone()
        })
        .unwrap()
    };
    let mut rig = rig_of(&plant);
    let mut changed = match change {
        Change::To(other) => rig_of(other),
        Change::None | Change::Stuck => rig_of(&plant),
    };
    let config = config(controller);
    let monitor = PlantMonitor::new(config.estimator, config.model).unwrap();
    let mut watching = monitor.start(20.0);
    let mut controller = Controller::new(config).unwrap();
    controller.start(20.0, 20.0);
    let mut preview = vec![0.0; controller.preview_len()];
    let mut offset_um = 0.0;
    let verdicts = (0..2 * HALF)
        .map(|k| {
            if k == HALF {
                // The changed plant takes over where the bead is.
                offset_um = rig.true_um() - changed.true_um();
                changed.stuck = matches!(change, Change::Stuck);
            }
            let (before, after) = (rig.measure(), changed.measure());
            let fix = if k < HALF {
                before
            } else {
                Measurement {
                    position_um: after.position_um + offset_um,
                    ..after
                }
            };
            fill_preview(profile, k, 1e-3, &mut preview);
            let input = LoopInput {
                measurement: Some(fix),
                reference_um: profile.at_um(k as f64 * 1e-3),
                preview_um: &preview,
                ..LoopInput::default()
            };
            let out = controller.step(&input);
            rig.advance(out.command_um);
            changed.advance(out.command_um);
            monitor.step(
                &mut watching,
                Some(fix.position_um),
                out.neutral_um,
                out.command_um,
            )
        })
        .collect();
    (verdicts, monitor.estimate(&watching))
}

#[test]
fn a_normal_hold_step_or_sine_raises_no_alarm_whatever_the_gain_is() {
    for controller in [pi(), lqg()] {
        for profile in [
            Profile::Hold { position_um: 0.0 },
            steps(),
            sine(5.0, 5.0),
            sine(5.0, 50.0),
            sine(2.0, 100.0),
        ] {
            for factor in [0.7, 1.0, 1.3] {
                for seed in 0..3 {
                    let (verdicts, _) = verdicts(controller, &profile, factor, &Change::None, seed);
                    let alarm = verdicts.iter().position(|v| *v != PlantVerdict::Normal);
                    assert_eq!(
                        alarm,
                        None,
                        "{controller:?} {profile:?} x {factor}, seed {seed}: {:?}",
                        verdicts[alarm.unwrap_or(0)]
                    );
                }
            }
        }
    }
}

#[test]
fn gain_and_lag_are_estimated_within_their_intervals() {
    let lag = TransferFunction::new(vec![1.0], vec![1.0 / (TAU * 100.0), 1.0]).unwrap();
    let plant = TransferFunction::eq6();
    for (factor, change, gain, lag_ms) in [
        (1.0, Change::None, 1.0, 0.0),
        (0.8, Change::None, 0.8, 0.0),
        (1.0, Change::To(plant.series(&lag).unwrap()), 1.0, 1.6),
    ] {
        let (_, estimate) = verdicts(pi(), &sine(3.0, 20.0), factor, &change, 4);
        let e = estimate.unwrap();
        assert!(
            (e.gain_ratio - gain).abs() < 0.1 && e.gain_sd < 0.05,
            "{gain}: {e:?}"
        );
        assert!((e.lag_ms - lag_ms).abs() < 0.5, "{lag_ms}: {e:?}");
    }
}

/// The first verdict that is not normal, and after how many ticks from the change.
fn alarm(verdicts: &[PlantVerdict]) -> Option<(PlantVerdict, usize)> {
    assert!(
        verdicts[..3000].iter().all(|v| *v == PlantVerdict::Normal),
        "no alarm before the change"
    );
    let after = verdicts[3000..]
        .iter()
        .position(|v| *v != PlantVerdict::Normal)?;
    Some((verdicts[3000 + after], after))
}

#[test]
fn a_bubble_a_constriction_and_a_stuck_bead_are_called_by_their_names() {
    let plant = TransferFunction::eq6();
    let lag = TransferFunction::new(vec![0.7], vec![3e-3, 1.0]).unwrap();
    let cases = [
        (
            PlantVerdict::Constriction,
            Change::To(plant.scaled(1.8).unwrap()),
        ),
        (
            PlantVerdict::Constriction,
            Change::To(plant.scaled(0.6).unwrap()),
        ),
        (
            PlantVerdict::Bubble,
            Change::To(plant.series(&lag).unwrap()),
        ),
        (PlantVerdict::Stuck, Change::Stuck),
    ];
    for (expected, change) in &cases {
        for profile in [sine(3.0, 20.0), sine(5.0, 50.0)] {
            for seed in 0..3 {
                let (verdicts, _) = verdicts(pi(), &profile, 1.0, change, seed);
                let found = alarm(&verdicts);
                let last = verdicts.last().copied().unwrap();
                assert!(
                    last == *expected && found.is_some_and(|(_, after)| after < 500),
                    "{expected:?} {profile:?}, seed {seed}: first {found:?}, at the end {last:?}"
                );
            }
        }
    }
}
