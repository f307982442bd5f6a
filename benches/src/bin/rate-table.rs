//! Hold error and step at 1, 2 and 5 kHz, compared with the lowest possible hold error.
//!
//!     cargo run --release -p cellpos-benches --bin rate-table
//!
//! Rig without pictures: Eq. (6), D = 0.33 um^2/s, fixes of 5 nm. The camera path is two samples at every rate (loop delay 2.5,
//! 1.25 and 0.5 ms). Weights of the controllers are the defaults, in ticks; range and slew are in force. A step is
//! of 10 um and previewed; its time is the worst of the seeds, Brownian motion included. The last rows have loops faster than
//! their camera: 1 kHz, a path of 2 ms. Their bound accounts for the age of the newest fix. The laws adapt.

use cellpos_benches::simulated::{rms, run};
use cellpos_control::design::bound_rms_um;
use cellpos_control::*;

const SEEDS: u64 = 5;
const HOLD_S: f64 = 20.0;
const FIX_UM: f64 = 0.005;
const D_UM2_PER_S: f64 = 0.33;

struct Rate {
    sample_time_s: f64,
    delay_s: f64,
    /// Ticks from fix to fix.
    every: u32,
}

impl Rate {
    fn config(&self, controller: ControllerConfig) -> LoopConfig {
        LoopConfig {
            model: LoopModel {
                sample_time_s: self.sample_time_s,
                ..LoopModel::eq6(self.delay_s)
            },
            estimator: EstimatorConfig {
                fix_noise_um: FIX_UM,
                ticks_per_fix: f64::from(self.every),
                adapt: true,
                ..EstimatorConfig::default()
            },
            controller,
            limits: Limits::default(),
        }
    }

    fn rig(&self, seed: u64) -> RigConfig {
        RigConfig {
            sample_time_s: self.sample_time_s,
            delay_s: self.delay_s,
            fix_noise_um: FIX_UM,
            diffusion_um2_per_s: D_UM2_PER_S,
            ..RigConfig::eq6(seed)
        }
    }

    fn ticks(&self, time_s: f64) -> u64 {
        (time_s / self.sample_time_s).round() as u64
    }

    /// Hold error, um RMS.
    fn hold(&self, controller: ControllerConfig, seed: u64) -> f64 {
        let mut errors = Vec::new();
        let from = self.ticks(1.0);
        run(
            self.config(controller),
            self.rig(seed),
            &Profile::Hold { position_um: 0.0 },
            None,
            self.ticks(HOLD_S) + from,
            |_, _| {},
            |seen| {
                if seen.tick >= from {
                    errors.push(seen.error_um);
                }
            },
        );
        rms(errors.into_iter())
    }

    /// Time after which a step of 10 um stays within 2 % of its size, ms, and its overshoot, %.
    fn step(&self, controller: ControllerConfig, seed: u64) -> (f64, f64) {
        let at_s = 0.5;
        let points = vec![(0.0, 0.0), (at_s, 0.0), (at_s + 1e-9, 10.0)];
        let profile = Profile::Points(Points::new(points).expect("times grow"));
        let (from, mut last, mut highest) = (self.ticks(at_s), 0, 0.0_f64);
        run(
            self.config(controller),
            self.rig(seed),
            &profile,
            None,
            from + self.ticks(0.06),
            |_, _| {},
            |seen| {
                if seen.tick >= from && (seen.true_um - 10.0).abs() > 0.2 {
                    last = seen.tick + 1 - from;
                }
                highest = highest.max(seen.true_um - 10.0);
            },
        );
        (last as f64 * self.sample_time_s * 1e3, 10.0 * highest)
    }
}

fn main() {
    println!(
        "{:<18} {:>8} {:>9} {:>8} {:>11} {:>10} {:>10} {:>9}",
        "", "rate", "bound nm", "hold nm", "worst seed", "/bound", "2 % ms", "overshoot"
    );
    for (sample_time_s, delay_s, every) in [
        (1e-3, 2e-3, 1),
        (0.5e-3, 1e-3, 1),
        (0.2e-3, 0.4e-3, 1),
        (0.5e-3, 2e-3, 2),
        (0.2e-3, 2e-3, 5),
    ] {
        let rate = Rate {
            sample_time_s,
            delay_s,
            every,
        };
        let older_s = 0.5 * f64::from(every - 1) * sample_time_s;
        let bound = bound_rms_um(D_UM2_PER_S, 0.0, delay_s + older_s, sample_time_s);
        let mpc = ControllerConfig::Mpc(Mpc::default(), Pi::new(0.3, 10.0));
        for (name, controller) in [("lqg", ControllerConfig::Lqg(Lqg::default())), ("mpc", mpc)] {
            let holds: Vec<f64> = (0..SEEDS).map(|seed| rate.hold(controller, seed)).collect();
            let steps: Vec<(f64, f64)> =
                (0..SEEDS).map(|seed| rate.step(controller, seed)).collect();
            let worst = |of: fn(&(f64, f64)) -> f64| steps.iter().map(of).fold(0.0, f64::max);
            let hold = rms(holds.iter().copied());
            let name = if every > 1 {
                format!("{name}, camera 1 kHz")
            } else {
                name.to_owned()
            };
            println!(
                "{name:<18} {:>4.0} kHz {:>9.1} {:>8.1} {:>11.1} {:>10.2} {:>10.1} {:>7.1} %",
                1e-3 / sample_time_s,
                1e3 * bound,
                1e3 * hold,
                1e3 * holds.iter().copied().fold(0.0, f64::max),
                hold / bound,
                worst(|s| s.0),
                worst(|s| s.1),
            );
        }
    }
}
