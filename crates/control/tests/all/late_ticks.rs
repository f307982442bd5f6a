//! A loop that is woken late now and then: its fixes are exposed between the ticks.

use cellpos_control::*;
use cellpos_numeric::Random;

const PERIOD_S: f64 = 1e-3;
const DELAY_S: f64 = 2e-3;
/// Steps of the world in a period.
const FINE: usize = 20;
const NEUTRAL_UM: f64 = 20.0;
const DIFFUSION_UM2_PER_S: f64 = 0.33;

/// Brownian motion and flow in fine steps; every position is kept.
struct World {
    random: Random,
    gain_per_s: f64,
    path_um: Vec<f64>,
}

impl World {
    fn advance(&mut self, command_um: f64) {
        let dt = PERIOD_S / FINE as f64;
        let walk_um = (2.0 * DIFFUSION_UM2_PER_S * dt).sqrt() * self.random.normal();
        let here = self.path_um.last().copied().unwrap_or(0.0);
        let flow = self.gain_per_s * (command_um - NEUTRAL_UM);
        self.path_um.push(here + flow * dt + walk_um);
    }
}

/// Holds a bead for 60 s. A frame is exposed every period; now and then the tick that uses it comes `late` periods late.
/// Gives the largest error of the zero-flow displacement after 5 s (um), the RMS error of the position (um), and how often
/// the bead was taken for stuck.
fn hold(seed: u64, late: f64, every: usize) -> (f64, f64, usize) {
    let model = LoopModel::eq6(DELAY_S);
    let mut world = World {
        random: Random::new(seed),
        gain_per_s: model.gain_per_s,
        path_um: vec![0.0; 3 * FINE],
    };
    let mut controller = Controller::new(LoopConfig {
        model,
        estimator: EstimatorConfig::default(),
        controller: ControllerConfig::Pi(Pi::new(0.46, 19.5)),
        limits: Limits::default(),
    })
    .unwrap();
    controller.start(NEUTRAL_UM, NEUTRAL_UM);
    let mut command_um = NEUTRAL_UM;
    let (mut worst_um, mut squares, mut stuck) = (0.0_f64, 0.0, 0);
    let ticks = 60_000;
    for tick in 1..ticks {
        let behind = if tick % every == 0 { late } else { 0.0 };
        let behind_steps = (behind * FINE as f64).round() as usize;
        // The frame of this tick was exposed DELAY_S before the tick was due.
        let exposed = 3 * FINE + tick * FINE - (DELAY_S / PERIOD_S * FINE as f64) as usize;
        while world.path_um.len() <= 3 * FINE + tick * FINE + behind_steps {
            world.advance(command_um);
        }
        let noise_um = 6.5e-4 * world.random.normal();
        let age_samples = (behind + 0.5).floor();
        let out = controller.step(&LoopInput {
            measurement: Some(Measurement {
                position_um: world.path_um[exposed] + noise_um,
                variance_um2: 6.5e-4_f64.powi(2),
                age_samples: age_samples as u16,
                offset_samples: behind - age_samples,
            }),
            ..LoopInput::default()
        });
        command_um = out.command_um;
        if tick > 5000 {
            worst_um = worst_um.max((out.neutral_um - NEUTRAL_UM).abs());
            squares += world.path_um.last().unwrap().powi(2);
            stuck += usize::from(out.flags.stuck);
        }
    }
    (worst_um, (squares / (ticks - 5001) as f64).sqrt(), stuck)
}

#[test]
fn a_tick_that_comes_late_does_not_throw_the_zero_flow_displacement_and_sticks_no_bead() {
    for seed in 1..=3 {
        let (calm_um, rms_um, stuck) = hold(seed, 0.0, 1000);
        assert_eq!(stuck, 0);
        assert!(calm_um < 0.02 && rms_um < 0.065, "{calm_um} {rms_um}");
        for late in [0.2, 0.35, 0.45, 0.55, 0.7] {
            for every in [17, 250] {
                let (worst_um, rms_um, stuck) = hold(seed, late, every);
                println!(
                    "seed {seed} late {late} every {every}: {worst_um:.4} um, {rms_um:.4} um, stuck {stuck}"
                );
                assert_eq!(stuck, 0, "seed {seed}, late by {late}, one in {every}");
                assert!(
                    worst_um < 0.025,
                    "seed {seed}, late by {late}, one in {every}: {worst_um}"
                );
                assert!(
                    rms_um < 0.068,
                    "seed {seed}, late by {late}, one in {every}: {rms_um}"
                );
            }
        }
    }
}

/// Hold error, um RMS, over 20 s of a loop that gets a fix in every so many ticks, 2 ms old.
fn hold_between_fixes(sample_time_s: f64, every: usize) -> f64 {
    let base = crate::common::config(ControllerConfig::Lqg(Lqg::default()));
    let config = LoopConfig {
        model: LoopModel {
            sample_time_s,
            ..LoopModel::eq6(2e-3)
        },
        ..base
    };
    let rig = RigConfig {
        sample_time_s,
        ..RigConfig::eq6(1)
    };
    let mut rig = SimulatedRig::new(rig).unwrap();
    let mut controller = Controller::new(config).unwrap();
    controller.start(20.0, 20.0);
    let preview = vec![0.0; controller.preview_len()];
    let ticks = (20.0 / sample_time_s) as usize;
    let mut squares = 0.0;
    for k in 0..ticks {
        squares += rig.true_um().powi(2);
        let fix = rig.measure();
        let input = LoopInput {
            measurement: k.is_multiple_of(every).then_some(fix),
            preview_um: &preview,
            ..LoopInput::default()
        };
        rig.advance(controller.step(&input).command_um);
    }
    (squares / ticks as f64).sqrt()
}

#[test]
fn a_loop_faster_than_its_camera_holds_better_than_one_as_fast() {
    let as_fast_um = hold_between_fixes(1e-3, 1);
    for (sample_time_s, every) in [(0.5e-3, 2), (0.2e-3, 5)] {
        let hold_um = hold_between_fixes(sample_time_s, every);
        println!("a fix in {every} ticks: {hold_um:.4} um, as fast: {as_fast_um:.4} um");
        assert!(hold_um < as_fast_um, "{hold_um} um, {as_fast_um} um");
    }
}
