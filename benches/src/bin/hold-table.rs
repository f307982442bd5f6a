//! Every controller on one table: hold error against the minimum-variance bound, a 10 um step, previewed sines, spread.
//!
//!     cargo run --release -p cellpos-benches --bin hold-table     # -- --parallel 0
//!
//! Rig at the level of positions (no camera, no board): Eq. (6), D = 0.33 um^2/s, 20 nm fixes, loop delay 2.5 ms. True
//! positions at the ticks, seeds 0 to 4. Errors count from 2 s on, for 10 s. A step is settled if the bead stays within the band
//! until 60 ms after it, Brownian motion included. The band of 2 % is 4 standard deviations of the hold error.

use cellpos_benches::parallel;
use cellpos_benches::simulated::{controllers, loop_config, rms, run, sine};
use cellpos_control::design::{DesignPlant, bound_rms_um, spread};
use cellpos_control::*;

const SEEDS: u64 = 5;

/// True errors (um) and the number of commands that met a limit.
fn errors(
    controller: ControllerConfig,
    seed: u64,
    profile: &Profile,
    ticks: u64,
) -> (Vec<f64>, u32) {
    let (mut errors, mut limited) = (Vec::new(), 0);
    run(
        loop_config(controller),
        RigConfig::eq6(seed),
        profile,
        None,
        ticks,
        |_, _| {},
        |seen| {
            errors.push(seen.error_um);
            let flags = seen.output.flags;
            limited += u32::from(flags.range_limited || flags.slew_limited);
        },
    );
    (errors, limited)
}

fn rms_nm(controller: ControllerConfig, seed: u64, profile: &Profile) -> f64 {
    let (errors, _) = errors(controller, seed, profile, 12_000);
    1e3 * rms(errors.get(2000..).unwrap_or_default().iter().copied())
}

/// What comes of each seed, on the threads that were asked for.
fn of_seeds<R: Send>(of: impl Fn(u64) -> R + Sync) -> Vec<R> {
    let seeds: Vec<u64> = (0..SEEDS).collect();
    parallel::map(&seeds, parallel::threads(), |seed| of(*seed))
}

/// Settling to 5 % and 2 % (ms), overshoot (percent), commands at a limit; the worst of the seeds.
fn step(controller: ControllerConfig) -> (f64, f64, f64, u32) {
    const AT: usize = 300;
    let profile = Profile::Points(
        Points::new(vec![(0.0, 0.0), (0.299_999, 0.0), (0.3, 10.0)]).expect("times grow"),
    );
    let mut worst = (0.0_f64, 0.0_f64, 0.0_f64, 0);
    let of = |seed| errors(controller, seed, &profile, AT as u64 + 60);
    for (errors, limited) in of_seeds(of) {
        let after = errors.get(AT..).unwrap_or_default();
        let settled = |band: f64| {
            after
                .iter()
                .rposition(|e| e.abs() > band)
                .map_or(0.0, |k| (k + 1) as f64)
        };
        let highest = after.iter().copied().fold(0.0, f64::max);
        worst.0 = worst.0.max(settled(0.5));
        worst.1 = worst.1.max(settled(0.2));
        worst.2 = worst.2.max(10.0 * highest);
        worst.3 = worst.3.max(limited);
    }
    worst
}

fn main() {
    let plant = DesignPlant::eq6(2.5e-3);
    let bound_nm = 1e3 * bound_rms_um(0.33, 0.0, 2e-3, 1e-3);
    println!(
        "minimum-variance bound: {bound_nm:.1} nm without localisation noise, {:.1} nm with 20 nm fixes",
        1e3 * bound_rms_um(0.33, 0.020, 2e-3, 1e-3)
    );
    println!(
        "{:<16} {:>9} {:>13} {:>7}   {:>6} {:>6} {:>9} {:>7}   {:>9} {:>9}   stable x 0.5..2, +0/+1 sample",
        "",
        "hold nm",
        "worst seed",
        "/bound",
        "5% ms",
        "2% ms",
        "overshoot",
        "limited",
        "50 Hz nm",
        "100 Hz nm"
    );
    for (name, controller) in controllers() {
        let hold = of_seeds(|seed| rms_nm(controller, seed, &Profile::Hold { position_um: 0.0 }));
        let all = rms(hold.iter().copied());
        let worst = hold.iter().copied().fold(0.0, f64::max);
        let (to_5, to_2, overshoot, limited) = step(controller);
        let followed = |hz: f64| {
            let profile = sine(5.0, hz, 0.5);
            rms(of_seeds(|seed| rms_nm(controller, seed, &profile)).into_iter())
        };
        let (at_50, at_100) = (followed(50.0), followed(100.0));
        let law = controller
            .linear(&EstimatorConfig::default(), &LoopModel::eq6(2e-3))
            .expect("a default controller");
        let rows = spread(&plant, &law).expect("the nominal plant");
        let stable = rows.iter().filter(|row| row.margins.stable).count();
        println!(
            "{name:<16} {all:>9.1} {worst:>13.1} {:>7.2}   {to_5:>6.0} {to_2:>6.0} {overshoot:>8.1}% {limited:>7}   {at_50:>9.0} {at_100:>9.0}   {stable} of {}",
            all / bound_nm,
            rows.len()
        );
    }
}
