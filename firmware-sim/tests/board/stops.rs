//! How the board stops: silence, freeze, park, disarm, and how it comes back.

use crate::{Desk, STEP_UM};
use cellpos_firmware_sim::BoardConfig;
use cellpos_link::{Arm, BoardState, Fault, ToBoard, ToHost};

#[test]
fn silence_ends_in_a_ramp_to_park_that_starts_with_the_watchdog_and_keeps_to_its_rate() {
    let config = BoardConfig::default();
    let mut desk = Desk::armed(config, Arm::session(1));
    for _ in 0..50 {
        desk.command(22.0, 20.0);
        desk.run(1.0);
    }
    // The last command is 1 ms old. 18.9 ms later the watchdog of 20 ms has not struck.
    let before = desk.run(18.9);
    assert!(before.iter().all(|um| (um - 22.0).abs() < STEP_UM));
    assert_eq!(desk.board.state(), BoardState::Running);
    desk.hear();
    let ramp = desk.run(30.0);
    assert_eq!(desk.board.state(), BoardState::Safe);
    assert_eq!(desk.board.fault(), Fault::CommandTimeout);
    let struck_us = 20_000 + 49_000;
    assert!(desk.hear().contains(&ToHost::Fault {
        fault: Fault::CommandTimeout,
        board_time_us: struck_us
    }));
    for (k, um) in ramp.iter().enumerate() {
        let since_strike_s = 100e-6 * (k + 1) as f64;
        let expected = (22.0 - config.ramp_um_per_s * since_strike_s).max(0.0);
        assert!(
            (um - expected).abs() <= STEP_UM,
            "{k}: {um} against {expected}"
        );
    }
    assert_eq!(*ramp.last().unwrap(), 0.0);
}

#[test]
fn safe_is_latched_until_the_board_is_armed_again() {
    let mut desk = Desk::armed(BoardConfig::default(), Arm::session(1));
    desk.command(21.0, 20.0);
    desk.run(50.0);
    assert_eq!(desk.board.state(), BoardState::Safe);
    for _ in 0..20 {
        desk.command(25.0, 20.0);
        desk.run(1.0);
    }
    desk.say(ToBoard::Freeze);
    let status = desk.status();
    assert_eq!(
        (status.state, status.fault, status.ignored),
        (BoardState::Safe, Fault::CommandTimeout, 20)
    );
    desk.say(ToBoard::Arm(Arm::session(1)));
    desk.seq = 0;
    let held_um = desk.board.applied_um();
    desk.run(5.0);
    assert_eq!(desk.board.applied_um(), held_um, "arming moves nothing");
    desk.command(held_um + 1.0, 20.0);
    desk.run(1.0);
    assert_eq!(
        (desk.board.state(), desk.board.fault()),
        (BoardState::Running, Fault::None)
    );
    assert!((desk.board.applied_um() - held_um - 1.0).abs() <= STEP_UM);
}

#[test]
fn freeze_goes_to_the_last_neutral_estimate_holds_it_and_then_parks() {
    let config = BoardConfig::default();
    let mut desk = Desk::armed(
        config,
        Arm {
            hold_watchdog_ms: Some(300),
            ..Arm::session(1)
        },
    );
    for _ in 0..20 {
        desk.command(26.0, 19.5);
        desk.run(1.0);
    }
    desk.say(ToBoard::Freeze);
    let way = desk.run(1.0);
    assert!(
        (way[0] - (26.0 - 4.0)).abs() <= STEP_UM,
        "at the full slew of 40 um/ms"
    );
    assert!((way[1] - 19.5).abs() <= STEP_UM);
    // Commands of a controller that has not noticed are not obeyed.
    desk.command(30.0, 25.0);
    assert!(
        desk.run(290.0)
            .iter()
            .all(|um| (um - 19.5).abs() <= STEP_UM)
    );
    assert_eq!(desk.board.state(), BoardState::Frozen);
    desk.say(ToBoard::Freeze);
    desk.run(299.9);
    assert_eq!(desk.board.state(), BoardState::Frozen, "said again: fed");
    desk.run(60.0);
    assert_eq!(
        (desk.board.state(), desk.board.fault()),
        (BoardState::Safe, Fault::FreezeTimeout)
    );
    assert_eq!(desk.board.applied_um(), 0.0);
}

#[test]
fn park_and_disarm_both_end_at_park_and_only_park_is_latched_as_safe() {
    for (message, state) in [
        (ToBoard::Park, BoardState::Safe),
        (ToBoard::Disarm, BoardState::Disarmed),
    ] {
        let arm = Arm {
            park_pm: Some(5_000_000),
            ..Arm::session(1)
        };
        let mut desk = Desk::armed(BoardConfig::default(), arm);
        desk.command(21.0, 20.0);
        desk.say(message);
        desk.run(17.0);
        assert_eq!(desk.board.state(), state);
        assert_eq!(desk.board.fault(), Fault::None);
        assert!((desk.board.applied_um() - 5.0).abs() <= STEP_UM);
    }
}

#[test]
fn ignored_commands_do_not_feed_the_watchdog() {
    let mut desk = Desk::armed(BoardConfig::default(), Arm::session(1));
    desk.command(21.0, 20.0);
    for _ in 0..25 {
        desk.seq -= 1;
        desk.command(21.0, 20.0);
        desk.say(ToBoard::Ping { token: 1 });
        desk.say(ToBoard::StatusRequest);
        desk.hear();
        desk.run(1.0);
    }
    assert_eq!(desk.board.fault(), Fault::CommandTimeout);
}
