//! A bead that sticks to the wall and comes free: how fast it is then, and how often a free one is taken for stuck.
//!
//!     cargo run --release -p cellpos-benches --bin release-table
//!
//! Rig at the level of positions: Eq. (6) with half, all and 1.8 times the gain, D = 0.33 um^2/s, 20 nm fixes, loop delay
//! 2.5 ms. The bead is held for 0.5 to 8 s while the target is 0 to 12 um away; seeds 0 to 9. False verdicts are ticks in
//! which a bead that was never held is flagged, in a minute of holding and a minute of 2 um at 20 Hz.

use cellpos_benches::simulated::{controllers, loop_config, run, sine};
use cellpos_control::*;

const SEEDS: u64 = 10;
const HELD_FROM: u64 = 1000;

fn rig(gain: f64, seed: u64) -> RigConfig {
    let eq6 = RigConfig::eq6(seed);
    RigConfig {
        plant: eq6.plant.scaled(gain).expect("a gain above 0"),
        ..eq6
    }
}

/// Largest speed from the release on, um per frame.
fn peak(controller: ControllerConfig, gain: f64, seed: u64, target_um: f64, held: u64) -> f64 {
    let free_from = HELD_FROM + held;
    let (mut last_um, mut fastest_um) = (0.0, 0.0_f64);
    let profile = Profile::Points(
        Points::new(vec![(0.0, 0.0), (1.005, 0.0), (1.006, target_um)]).expect("times grow"),
    );
    run(
        loop_config(controller),
        rig(gain, seed),
        &profile,
        None,
        free_from + 1000,
        |tick, rig| rig.stuck = (HELD_FROM..free_from).contains(&tick),
        |seen| {
            if seen.tick >= free_from {
                fastest_um = fastest_um.max((seen.true_um - last_um).abs());
            }
            last_um = seen.true_um;
        },
    );
    fastest_um
}

/// Ticks flagged in a minute.
fn false_verdicts(controller: ControllerConfig, gain: f64, profile: &Profile) -> u64 {
    let mut flagged = 0;
    run(
        loop_config(controller),
        rig(gain, 11),
        profile,
        None,
        60_000,
        |_, _| {},
        |seen| flagged += u64::from(seen.output.flags.stuck),
    );
    flagged
}

fn main() {
    println!(
        "{:<16} {:>6} {:>24} {:>26}",
        "", "gain", "peak after release um/ms", "false: holding, 20 Hz"
    );
    for (name, controller) in controllers() {
        for gain in [0.5, 1.0, 1.8] {
            // The solvers give the same law; the interior point takes ten times as long.
            let seeds = if name == "mpc, clarabel" { 1 } else { SEEDS };
            let mut fastest_um = 0.0_f64;
            for seed in 0..seeds {
                for target_um in [0.0, 0.1, 0.3, 1.0, 3.0, -12.0] {
                    for held in [500, 2000, 8000] {
                        fastest_um = fastest_um.max(peak(controller, gain, seed, target_um, held));
                    }
                }
            }
            let hold = Profile::Hold { position_um: 0.0 };
            println!(
                "{name:<16} {gain:>6} {fastest_um:>24.2} {:>18} {:>7}",
                false_verdicts(controller, gain, &hold),
                false_verdicts(controller, gain, &sine(2.0, 20.0, 0.2))
            );
        }
    }
}
