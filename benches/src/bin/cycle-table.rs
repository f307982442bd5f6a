//! Cyclic motion with a wrong model: error with preview alone, and with learning.
//!
//!     cargo run --release -p cellpos-benches --bin cycle-table     # -- --adapt 0 --cycles 10 --seeds 10 --parallel 0
//!
//! Rig without pictures: Eq. (6), gain wrong by 20 % and delay by 0.25 ms in either direction. D = 0.33 um^2/s, 20 nm fixes, loop
//! delay 2.5 ms in the model. Errors are true. The learned error counts for 1 s from the end of the 10th cycle (`--cycles`) at
//! full amplitude, the hold error for 4 s on the same rig. Ten seeds and four
//! directions each. "worst cycle": error of a cycle relative to the same cycle without learning (mean of squares over all runs),
//! largest of the first 40. "idle": runs without a learned feed-forward at the end.

use cellpos_benches::parallel;
use cellpos_benches::simulated::{controllers, loop_config, rms, run, sine};
use cellpos_control::design::{DesignPlant, Uncertainty, harmonic_responses};
use cellpos_control::*;
use std::f64::consts::TAU;

const FADE_S: f64 = 0.2;
/// Cycles that are compared one by one.
const CYCLES: usize = 40;
/// Of one sample a tick: 50, 100 and 200 Hz.
const LINES_TICKS: u32 = 20;

/// A motion of the table.
struct Motion {
    name: &'static str,
    profile: Profile,
    frequency_hz: f64,
    harmonics: u32,
}

fn motions() -> Vec<Motion> {
    let one = |name, amplitude_um, frequency_hz| Motion {
        name,
        profile: sine(amplitude_um, frequency_hz, FADE_S),
        frequency_hz,
        harmonics: 3,
    };
    let turn = |i: u32| TAU * f64::from(i) / f64::from(LINES_TICKS);
    let lines = |x: f64| 2.0 * x.sin() + (2.0 * x + 0.7).sin() + 0.5 * (4.0 * x + 2.0).sin();
    vec![
        one("5 um, 50 Hz", 5.0, 50.0),
        one("5 um, 100 Hz", 5.0, 100.0),
        one("1 um, 130 Hz", 1.0, 130.0),
        one("1 um, 200 Hz", 1.0, 200.0),
        one("0.5 um, 300 Hz", 0.5, 300.0),
        one("18 um, 50 Hz", 18.0, 50.0),
        Motion {
            name: "50, 100, 200 Hz",
            profile: Profile::Waveform {
                samples_um: (0..LINES_TICKS).map(|i| lines(turn(i))).collect(),
                period_s: f64::from(LINES_TICKS) * 1e-3,
            },
            frequency_hz: 50.0,
            harmonics: 6,
        },
    ]
}

fn rig(&(gain, late_s, seed): &(f64, f64, u64)) -> RigConfig {
    let eq6 = RigConfig::eq6(seed);
    RigConfig {
        plant: eq6.plant.scaled(gain).expect("a gain above 0"),
        delay_s: eq6.delay_s + late_s,
        ..eq6
    }
}

/// True errors tick by tick, nm, and what was learned.
fn errors_nm(
    controller: ControllerConfig,
    rig: RigConfig,
    profile: &Profile,
    learner: Option<&Learner>,
    ticks: u64,
) -> (Vec<f64>, Option<LearnedTable>) {
    let mut errors = Vec::new();
    let mut config = loop_config(controller);
    config.estimator.adapt = parallel::option("--adapt", 1) == 1;
    let learned = run(
        config,
        rig,
        profile,
        learner,
        ticks,
        |_, _| {},
        |seen| errors.push(1e3 * seen.error_um),
    );
    (errors, learned)
}

/// What comes of one rig.
struct Case {
    hold_nm: f64,
    preview_nm: f64,
    learned_nm: f64,
    /// Squares of the errors in each cycle, with learning and without, nm^2.
    cycles: Vec<[f64; 2]>,
    idle: bool,
}

fn case(
    controller: ControllerConfig,
    motion: &Motion,
    learner: &Learner,
    of: &(f64, f64, u64),
) -> Case {
    let cycle_ticks = 1e3 / motion.frequency_hz;
    let start = 1e3 * FADE_S;
    let learned = (start + parallel::option("--cycles", 10) as f64 * cycle_ticks).ceil() as usize;
    let ticks = (learned + 1000).max((start + CYCLES as f64 * cycle_ticks).ceil() as usize) as u64;
    let hold = Profile::Hold { position_um: 0.0 };
    let (held, _) = errors_nm(controller, rig(of), &hold, None, 5000);
    let (without, _) = errors_nm(controller, rig(of), &motion.profile, None, ticks);
    let (with, table) = errors_nm(controller, rig(of), &motion.profile, Some(learner), ticks);
    let span = |errors: &[f64], from: usize, to: usize| rms(errors[from..to].iter().copied());
    let cycle = |errors: &[f64], n: usize| {
        let at = |n: usize| (start + n as f64 * cycle_ticks) as usize;
        span(errors, at(n), at(n + 1)).powi(2)
    };
    Case {
        hold_nm: span(&held, 1000, 5000),
        preview_nm: span(&without, learned, learned + 1000),
        learned_nm: span(&with, learned, learned + 1000),
        cycles: (0..CYCLES)
            .map(|n| [cycle(&with, n), cycle(&without, n)])
            .collect(),
        idle: table.is_some_and(|table| table.harmonics.is_empty()),
    }
}

fn print_row(name: &str, motion: &Motion, cases: &[Case]) {
    let count = cases.len() as f64;
    let mean = |of: fn(&Case) -> f64| cases.iter().map(of).sum::<f64>() / count;
    let worst = cases
        .iter()
        .map(|case| case.learned_nm / case.hold_nm)
        .fold(0.0, f64::max);
    let cycle = (0..CYCLES)
        .map(|n| {
            let sum = |which: usize| cases.iter().map(|case| case.cycles[n][which]).sum::<f64>();
            (sum(0) / sum(1)).sqrt()
        })
        .fold(0.0, f64::max);
    let idle = cases.iter().filter(|case| case.idle).count();
    println!(
        "{name:<16} {:>16} {:>9.1} {:>11.1} {:>11.1} {:>8.2} {worst:>8.2} {cycle:>12.2} {idle:>5} of {count}",
        motion.name,
        mean(|case| case.hold_nm),
        mean(|case| case.preview_nm),
        mean(|case| case.learned_nm),
        mean(|case| case.learned_nm / case.hold_nm),
    );
}

fn main() {
    let plant = DesignPlant::eq6(2.5e-3);
    let seeds = parallel::option("--seeds", 10);
    let rigs: Vec<(f64, f64, u64)> = [0.8, 1.2]
        .into_iter()
        .flat_map(|gain| [-0.25e-3, 0.25e-3].map(|late_s| (gain, late_s)))
        .flat_map(|(gain, late_s)| (0..seeds).map(move |seed| (gain, late_s, seed)))
        .collect();
    println!(
        "{:<16} {:>16} {:>9} {:>11} {:>11} {:>8} {:>8} {:>12} {:>5}",
        "", "", "hold nm", "preview nm", "learned nm", "/hold", "worst", "worst cycle", "idle"
    );
    for (name, controller) in controllers() {
        if !matches!(name, "lqg" | "mpc, active set") {
            continue;
        }
        for motion in motions() {
            let responses = harmonic_responses(
                &plant,
                &loop_config(controller),
                &motion.profile,
                FADE_S,
                motion.frequency_hz,
                motion.harmonics,
                Uncertainty::default(),
            )
            .expect("the nominal loop");
            let config = LearnConfig::default();
            let learner =
                Learner::new(config, motion.frequency_hz, 1e-3, &responses).expect("a learner");
            let cases = parallel::map(&rigs, parallel::threads(), |of| {
                case(controller, &motion, &learner, of)
            });
            print_row(name, &motion, &cases);
        }
    }
}
