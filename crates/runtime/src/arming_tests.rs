//! The arming pulse against plants that are right, wrong, lost and disturbed.

use super::*;
use std::f64::consts::TAU;

const SAMPLE: Seconds = Seconds(1e-3);
const DELAY: Seconds = Seconds(2e-3);

/// The check of Eq. (6) behind the camera path of these tests.
fn arming_of_eq6(config: ArmingConfig) -> Arming {
    let model = LoopModel::eq6(2e-3);
    let arming = Arming::new(config, &TransferFunction::eq6(), &model, DELAY, 1.0);
    arming.expect("eq6 is a plant")
}

/// A position that comes when it is due.
fn due(position_um: f64) -> Fix {
    Fix {
        position_um,
        late_ticks: 0.0,
    }
}

/// A reproducible jitter of the position.
fn jitter_um(tick: u32) -> f64 {
    0.02 * (f64::from(tick.wrapping_mul(2_654_435_761)) / f64::from(u32::MAX) - 0.5)
}

/// A plant of `factor` times Eq. (6) with drift and a reproducible jitter of the position.
fn run(config: ArmingConfig, factor: f64, blind: impl Fn(u32) -> bool) -> (GainCheck, f64) {
    let (verdict, largest, _) = run_disturbed(config, factor, blind, |_| 0);
    (verdict, largest)
}

/// The same where before a tick others are skipped; gives the pulses made again, too.
fn run_disturbed(
    config: ArmingConfig,
    factor: f64,
    blind: impl Fn(u32) -> bool,
    skipped: impl Fn(u32) -> u32,
) -> (GainCheck, f64, u32) {
    let seen = |tick: u32, um: f64| {
        let position = factor * um + 0.01 * f64::from(tick) + jitter_um(tick);
        (!blind(tick)).then_some(due(position))
    };
    arm(config, DELAY, seen, |tick| Time {
        skipped: skipped(tick),
        ..Time::default()
    })
}

/// How a tick comes.
#[derive(Default)]
struct Time {
    /// Ticks skipped before it.
    skipped: u32,
    /// Whether its frame comes late or not at all; without, a missing position is one of a frame without a bead.
    frames_may_fail: bool,
}

/// Arms Eq. (6) behind a true delay. `seen`: the position that tick makes of the plant's, um. Gives the verdict, how far the PZT went,
/// um, and the pulses made again.
fn arm(
    config: ArmingConfig,
    delay: Seconds,
    mut seen: impl FnMut(u32, f64) -> Option<Fix>,
    time: impl Fn(u32) -> Time,
) -> (GainCheck, f64, u32) {
    let arming = arming_of_eq6(config);
    let plant =
        DiscretePlant::new(&TransferFunction::eq6(), SAMPLE, delay).expect("eq6 is a plant");
    let mut truth = plant.state(0.0);
    let mut state = ArmingState::default();
    let mut command = 20.0;
    let mut largest: f64 = 0.0;
    let mut again = 0;
    for tick in 0..10_000u32 {
        let time = time(tick);
        // The last command stands while the loop does not run.
        for _ in 0..time.skipped {
            plant.step(&mut truth, command - 20.0);
        }
        let fix = seen(tick, plant.output_um(&truth));
        let input = ArmingInput {
            fix,
            framed: !time.frames_may_fail || fix.is_some(),
            command_um: command,
            neutral_um: 20.0,
            disturbed: time.skipped > 0 || time.frames_may_fail,
            led: time.skipped == 0,
            steps: u64::from(time.skipped) + 1,
        };
        match arming.step(&mut state, &input) {
            Step::Command(next) => command = next,
            Step::Again(next, _) | Step::Another(next, _) => {
                command = next;
                again += 1;
            }
            Step::Done(verdict) => return (verdict, largest, again),
        }
        largest = largest.max((command - 20.0).abs());
        plant.step(&mut truth, command - 20.0);
    }
    panic!("arming never ended");
}

#[test]
fn the_pzt_goes_to_the_believed_rest_where_no_bead_is_seen_and_that_may_be_where_it_stands() {
    let arming = arming_of_eq6(ArmingConfig::default());
    // From the start no bead; or one for ten ticks, which moves the belief to `then_um`.
    let stands = |then_um: Option<f64>| {
        let mut state = ArmingState::default();
        let mut command = 12.0;
        for tick in 0..1000 {
            let input = ArmingInput {
                fix: (then_um.is_some() && tick < 10).then_some(due(0.0)),
                framed: true,
                command_um: command,
                neutral_um: then_um.filter(|_| tick >= 10).unwrap_or(20.0),
                disturbed: false,
                led: true,
                steps: 1,
            };
            let step = arming.step(&mut state, &input);
            let Step::Command(next) = step else {
                panic!("given up too soon");
            };
            assert!((next - command).abs() <= 0.1 + 1e-12);
            assert!(
                tick >= 50 || next == 12.0,
                "moved while a bead may come back"
            );
            command = next;
        }
        command
    };
    // It rested where a person had brought the PZT.
    assert_eq!(stands(Some(12.0)), 12.0);
    // It passed, with the flow of a zero flow at 12.6 um.
    assert!((stands(Some(12.6)) - 12.6).abs() < 1e-9);
    assert!((stands(None) - 20.0).abs() < 1e-9);
}

#[test]
fn the_plant_of_the_model_passes_with_a_ratio_of_one() {
    let (verdict, largest) = run(ArmingConfig::default(), 1.0, |_| false);
    assert_eq!(verdict.refusal, None);
    assert!(
        (verdict.gain_ratio - 1.0).abs() < verdict.ci95().max(0.02),
        "{verdict:?}"
    );
    assert_eq!(largest, 0.5);
}

#[test]
fn a_wrong_sign_a_dead_bead_and_a_factor_of_four_are_told_apart() {
    for (factor, refusal) in [
        (-1.0, Refusal::WrongSign),
        (0.0, Refusal::NoResponse),
        (4.0, Refusal::WrongGain),
        (0.2, Refusal::WrongGain),
    ] {
        let (verdict, _) = run(ArmingConfig::default(), factor, |_| false);
        assert_eq!(
            verdict.refusal,
            Some(refusal),
            "factor {factor}: {verdict:?}"
        );
    }
    for factor in [0.5, 2.0] {
        let (verdict, _) = run(ArmingConfig::default(), factor, |_| false);
        assert_eq!(verdict.refusal, None, "factor {factor}");
    }
}

#[test]
fn without_a_steady_bead_the_pzt_never_moves() {
    let (verdict, largest) = run(ArmingConfig::default(), 1.0, |tick| tick % 10 == 0);
    assert_eq!(verdict.refusal, Some(Refusal::NoBead));
    assert_eq!(largest, 0.0);
}

#[test]
fn a_bead_lost_during_the_pulse_is_told_as_that() {
    let (verdict, _) = run(ArmingConfig::default(), 1.0, |tick| tick > 22);
    assert_eq!(verdict.refusal, Some(Refusal::LostInPulse));
}

#[test]
fn a_pulse_in_which_the_loop_stalled_is_made_again_and_not_held_against_the_plant() {
    // Stalls in the upward half: the bead goes on for as long and comes back for the rest only.
    let stalls = |tick| match tick {
        24 | 26 | 28 => 60,
        _ => 0,
    };
    let config = ArmingConfig::default();
    let (verdict, _, again) = run_disturbed(config, 1.0, |_| false, stalls);
    assert_eq!(verdict.refusal, None, "{verdict:?}");
    assert!(again <= 1, "{again}");
    assert!((verdict.gain_ratio - 1.0).abs() < 0.05, "{verdict:?}");
    // A plant that is wrong is refused however the first pulse went.
    let (verdict, _, again) = run_disturbed(config, -1.0, |_| false, stalls);
    assert_eq!((verdict.refusal, again), (Some(Refusal::WrongSign), 1));
}

#[test]
fn what_cannot_be_told_for_stalls_is_said_of_the_stalls_and_not_of_the_plant() {
    let config = ArmingConfig::default();
    let always = |tick| if tick % 3 == 0 { 40 } else { 0 };
    for factor in [1.0, -1.0, 0.0] {
        let (verdict, _, again) = run_disturbed(config, factor, |_| false, always);
        assert_eq!(verdict.refusal, Some(Refusal::Disturbed), "{verdict:?}");
        assert_eq!(again, patience_pulses(config));
    }
    // One stall in every pulse leaves enough of each.
    let now_and_then = |tick| if tick % 23 == 0 { 30 } else { 0 };
    for (factor, refusal) in [
        (1.0, None),
        (-1.0, Some(Refusal::WrongSign)),
        (4.0, Some(Refusal::WrongGain)),
    ] {
        let (verdict, _, _) = run_disturbed(config, factor, |_| false, now_and_then);
        assert_eq!(verdict.refusal, refusal, "{verdict:?}");
    }
}

/// Pulses that patience has room for.
fn patience_pulses(config: ArmingConfig) -> u32 {
    let arming = arming_of_eq6(config);
    arming.config.patience_ticks / arming.program_um.len() as u32
}

/// How late a position comes in each tick, if one comes. Vision takes `cost` ticks for a frame, and then the newest.
fn late_ticks(cost: f64) -> Vec<Option<u32>> {
    let mut late = vec![None; 20_000];
    let mut free = 0.0_f64;
    while let Some(slot) = late.get_mut((free + cost).ceil() as usize) {
        let frame = free.floor();
        *slot = Some(((free + cost).ceil() - frame) as u32);
        free = (frame + 1.0).max(free + cost);
    }
    late
}

#[test]
fn what_does_not_move_is_left_for_another_that_does_and_refused_if_none_comes() {
    // The first pulse sees an object on the glass. Then none is seen for a while, and at last the bead.
    for comes in [Some(450), None] {
        let mut last = 0;
        let seen = |tick: u32, um: f64| {
            last = tick;
            let bead = comes.is_some_and(|comes| tick >= comes).then_some(um);
            let um = if tick < 50 { Some(3.0) } else { bead };
            um.map(|um| due(um + jitter_um(tick)))
        };
        let (verdict, largest, again) =
            arm(ArmingConfig::default(), DELAY, seen, |_| Time::default());
        let (refusal, most) = match comes {
            Some(comes) => (None, comes + 100),
            None => (
                Some(Refusal::NoResponse),
                100 + ArmingConfig::default().patience_ticks,
            ),
        };
        assert_eq!(verdict.refusal, refusal, "{verdict:?}");
        assert!(last < most && again == 1, "{last} {again}");
        assert_eq!(largest, 0.5);
    }
}

#[test]
fn frames_that_come_late_or_never_are_no_reason_to_refuse_and_hide_no_wrong_plant() {
    let always: fn(u32) -> bool = |_| true;
    let mostly: fn(u32) -> bool = |tick| tick % 13 > 2;
    let stretch: fn(u32) -> bool = |tick| tick < 700;
    for slow in [always, mostly, stretch] {
        for cost in [0.4, 1.3, 2.6, 3.7] {
            for (factor, refusal) in [
                (1.0, None),
                (-1.0, Some(Refusal::WrongSign)),
                (4.0, Some(Refusal::WrongGain)),
                (0.0, Some(Refusal::NoResponse)),
            ] {
                let late = late_ticks(cost);
                let mut past_um = vec![];
                let seen = |tick: u32, um: f64| {
                    past_um.push(factor * um + 0.01 * f64::from(tick) + jitter_um(tick));
                    if !slow(tick) {
                        return Some(due(*past_um.last()?));
                    }
                    let late = late.get(tick as usize).copied().flatten()?;
                    let position_um = *past_um.iter().rev().nth(late as usize)?;
                    Some(Fix {
                        position_um,
                        late_ticks: f64::from(late),
                    })
                };
                let (verdict, ..) = arm(ArmingConfig::default(), DELAY, seen, |tick| Time {
                    frames_may_fail: slow(tick),
                    ..Time::default()
                });
                assert_eq!(verdict.refusal, refusal, "{cost} {factor}: {verdict:?}");
                let exact = (verdict.gain_ratio - factor).abs() < 0.02;
                assert!(exact, "{cost} {factor}: {verdict:?}");
            }
        }
    }
}

#[test]
fn frames_that_are_always_late_are_no_reason_to_refuse_and_hide_no_wrong_plant() {
    for (factor, refusal) in [
        (1.0, None),
        (-1.0, Some(Refusal::WrongSign)),
        (4.0, Some(Refusal::WrongGain)),
        (0.0, Some(Refusal::NoResponse)),
    ] {
        // Two ticks later than the model says, told as late, by an age that nobody knows.
        let late = Seconds(DELAY.value() + 2e-3);
        let seen = |_, um: f64| Some(due(factor * um));
        let (verdict, ..) = arm(ArmingConfig::default(), late, seen, |_| Time {
            frames_may_fail: true,
            ..Time::default()
        });
        assert_eq!(verdict.refusal, refusal, "{factor}: {verdict:?}");
    }
}

#[test]
fn a_bead_that_jitters_too_much_for_one_pulse_is_told_by_several() {
    // 0.3 um RMS of white noise: 0.42 um an increment beside the 0.2 um that the pulse makes of it.
    let told = |factor: f64, seed: u32| {
        let mut random = seed;
        let seen = |_, um: f64| {
            let noise: f64 = (0..12)
                .map(|_| {
                    random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                    f64::from(random) / f64::from(u32::MAX) - 0.5
                })
                .sum();
            Some(due(factor * um + 0.3 * noise))
        };
        let (verdict, _, again) = arm(ArmingConfig::default(), DELAY, seen, |_| Time::default());
        (verdict, again)
    };
    let mut most = 0;
    for seed in 0..20 {
        let (verdict, again) = told(1.0, seed);
        assert_eq!(verdict.refusal, None, "seed {seed}: {verdict:?}");
        most = most.max(again);
        let (verdict, _) = told(0.0, seed);
        assert_eq!(verdict.refusal, Some(Refusal::NoResponse), "{verdict:?}");
    }
    assert!(
        most > 0,
        "one pulse was always enough: noise too small to test anything"
    );
}

#[test]
fn the_pulse_takes_a_bead_at_the_border_towards_the_middle_and_back() {
    for start_um in [11.0, -11.0] {
        let (mut nearest, mut farthest) = (f64::INFINITY, 0.0_f64);
        let seen = |_, um: f64| {
            let position = start_um + um;
            (nearest, farthest) = (nearest.min(position.abs()), farthest.max(position.abs()));
            Some(due(position))
        };
        let (verdict, ..) = arm(ArmingConfig::default(), DELAY, seen, |_| Time::default());
        assert_eq!(verdict.refusal, None, "{verdict:?}");
        assert!(farthest < 11.05, "{farthest} um from the middle");
        assert!((8.5..9.5).contains(&nearest), "{nearest} um");
    }
}

#[test]
fn a_few_missing_frames_do_not_matter() {
    let (verdict, _) = run(ArmingConfig::default(), 1.0, |tick| {
        tick > 25 && tick % 7 == 0
    });
    assert_eq!(verdict.refusal, None);
}

/// A bead in Brownian motion (0.33 um^2/s) behind a plant of the model's gain, at these ticks: the check, and how far the pulse moved it, um.
fn arm_in_brownian_motion(
    plant: &TransferFunction,
    model: &LoopModel,
    hum_um: f64,
    seed: u32,
) -> (GainCheck, f64) {
    let sample = Seconds(model.sample_time_s);
    let config = ArmingConfig {
        // 10 ms, or one tick.
        pulse_ticks: (0.01 / sample.value()).ceil() as u32,
        ..ArmingConfig::default()
    };
    let arming = Arming::new(config, plant, model, DELAY, 1.0).expect("a plant");
    let plant = DiscretePlant::new(plant, sample, DELAY).expect("a plant");
    let mut truth = plant.state(0.0);
    let mut state = ArmingState::default();
    let mut random = seed.wrapping_mul(2_654_435_761);
    let mut uniform = || {
        random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        f64::from(random >> 8) / f64::from(1u32 << 24) - 0.5
    };
    let step_um = (2.0 * 0.33 * sample.value()).sqrt();
    let (mut wander_um, mut command, mut farthest) = (0.0, 20.0, 0.0_f64);
    let (turn, mut angle) = (TAU * 50.0 * sample.value(), TAU * uniform());
    loop {
        angle += turn;
        let answer_um = plant.output_um(&truth);
        farthest = farthest.max(answer_um.abs());
        wander_um += step_um * (0..12).map(|_| uniform()).sum::<f64>();
        let input = ArmingInput {
            fix: Some(due(answer_um + wander_um + hum_um * angle.sin())),
            framed: true,
            command_um: command,
            neutral_um: 20.0,
            disturbed: false,
            led: true,
            steps: 1,
        };
        match arming.step(&mut state, &input) {
            Step::Command(next) | Step::Again(next, _) | Step::Another(next, _) => command = next,
            Step::Done(check) => return (check, farthest),
        }
        plant.step(&mut truth, command - 20.0);
    }
}

#[test]
fn the_interval_of_the_gain_holds_behind_a_fast_and_a_slow_actuator() {
    // A regulator of 50 ms and a tube of 20 ms behind commands every 20 ms.
    let behind = |pole: f64, residue: f64| cellpos_control::LoopMode {
        pole_rad_per_s: pole,
        residue_per_s: residue,
    };
    let slow = LoopModel {
        modes: [
            behind(-20.0, -428.0 * 5.0 / 3.0),
            behind(-50.0, 428.0 * 2.0 / 3.0),
        ],
        sample_time_s: 20e-3,
        ..LoopModel::integrator(428.0, 2e-3)
    };
    assert!((slow.lag_s() - 0.07).abs() < 1e-12);
    let lag = |s: f64| TransferFunction::new(vec![1.0], vec![s, 1.0]).expect("a lag");
    let bare = TransferFunction::integrator(428.0).expect("a plant");
    let tube = bare
        .series(&lag(0.05))
        .and_then(|one| one.series(&lag(0.02)))
        .expect("a plant");
    for (name, plant, model, most_sd) in [
        ("1 kHz", TransferFunction::eq6(), LoopModel::eq6(2e-3), 0.04),
        ("20 ms and lags", tube, slow, 0.06),
    ] {
        const RUNS: u32 = 400;
        let (mut inside, mut squares, mut farthest) = (0, 0.0, 0.0_f64);
        for seed in 0..RUNS {
            let (check, far_um) = arm_in_brownian_motion(&plant, &model, 0.0, seed);
            assert_eq!(check.refusal, None, "{name}: {check:?}");
            inside += u32::from((check.gain_ratio - 1.0).abs() < check.ci95());
            squares += (check.gain_ratio - 1.0).powi(2);
            farthest = farthest.max(far_um);
        }
        let (share, sd) = (
            f64::from(inside) / f64::from(RUNS),
            (squares / f64::from(RUNS)).sqrt(),
        );
        println!(
            "{name}: {share:.3} of the intervals hold, sd {sd:.3}, the bead goes {farthest:.2} um"
        );
        // A share of 0.95 of 400 has a standard deviation of 0.011.
        assert!(
            (0.92..0.98).contains(&share) && sd < most_sd,
            "{name}: {share}, {sd}"
        );
        assert!(farthest < 4.5, "{name}: {farthest} um");
    }
}

/// The mains: a pulse of 20 ms is one period.
#[test]
fn a_hum_of_the_pulses_period_is_in_the_interval_that_is_stated() {
    const RUNS: u32 = 400;
    let (plant, model) = (TransferFunction::eq6(), LoopModel::eq6(2e-3));
    let (mut alone, mut stated) = (0, 0);
    for seed in 0..RUNS {
        let (check, _) = arm_in_brownian_motion(&plant, &model, 0.3, seed);
        let off = (check.gain_ratio - 1.0).abs();
        alone += u32::from(off < check.ci95());
        stated += u32::from(off < check.stated95());
    }
    let [alone, stated] = [alone, stated].map(|n| f64::from(n) / f64::from(RUNS));
    println!("{alone:.3} by the increments of the pulse alone, {stated:.3} stated");
    assert!(alone < 0.8 && stated > 0.92, "{alone} {stated}");
}
