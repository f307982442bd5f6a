//! A tick that never came does not kick the PZT: not at rest away from zero, not in the middle of a step.

use crate::common::{controller, core, measurement, report};
use cellpos_control::ControllerKind;
use cellpos_runtime::{Action, FrameTally, Life, Request, TickInput};

/// Commands of the ticks `0..ticks`, less those of `skipped`, with the bead where `position_um` has it.
fn commands(
    kind: ControllerKind,
    ticks: u64,
    skipped: std::ops::Range<u64>,
    position_um: impl Fn(u64) -> f64,
) -> Vec<(u64, f64)> {
    let mut core = core(&controller(kind), false);
    let mut commands = Vec::new();
    for k in (0..ticks).filter(|k| !skipped.contains(k)) {
        let arrived = if k == skipped.end {
            skipped.clone().count() as u32 + 1
        } else {
            1
        };
        let stepped = core.step(&TickInput {
            time_ns: k as i64 * 1_000_000,
            measurement: Some(measurement(k, position_um(k))),
            frames: FrameTally {
                arrived,
                superseded: arrived - 1,
                ..FrameTally::default()
            },
            slow_vision_ns: None,
            partner: None,
            board_trouble: None,
            previous_late_ns: None,
            previous_refused: false,
            command_lost: false,
            board: Some(report(k)),
            request: Request::None,
            target_um: None,
            solver: Default::default(),
        });
        let output = stepped.expect("each in a period of its own");
        if let (Life::Running, Action::Command { command_um, .. }) = (core.life(), output.action) {
            commands.push((k, command_um));
        }
    }
    commands
}

fn jump_um(commands: &[(u64, f64)], at: u64) -> f64 {
    let i = commands.iter().position(|&(k, _)| k == at).unwrap();
    commands[i].1 - commands[i - 1].1
}

#[test]
fn a_skipped_tick_changes_the_command_by_no_more_than_the_time_that_passed() {
    // A bead that is pushed off by a steady flow and comes back on its own; 0 um is where it is to be.
    let position_um = |k: u64| 1.5 + 0.002 * (k as f64 - 100.0);
    for kind in [ControllerKind::Pi, ControllerKind::Lead] {
        let through = commands(kind, 400, 0..0, position_um);
        let skipping = commands(kind, 400, 200..203, position_um);
        let a_tick_um = jump_um(&through, 200).abs();
        let after_um = jump_um(&skipping, 203).abs();
        // Four ticks of time at once, and what a lead makes of it; a transfer that is not smooth is 0.5 um.
        assert!(
            after_um <= 4.0 * a_tick_um + 0.02,
            "{kind:?}: {after_um} um after three skipped ticks, {a_tick_um} um a tick otherwise"
        );
    }
}
