//! What becomes of a command: applied, drawn out, clipped, ignored, late.

use crate::{Desk, STEP_UM};
use cellpos_board::Config;
use cellpos_link::{Arm, BoardState, Command, Limits, ToBoard, picometres};

#[test]
fn a_command_is_applied_to_half_a_converter_step() {
    let mut desk = Desk::armed(Config::default(), Arm::session(1));
    for um in [20.1, 0.0, 40.0, 13.371_337] {
        for _ in 0..12 {
            desk.command(um, 20.0);
            desk.run(1.0);
        }
        assert!((desk.applied_um() - um).abs() <= 0.5 * STEP_UM + 1e-6);
        let code = desk.applied_um() / STEP_UM;
        assert_eq!(code.round(), f64::from(desk.board.code()));
        assert!((code - code.round()).abs() < 1e-3, "{code} is not a code");
        let status = desk.status();
        assert_eq!(status.state, BoardState::Running);
        assert_eq!(status.last_seq, Some(desk.seq));
        assert_eq!(status.applied_pm, picometres(desk.applied_um()).unwrap());
    }
}

#[test]
fn interpolation_draws_a_straight_line_over_one_command_period() {
    let mut desk = Desk::armed(
        Config::default(),
        Arm {
            interpolate: true,
            ..Arm::session(1)
        },
    );
    for _ in 0..5 {
        desk.command(20.0, 20.0);
        desk.run(1.0);
    }
    desk.command(21.0, 20.0);
    let way = desk.run(2.0);
    for (k, um) in way.iter().enumerate() {
        let expected = 20.0 + (0.1 * (k + 1) as f64).min(1.0);
        assert!(
            (um - expected).abs() <= STEP_UM,
            "{k}: {um} against {expected}"
        );
    }
}

#[test]
fn commands_beyond_the_limits_are_clipped_and_counted() {
    let limits = Limits {
        low_pm: 15_000_000,
        high_pm: 25_000_000,
        slew_nm_per_s: 2_000_000,
    };
    let mut desk = Desk::armed(
        Config::default(),
        Arm {
            limits: Some(limits),
            ..Arm::session(1)
        },
    );
    let mut previous = desk.applied_um();
    for _ in 0..10 {
        desk.command(2000.0, 20.0);
        for um in desk.run(1.0) {
            assert!((um - previous).abs() <= 0.2 + STEP_UM, "2 um/ms at most");
            previous = um;
        }
    }
    assert!((desk.applied_um() - 25.0).abs() <= STEP_UM);
    assert_eq!(desk.status().clipped, 10);
}

#[test]
fn old_doubled_reordered_and_foreign_commands_are_ignored_and_counted() {
    let mut desk = Desk::armed(Config::default(), Arm::session(1));
    let with = |session, seq, um| {
        ToBoard::Command(Command {
            session,
            seq,
            time_us: 0,
            displacement_pm: picometres(um).unwrap(),
            neutral_pm: 20_000_000,
        })
    };
    desk.say(with(1, 100, 21.0));
    for (ignored, message) in [with(1, 100, 30.0), with(1, 99, 30.0), with(2, 101, 30.0)]
        .into_iter()
        .enumerate()
    {
        desk.say(message);
        desk.run(1.0);
        assert!((desk.applied_um() - 21.0).abs() <= STEP_UM);
        assert_eq!(desk.status().ignored, ignored as u32 + 1);
    }
    desk.say(with(1, 105, 22.0));
    desk.run(1.0);
    assert!((desk.applied_um() - 22.0).abs() <= STEP_UM);
}

#[test]
fn a_command_held_up_on_its_way_counts_as_late_and_a_slow_clock_does_not() {
    let mut desk = Desk::armed(Config::default(), Arm::session(1));
    let mut at = |time_us: u64, now_us: u64, seq: u32| {
        desk.now_us = now_us;
        desk.say(ToBoard::Command(Command {
            session: 1,
            seq,
            time_us,
            displacement_pm: 20_000_000,
            neutral_pm: 20_000_000,
        }));
        desk.status().late
    };
    let mut late = 0;
    for k in 0..100_000_u32 {
        // The host's clock runs 100 ppm slow: after 100 s it is 10 ms behind.
        let now_us = 1000 * u64::from(k);
        late = at(now_us - now_us / 10_000, now_us, k);
    }
    assert_eq!(late, 0);
    let now_us = 100_000_000;
    let host_us = now_us - now_us / 10_000;
    assert_eq!(at(host_us - 2_500, now_us, 200_000), 1);
    assert_eq!(at(host_us - 1_000, now_us, 200_001), 1);
}

#[test]
fn a_host_that_never_reads_costs_messages_and_nothing_else() {
    let mut desk = Desk::armed(Config::default(), Arm::session(1));
    for _ in 0..1000 {
        desk.command(20.5, 20.0);
        desk.run(1.0);
    }
    assert!(desk.board.status().unsent > 900);
    assert_eq!(desk.board.state(), BoardState::Running);
    let heard = desk.hear();
    assert!(heard.len() > 20, "what was kept is whole: {}", heard.len());
    assert_eq!(desk.decoder.bad_frames(), 0);
}

#[test]
fn the_next_event_is_never_later_than_the_next_change_of_the_output() {
    let mut desk = Desk::armed(Config::default(), Arm::session(1));
    desk.command(23.0, 20.0);
    let mut fine = desk.board.clone();
    let mut now_us = desk.now_us;
    // Ticking at events alone gives the same output as ticking at every update period.
    for _ in 0..2000 {
        let next_us = desk.board.next_event_us();
        while now_us + 100 < next_us {
            now_us += 100;
            assert_eq!(
                fine.tick(now_us),
                desk.board.code(),
                "changed before the event at {next_us}"
            );
        }
        now_us = next_us;
        assert_eq!(fine.tick(next_us), desk.board.tick(next_us));
    }
    assert_eq!(desk.board.state(), BoardState::Safe);
}
