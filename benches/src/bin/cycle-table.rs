//! Cyclic motion with a wrong model: what preview alone leaves, and what learning makes of it.
//!
//!     cargo run --release -p cellpos-benches --bin cycle-table         # -- --adapt 0 --cycles 20 --seeds 5
//!
//! Rig at the level of positions: Eq. (6) with the gain 20 % and the delay 0.25 ms off in either direction, D =
//! 0.33 um^2/s, 20 nm fixes, loop delay 2.5 ms in the model. True positions; the learned error counts from the end of the
//! 20th cycle (`--cycles`) at full amplitude for 1 s, the hold error on the same wrong rig for 4 s. Each line is the worst of seeds 0
//! to 4 and of the four directions, against the hold error of the same rig.

use cellpos_benches::parallel;
use cellpos_benches::simulated::{controllers, loop_config, rms, run, sine};
use cellpos_control::design::{DesignPlant, Uncertainty, harmonic_responses};
use cellpos_control::*;

const FADE_S: f64 = 0.2;

fn rig(gain: f64, late_s: f64, seed: u64) -> RigConfig {
    let eq6 = RigConfig::eq6(seed);
    RigConfig {
        plant: eq6.plant.scaled(gain).expect("a gain above 0"),
        delay_s: eq6.delay_s + late_s,
        ..eq6
    }
}

fn error_nm(
    controller: ControllerConfig,
    rig: RigConfig,
    profile: &Profile,
    learner: Option<&Learner>,
    (from, to): (u64, u64),
) -> f64 {
    let mut errors = Vec::new();
    let mut config = loop_config(controller);
    config.estimator.adapt = parallel::option("--adapt", 0) == 1;
    run(
        config,
        rig,
        profile,
        learner,
        to,
        |_, _| {},
        |seen| {
            if seen.tick >= from {
                errors.push(1e3 * seen.error_um);
            }
        },
    );
    rms(errors.into_iter())
}

fn main() {
    let plant = DesignPlant::eq6(2.5e-3);
    println!(
        "{:<16} {:>16} {:>14} {:>14} {:>14} {:>10} {:>12}",
        "", "", "hold nm", "preview nm", "learned nm", "/hold", "uncertainty"
    );
    for (name, controller) in controllers() {
        if !matches!(name, "lqg" | "mpc, active set") {
            continue;
        }
        for (amplitude_um, frequency_hz) in [
            (5.0, 50.0),
            (5.0, 100.0),
            (1.0, 130.0),
            (1.0, 200.0),
            (0.5, 300.0),
        ] {
            let profile = sine(amplitude_um, frequency_hz, FADE_S);
            let responses = harmonic_responses(
                &plant,
                &loop_config(controller),
                &profile,
                FADE_S,
                frequency_hz,
                3,
                Uncertainty::default(),
            )
            .expect("the nominal loop");
            let learner = Learner::new(LearnConfig::default(), frequency_hz, 1e-3, &responses)
                .expect("a learner");
            let learned_at = (1e3
                * (FADE_S + parallel::option("--cycles", 20) as f64 / frequency_hz))
                .ceil() as u64;
            let span = (learned_at, learned_at + 1000);
            let mut worst = [0.0_f64; 4];
            for gain in [0.8, 1.2] {
                for late_s in [-0.25e-3, 0.25e-3] {
                    for seed in 0..parallel::option("--seeds", 5) {
                        let rig = || rig(gain, late_s, seed);
                        let hold = Profile::Hold { position_um: 0.0 };
                        let hold_nm = error_nm(controller, rig(), &hold, None, (1000, 5000));
                        let preview_nm = error_nm(controller, rig(), &profile, None, span);
                        let learned_nm =
                            error_nm(controller, rig(), &profile, Some(&learner), span);
                        let now = [hold_nm, preview_nm, learned_nm, learned_nm / hold_nm];
                        for (worst, now) in worst.iter_mut().zip(now) {
                            *worst = worst.max(now);
                        }
                    }
                }
            }
            let uncertainty = responses
                .first()
                .map_or(f64::NAN, |response| response.relative_uncertainty);
            println!(
                "{name:<16} {:>16} {:>14.1} {:>14.1} {:>14.1} {:>10.2} {uncertainty:>12.2}",
                format!("{amplitude_um} um, {frequency_hz} Hz"),
                worst[0],
                worst[1],
                worst[2],
                worst[3]
            );
        }
    }
}
