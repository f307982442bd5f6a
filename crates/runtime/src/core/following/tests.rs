//! Flows, signs and clips by hand.

use super::*;
use cellpos_numeric::Random;

/// What a loop meets, as functions of time.
struct World<'a> {
    seed: u64,
    /// Gain over the model's at a time.
    gain_ratio: &'a dyn Fn(f64) -> f64,
    axis: f64,
    rate_hz: f64,
    /// Age of a fix at its tick, s.
    late_s: f64,
    /// When fixes become a tick older than that, s.
    later_s: f64,
    /// Displacements that the actuator gives, um.
    range: &'a dyn Fn(f64) -> [f64; 2],
    zero_flow: &'a dyn Fn(f64) -> f64,
    reference: &'a dyn Fn(f64) -> f64,
    /// What is added to the command, um.
    added: &'a dyn Fn(f64) -> f64,
    /// The same against a periodic flow.
    cancels: &'a dyn Fn(f64) -> f64,
    /// Ticks in which the actuator stands where it stood.
    stands: &'a dyn Fn(u64) -> bool,
    /// Side of the dither, um of command, which changes at random every second tick.
    dither_um: f64,
    /// What the picture shakes by, um.
    shakes: &'a dyn Fn(f64) -> f64,
    /// Frequency \[Hz\] and damping of an actuator that rings.
    rings: Option<(f64, f64)>,
    /// Ticks that never come.
    lost: &'a dyn Fn(u64) -> bool,
    seconds: f64,
}

impl Default for World<'_> {
    fn default() -> Self {
        Self {
            seed: 1,
            gain_ratio: &|_| 1.0,
            axis: 1.0,
            rate_hz: 1000.0,
            late_s: 2e-3,
            later_s: f64::INFINITY,
            range: &|_| [0.0, 40.0],
            zero_flow: &|_| 20.0,
            reference: &|_| 0.0,
            added: &|_| 0.0,
            cancels: &|_| 0.0,
            stands: &|_| false,
            dither_um: 0.0,
            shakes: &|_| 0.0,
            rings: None,
            lost: &|_| false,
            seconds: 11.0,
        }
    }
}

/// When it was found, s, how far the bead was, um, and what it was.
type Finding = (f64, f64, Instead);

/// A proportional loop with an integral on an integrator, which pauses when it is told to.
fn found_by(world: &World<'_>) -> Option<Finding> {
    let mut random = Random::new(world.seed);
    let dt = 1.0 / world.rate_hz;
    let model = LoopModel {
        sample_time_s: dt,
        ..LoopModel::integrator(380.0 * world.axis, world.late_s)
    };
    let config = EstimatorConfig::default();
    let mut following = Following::new(&config, &model, world.late_s);
    let late = world.late_s * world.rate_hz;
    let (late, part) = (late.round() as usize, late - late.round());
    let (mut bead_um, mut zero_um, mut command_um) = (0.0, 20.0, 20.0_f64);
    let mut seen = std::collections::VecDeque::from(vec![0.0; late + 3]);
    let (mut reached_um, mut reached_um_per_s) = (20.0, 0.0);
    let (mut side_um, mut stood_um) = (0.0, 20.0);
    for k in 0..(world.seconds * world.rate_hz) as u64 {
        let t = k as f64 * dt;
        let [low_um, high_um] = (world.range)(t);
        let mut asked_um = command_um.clamp(low_um, high_um);
        if let Some((hz, damping)) = world.rings {
            const STEPS: u32 = 50;
            let (w, h) = (std::f64::consts::TAU * hz, dt / f64::from(STEPS));
            let mut sum_um = 0.0;
            for _ in 0..STEPS {
                reached_um_per_s +=
                    h * (w * w * (asked_um - reached_um) - 2.0 * damping * w * reached_um_per_s);
                reached_um += h * reached_um_per_s;
                sum_um += reached_um;
            }
            asked_um = sum_um / f64::from(STEPS);
        }
        if (world.stands)(k) {
            asked_um = stood_um;
        }
        stood_um = asked_um;
        let pushed_um = asked_um - (world.zero_flow)(t);
        bead_um += world.axis * (world.gain_ratio)(t) * 380.0 * dt * pushed_um
            + (0.66 * dt).sqrt() * random.normal();
        seen.push_back(bead_um);
        seen.pop_front();
        if (world.lost)(k) {
            following.skip(command_um);
            continue;
        }
        // Behind the newest by a whole number of ticks, and a part of one before or after that.
        let at = if t < world.later_s { 2 } else { 1 };
        let other = if part > 0.0 {
            seen[at - 1]
        } else {
            seen[at + 1]
        };
        let shown_um = seen[at] + part.abs() * (other - seen[at]);
        let fix_um = shown_um + (world.shakes)(t) + 0.015 * random.normal();
        let reference_um = (world.reference)(t);
        let error_um = world.axis * (fix_um - reference_um);
        zero_um -= 8.0 * dt * error_um;
        let before_um = side_um;
        if k % 2 == 0 && world.dither_um > 0.0 {
            side_um = world.dither_um * random.normal().signum();
        }
        let dither_um = side_um - before_um;
        let driven_um = zero_um - 0.4 * error_um + (world.added)(t) + dither_um;
        // The command of this tick is in force in the next one.
        let cancel_um = (world.cancels)(t + dt);
        let pause_um = following.pause_um();
        command_um = pause_um.unwrap_or(driven_um + cancel_um);
        let cancel_um = if pause_um.is_some() { 0.0 } else { cancel_um };
        command_um = command_um.clamp(0.0, 40.0);
        let found = following.step(&Seen {
            fix: Some((fix_um, 0.015_f64.powi(2))),
            reference_um,
            command_um,
            dither_um,
            cancel_um,
            zero_flow_um: zero_um,
        });
        if let Some((instead, _)) = found {
            return Some((t, error_um, instead));
        }
    }
    None
}

#[test]
fn a_sign_that_flips_is_told_while_the_bead_is_in_the_picture() {
    for rate_hz in [1000.0, 2000.0, 5000.0] {
        for (gain, axis) in [(1.0, 1.0), (1.4, -1.0), (2.0, 1.0)] {
            for seed in 1..=10 {
                let told = found_by(&World {
                    seed,
                    axis,
                    rate_hz,
                    gain_ratio: &|t| if t < 3.0 { gain } else { -gain },
                    seconds: 3.5,
                    ..World::default()
                });
                let in_time = told.is_some_and(|(s, um, instead)| {
                    (3.0..3.12).contains(&s) && um.abs() < 3.0 && instead == Instead::Against
                });
                assert!(in_time, "gain {gain}, {rate_hz} Hz, seed {seed}: {told:?}");
            }
        }
    }
}

/// A flow that rises there and back every 2 s, from 1 % to 99 % in that time.
fn logistic(um: f64, rise_s: f64) -> impl Fn(f64) -> f64 {
    move |t: f64| {
        let p = (t % 2.0) - 1.0;
        let since = (p.abs() - 0.5) * 9.2 / rise_s;
        20.0 + um / (1.0 + since.exp())
    }
}

/// A flow that goes to 2 um and back every second, with a time constant.
fn relaxes(tau_s: f64) -> impl Fn(f64) -> f64 {
    move |t: f64| {
        let since_s = t % 1.0;
        let decays = 2.0 * (-since_s / tau_s).exp();
        if t % 2.0 < 1.0 {
            22.0 - decays
        } else {
            20.0 + decays
        }
    }
}

#[test]
fn half_to_twice_the_gain_and_flows_that_step_drift_or_rise_are_followed() {
    let [fast, middle, slow] = [0.005, 0.02, 0.08].map(relaxes);
    let [small, large, soon] =
        [(2.6, 0.1), (-5.0, 0.1), (2.6, 0.05)].map(|(um, s)| logistic(um, s));
    let flows: [&dyn Fn(f64) -> f64; 11] = [
        &|_| 20.0,
        &|t| 20.0 + 0.2 * t,
        &|t| 10.0 + 6.0 * (t % 4.0 - 2.0).abs(),
        &|t| 20.0 + 0.3 * (t.floor() % 2.0),
        &|t| 20.0 + 2.6 * (t.floor() % 2.0),
        &fast,
        &middle,
        &slow,
        &small,
        &large,
        &soon,
    ];
    for seed in 1..=2 {
        for gain in [0.5, 1.0, 2.0] {
            for (n, zero_flow) in flows.into_iter().enumerate() {
                for hz in [0.0, 1.0, 20.0] {
                    let at = found_by(&World {
                        seed,
                        gain_ratio: &|_| gain,
                        zero_flow,
                        reference: &|t| 5.0 * (std::f64::consts::TAU * hz * t).sin(),
                        seconds: 6.0,
                        ..World::default()
                    });
                    assert_eq!(at, None, "flow {n}, gain {gain}, {hz} Hz, seed {seed}");
                }
            }
        }
    }
}

#[test]
fn an_actuator_that_clips_near_zero_flow_is_told_under_a_slow_law_within_20_um() {
    let levels = [19.8, 19.9, 19.98].map(|um| (um, -1.0)).into_iter();
    for (level_um, side) in levels.chain([20.2, 20.1, 20.02].map(|um| (um, 1.0))) {
        for (seed, axis) in [(1, 1.0), (2, -1.0), (3, 1.0)] {
            let range = |t: f64| match (t > 3.0, side < 0.0) {
                (false, _) => [0.0, 40.0],
                (true, true) => [0.0, level_um],
                (true, false) => [level_um, 40.0],
            };
            let found = found_by(&World {
                seed,
                axis,
                range: &range,
                ..World::default()
            });
            let in_time = found.is_some_and(|(s, um, instead)| {
                s >= 3.0 && um.abs() < 20.0 && instead == Instead::Adrift
            });
            assert!(in_time, "{level_um} um, seed {seed}: {found:?}");
        }
    }
}

#[test]
fn a_delay_that_grows_by_a_tick_leaves_no_side_without_an_answer() {
    for gain in [0.6, 1.0, 1.4] {
        for seed in 1..=4 {
            let found = found_by(&World {
                seed,
                gain_ratio: &|_| gain,
                later_s: 20.0,
                dither_um: DITHER_UM,
                seconds: 60.0,
                ..World::default()
            });
            assert_eq!(found, None, "gain {gain}, seed {seed}");
        }
    }
}

/// Side of a dither that moves the bead 3.6 nm from the middle, um of command.
const DITHER_UM: f64 = 3.6e-3 / 0.38;

#[test]
fn an_actuator_that_follows_on_one_side_only_is_told_from_the_dither() {
    for (above, axis) in [(true, 1.0), (false, 1.0), (true, -1.0)] {
        for beside_um in [0.0, 0.01] {
            // A side that the loop does not ask for shows nothing: a few runs of a hundred have it told later, or not at all.
            let mut told = 0;
            for seed in 1..=20 {
                let range = |t: f64| match (t > 20.0, above) {
                    (false, _) => [0.0, 40.0],
                    (true, true) => [0.0, 20.0 + beside_um],
                    (true, false) => [20.0 - beside_um, 40.0],
                };
                let found = found_by(&World {
                    seed,
                    axis,
                    range: &range,
                    dither_um: DITHER_UM,
                    seconds: 50.0,
                    ..World::default()
                });
                let in_time = found.is_some_and(|(s, um, _)| s >= 20.0 && um.abs() < 5.0);
                told += u32::from(in_time);
            }
            assert!(told >= 17, "{above}, {axis}, {beside_um} um: {told} of 20");
        }
    }
}

#[test]
fn fixes_of_any_age_leave_no_side_without_an_answer() {
    for rate_hz in [1000.0, 5000.0] {
        // Of the first command with a dither, a fix that is little less than a whole number of ticks old shows next to nothing.
        for part in [0.02, 0.5, 0.97, 0.999, 1.0 - 1e-9] {
            for seed in 1..=60 {
                let found = found_by(&World {
                    seed,
                    rate_hz,
                    late_s: 2e-3 + part / rate_hz,
                    // As it moves the bead when the gain has to be learnt, in a tick of any length.
                    dither_um: 2.0 * DITHER_UM * rate_hz / 1e3,
                    seconds: 2.0,
                    ..World::default()
                });
                assert_eq!(found, None, "{part} of a tick, {rate_hz} Hz, seed {seed}");
            }
        }
    }
}

#[test]
fn flows_that_pulse_one_way_leave_no_side_without_an_answer() {
    let strokes = |t: f64| 20.0 + 1.5 * (-(t * 1.4).fract() / 0.05).exp();
    let hum = |t: f64| 20.0 + 0.5 * (std::f64::consts::TAU * 50.0 * t).sin();
    let swings = |t: f64| 20.0 + 1.0 * (std::f64::consts::TAU * 3.0 * t).sin();
    let flows: [&dyn Fn(f64) -> f64; 4] = [&|_| 20.0, &strokes, &hum, &swings];
    for (n, zero_flow) in flows.into_iter().enumerate() {
        for gain in [0.5, 1.0, 2.0] {
            for seed in 1..=2 {
                let found = found_by(&World {
                    seed,
                    gain_ratio: &|_| gain,
                    zero_flow,
                    dither_um: DITHER_UM,
                    seconds: 60.0,
                    ..World::default()
                });
                assert_eq!(found, None, "flow {n}, gain {gain}, seed {seed}");
            }
        }
    }
}

#[test]
fn a_loop_that_loses_ticks_in_fast_motion_is_not_taken_for_one_with_a_wrong_sign() {
    for seed in 1..=10 {
        // A fifth of the ticks, up to eight in a row.
        let lost = |k: u64| {
            let mut random = Random::new(seed * 7919 + k / 8);
            let draw = random.normal().abs();
            draw < 0.5 && (k % 8) as f64 > 12.0 * draw + 2.0
        };
        let told = found_by(&World {
            seed,
            reference: &|t| 3.0 * (t * 95.0).sin() + 2.0 * (t * 311.0).sin(),
            lost: &lost,
            ..World::default()
        });
        assert_eq!(told, None, "seed {seed}");
    }
}

#[test]
fn an_actuator_that_rings_under_many_lines_is_not_taken_for_one_with_a_wrong_sign() {
    const LINES_HZ: [f64; 14] = [
        1.5, 2.5, 4.5, 7.5, 12.5, 20.5, 33.5, 54.5, 87.5, 140.5, 197.5, 293.5, 353.5, 431.5,
    ];
    for seed in 1..=10 {
        for hz in [220.0, 280.0, 340.0] {
            let line = |t: f64, (n, hz): (usize, &f64)| {
                0.05 * (std::f64::consts::TAU * hz * t + (seed * (n * n) as u64) as f64).sin()
            };
            let told = found_by(&World {
                seed,
                rings: Some((hz, 0.1)),
                added: &|t| LINES_HZ.iter().enumerate().map(|of| line(t, of)).sum(),
                seconds: 8.0,
                ..World::default()
            });
            assert_eq!(told, None, "{hz} Hz, seed {seed}");
        }
    }
}

#[test]
fn a_picture_that_shakes_is_not_taken_for_a_bead_that_does_not_follow() {
    for seed in 1..=4 {
        for hz in [8.0, 30.0, 50.0, 77.0, 154.0, 300.0] {
            let told = found_by(&World {
                seed,
                shakes: &|t| 0.5 * (std::f64::consts::TAU * hz * t).sin(),
                seconds: 8.0,
                ..World::default()
            });
            assert_eq!(told, None, "{hz} Hz, seed {seed}");
        }
    }
}

#[test]
fn fast_excitation_and_fixes_of_any_age_are_no_wrong_sign() {
    for late_ms in [1.0, 2.4, 2.6, 4.5, 5.51] {
        for hz in [150.0, 220.0, 300.0] {
            for gain in [0.6, 1.0, 1.6] {
                for seed in 1..=4 {
                    let found = found_by(&World {
                        seed,
                        late_s: late_ms * 1e-3,
                        gain_ratio: &|_| gain,
                        added: &|t| 1.5 * (std::f64::consts::TAU * hz * t).sin(),
                        // A machine that stalls.
                        lost: &|k| k % 371 < 9,
                        seconds: 5.0,
                        ..World::default()
                    });
                    assert_eq!(
                        found, None,
                        "{late_ms} ms, {hz} Hz, gain {gain}, seed {seed}"
                    );
                }
            }
        }
    }
}

/// A line of 100 Hz, 0.3 um of the bead, and an actuator that stands still for 4 ms now and then.
#[test]
fn a_flow_that_is_cancelled_and_an_actuator_that_stalls_are_no_wrong_sign() {
    let line = |t: f64| 0.5 * (std::f64::consts::TAU * 100.0 * t).sin();
    for seed in 1..=20 {
        let found = found_by(&World {
            seed,
            zero_flow: &|t| 20.0 + line(t),
            cancels: &line,
            stands: &|k| k % 237 < 4,
            ..World::default()
        });
        assert_eq!(found, None, "seed {seed}");
    }
}
