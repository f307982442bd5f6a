//! How the loop adapts: a plant whose gain and delay change under a held bead, and ten hours in which they do not.
//!
//!     cargo run --release -p cellpos-benches --bin adapt-table                  # --seeds 10 --parallel 1
//!     cargo run --release -p cellpos-benches --bin adapt-table -- --hours 10    # the long hold alone
//!
//! Rig at the level of positions: Eq. (6), D = 0.33 um^2/s, 20 nm fixes, loop delay 2.5 ms. Each seed goes through every
//! gain and delay of the spread in a different order: half of the changes are steps, half drift over 20 s. No time stamp shows
//! the additional sample of delay. Each stay is 5 s to adapt and 10 s measured; errors are of the true position,
//! over the lowest possible on the plant in force. Ms is that of the tuning in force on that plant, each second.

use cellpos_benches::adaptation::{Row, hold_through, regimes};
use cellpos_benches::parallel;
use cellpos_benches::simulated::{controllers, loop_config};
use cellpos_control::*;

fn changes(threads: usize, seeds: u64) {
    println!(
        "{:<18} {:>6} {:>13} {:>10} {:>9} {:>10} {:>10}",
        "", "adapt", "hold / bound", "worst", "Ms, worst", "largest um", "above 1.2"
    );
    for (name, controller) in controllers() {
        if name == "mpc, clarabel" {
            continue;
        }
        for adapt in [false, true] {
            let mut config = loop_config(controller);
            config.estimator.adapt = adapt;
            let seeds: Vec<u64> = (0..seeds).collect();
            let rows: Vec<Row> = parallel::map(&seeds, threads, |&seed| {
                hold_through(config, RigConfig::eq6(seed), &regimes(seed))
            })
            .into_iter()
            .flatten()
            .collect();
            let worst = |of: fn(&Row) -> f64| rows.iter().map(of).fold(0.0, f64::max);
            let mean = rows.iter().map(|r| r.over_bound).sum::<f64>() / rows.len() as f64;
            let above = rows
                .iter()
                .filter(|r| r.over_bound.is_nan() || r.over_bound > 1.2)
                .count();
            println!(
                "{name:<18} {:>6} {mean:>13.2} {:>10.2} {:>9.2} {:>10.2} {above:>4} of {}",
                if adapt { "on" } else { "off" },
                worst(|r| r.over_bound),
                worst(|r| r.ms),
                worst(|r| r.peak_um),
                rows.len()
            );
        }
    }
}

/// A hold without a change: share of time with the estimate in its interval, tuning in force, events.
fn long_hold(threads: usize, hours: u64) {
    println!(
        "{:<8} {:>12} {:>16} {:>14} {:>16} {:>7}",
        "", "hold, nm", "gain estimate", "within 95 %", "gain in force", "events"
    );
    let names = ["lqg", "mpc, active set"];
    let chosen: Vec<_> = controllers()
        .into_iter()
        .filter(|(name, _)| names.contains(name))
        .collect();
    let lines = parallel::map(&chosen, threads, |(name, controller)| {
        let mut config = loop_config(*controller);
        config.estimator.adapt = true;
        let mut rig = SimulatedRig::new(RigConfig::eq6(1)).expect("a sound rig");
        let mut controller = Controller::new(config).expect("a sound controller");
        controller.start(20.0, 20.0);
        let preview = vec![0.0; controller.preview_len()];
        let ticks = hours * 3_600_000;
        let (mut events, mut squares, mut within, mut asked) = (0, 0.0, 0, 0);
        let (mut found, mut force) = ([f64::INFINITY, 0.0_f64], [f64::INFINITY, 0.0_f64]);
        for tick in 0..ticks {
            let error_um = rig.true_um();
            squares += error_um * error_um;
            let fix = rig.measure();
            let input = LoopInput {
                measurement: Some(fix),
                preview_um: &preview,
                ..LoopInput::default()
            };
            rig.advance(controller.step(&input).command_um);
            // The estimate remembers some seconds: each second is all but a new one.
            if tick % 1000 != 999 && controller.adaptation().is_none_or(|a| a.news.is_none()) {
                continue;
            }
            let Some(now) = controller.adaptation() else {
                continue;
            };
            events += u64::from(now.news.is_some());
            force = [force[0].min(now.gain), force[1].max(now.gain)];
            if let Some([gain, sd]) = now.gain_estimate.filter(|_| tick > 10_000) {
                found = [found[0].min(gain), found[1].max(gain)];
                asked += 1;
                within += u64::from((gain - 1.0).abs() <= 1.96 * sd);
            }
        }
        format!(
            "{name:<8.7} {:>12.1} {:>8.2} to {:.2} {:>12.1} % {:>8.2} to {:.2} {events:>7}",
            1e3 * (squares / ticks as f64).sqrt(),
            found[0],
            found[1],
            100.0 * within as f64 / f64::from(asked),
            force[0],
            force[1]
        )
    });
    lines.iter().for_each(|line| println!("{line}"));
}

fn main() {
    let threads = parallel::threads();
    match parallel::option("--hours", 0) {
        0 => changes(threads, parallel::option("--seeds", 10)),
        hours => long_hold(threads, hours),
    }
}
