//! A line in the flow, under ticks that are uneven and slip against the camera.

use crate::apart::{FINE, Flow, NEUTRAL_UM, World, loop_of};
use crate::common::first_seed;
use cellpos_control::*;
use cellpos_numeric::Random;

/// When the ticks of a program come, beside a camera that is on time.
#[derive(Debug, Clone, Copy, Default)]
struct Ticks {
    /// Most by which one comes too early or too late, steps.
    uneven_steps: f64,
    /// Late frames a second: the timer makes the tick, and the frame the next one, which follows soon.
    late_frames: f64,
    /// How fast the camera runs away from the clock, parts of a period in each.
    drift: f64,
}

/// RMS of the bead's position, nm, from 10 s on, while a line of 100 Hz with this amplitude, um, shakes it.
fn held_nm(line_um: f64, ticks: Ticks, seed: u64) -> f64 {
    let law = ControllerConfig::Lqg(Lqg::default());
    let mut controller = Controller::new(loop_of(law, true, 1)).unwrap();
    controller.start(NEUTRAL_UM, NEUTRAL_UM);
    let mut world = World::new(seed, Flow::Lines(100.0, line_um, 1));
    let preview = vec![0.0; controller.preview_len()];
    let mut chance = Random::new(seed ^ 0x5741_11ed);
    let (mut at, mut waits, mut squares) = (0_i64, -1, Vec::new());
    // Where the ticks before say that a tick comes, and how late a late frame is, from the least to the most.
    let (mut place, mut by) = (0.0, 0.0);
    for k in 1..20_000_i64 {
        // Of a late frame the timer makes one tick, and it comes within the next period.
        if waits < 0 && chance.uniform() < 1e-3 * ticks.late_frames {
            waits = 2;
            by = chance.uniform();
        }
        waits = (waits - 1).max(-1);
        let frame = k as f64 * (1.0 + ticks.drift) * FINE as f64;
        let frame = frame.round() as i64;
        let uneven = ticks.uneven_steps * (2.0 * chance.uniform() - 1.0);
        let to = match waits {
            1 => frame + 6 + (6.0 * by) as i64,
            0 => frame - 7 + (7.0 * by) as i64,
            _ => frame + uneven.round() as i64,
        };
        while at < to {
            world.advance(controller.previous_command_um());
            at += 1;
            if k > 10_000 {
                squares.push((1e3 * world.path_um[0]).powi(2));
            }
        }
        let since = (to as f64 - place) / FINE as f64;
        let periods = if since > 1.75 { since.round() } else { 1.0 };
        let late = since - periods;
        place += (periods + late / 16.0) * FINE as f64;
        (1..periods as u32).for_each(|_| controller.skip());
        let older = match waits {
            1 => None,
            0 => Some(to - frame + FINE as i64),
            _ => Some(to - frame),
        };
        let input = LoopInput {
            measurement: older.map(|older| world.fix(older as i32, 1)),
            preview_um: &preview,
            late_samples: late,
            ..LoopInput::default()
        };
        controller.step(&input);
    }
    (squares.iter().sum::<f64>() / squares.len() as f64).sqrt()
}

/// A strong line of 100 Hz moves the bead, and the command against it as far, by 0.6 um in a tick.
#[test]
fn a_line_is_cancelled_by_ticks_that_are_uneven_and_slip() {
    let seeds = first_seed()..first_seed() + 4;
    let mean_nm = |line_um: f64, ticks: Ticks| {
        let held = seeds.clone().map(|seed| held_nm(line_um, ticks, seed));
        held.sum::<f64>() / seeds.clone().count() as f64
    };
    let quiet_nm = mean_nm(0.0, Ticks::default());
    for (late_frames, drift) in [(0.0, 0.0), (2.0, 1e-4), (2.0, -1e-4), (5.0, -1e-3)] {
        let ticks = Ticks {
            uneven_steps: 2.0,
            late_frames,
            drift,
        };
        let over = mean_nm(1.0, ticks) / quiet_nm;
        println!("{ticks:?}: {over:.3}");
        assert!(over < 1.15, "{ticks:?}: {over}");
    }
}
