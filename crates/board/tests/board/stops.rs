//! How the board stops: silence, freeze, park, disarm, and how it comes back.

use crate::{Desk, STEP_UM};
use cellpos_board::{Board, Config};
use cellpos_link::{
    Arm, BoardState, Fault, Limits, PROTOCOL_VERSION, Refusal, Request, ToBoard, ToHost,
};

#[test]
fn silence_first_goes_to_zero_flow_at_the_slew_and_holds_then_parks_at_its_rate() {
    let limits = Limits {
        slew_nm_per_s: 2_000_000,
        ..Config::DEFAULT.limits
    };
    let arm = Arm {
        hold_watchdog_ms: Some(500),
        limits: Some(limits),
        ..Arm::session(1)
    };
    let mut desk = Desk::armed(Config::default(), arm);
    for _ in 0..50 {
        desk.command(22.0, 19.5);
        desk.run(1.0);
    }
    // The last command is 1 ms old. 18.9 ms later the watchdog of 20 ms has not struck.
    let before = desk.run(18.9);
    assert!(before.iter().all(|um| (um - 22.0).abs() < STEP_UM));
    assert_eq!(desk.board.state(), BoardState::Running);
    desk.hear();
    let way = desk.run(500.0);
    assert_eq!(
        (desk.board.state(), desk.board.fault()),
        (BoardState::Holding, Fault::CommandTimeout)
    );
    let struck_us = 20_000 + 49_000;
    assert!(desk.hear().contains(&ToHost::Fault {
        fault: Fault::CommandTimeout,
        board_time_us: struck_us
    }));
    for (k, um) in way.iter().enumerate() {
        let expected = (22.0 - 0.2 * (k + 1) as f64).max(19.5);
        assert!(
            (um - expected).abs() <= STEP_UM,
            "{k}: {um} against {expected}"
        );
    }
    let ramp = desk.run(30.0);
    assert_eq!(
        (desk.board.state(), desk.board.fault()),
        (BoardState::Safe, Fault::CommandTimeout)
    );
    for (k, um) in ramp.iter().enumerate() {
        let expected = (19.5 - 0.1 * (k + 1) as f64).max(0.0);
        assert!(
            (um - expected).abs() <= STEP_UM,
            "{k}: {um} against {expected}"
        );
    }
    assert_eq!(*ramp.last().unwrap(), 0.0);
}

#[test]
fn a_host_that_comes_back_within_the_hold_watchdog_takes_up_again_and_it_is_counted() {
    let mut desk = Desk::armed(Config::default(), Arm::session(1));
    for stall in 1..=3 {
        desk.command(21.0, 20.0);
        desk.run(50.0);
        let status = desk.status();
        assert_eq!(
            (status.state, status.fault, status.holds),
            (BoardState::Holding, Fault::CommandTimeout, stall)
        );
        assert!((desk.applied_um() - 20.0).abs() <= STEP_UM);
        desk.command(20.5, 20.0);
        desk.run(1.0);
        let status = desk.status();
        assert_eq!(
            (status.state, status.fault, status.holds, status.ignored),
            (BoardState::Running, Fault::None, stall, 0)
        );
        assert!((desk.applied_um() - 20.5).abs() <= STEP_UM);
    }
    // Taken up again, it is watched as before: silence for both times parks.
    desk.run(20.0 + 2_000.0 + 30.0);
    assert_eq!(desk.board.state(), BoardState::Safe);
    assert_eq!(desk.applied_um(), 0.0);
}

#[test]
fn a_clock_that_jumps_over_both_watchdogs_parks() {
    let mut desk = Desk::armed(Config::default(), Arm::session(1));
    desk.command(21.0, 20.0);
    desk.now_us += 60_000_000;
    desk.command(21.0, 20.0);
    assert_eq!(desk.board.state(), BoardState::Safe);
    assert_eq!(desk.status().ignored, 1);
}

#[test]
fn commands_without_an_estimate_of_zero_flow_hold_where_the_output_is() {
    let mut desk = Desk::armed(
        Config::default(),
        Arm {
            watchdog_ms: Some(5),
            ..Arm::session(1)
        },
    );
    desk.say(ToBoard::Freeze);
    let status = desk.status();
    assert_eq!(
        (status.state, status.neutral_pm),
        (BoardState::Frozen, status.applied_pm)
    );
    desk.run(100.0);
    assert!((desk.applied_um() - 20.0).abs() <= STEP_UM);
}

#[test]
fn safe_is_latched_until_the_board_is_armed_again() {
    let arm = Arm {
        hold_watchdog_ms: Some(10),
        ..Arm::session(1)
    };
    let mut desk = Desk::armed(Config::default(), arm);
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
    let held_um = desk.applied_um();
    desk.run(5.0);
    assert_eq!(desk.applied_um(), held_um, "arming moves nothing");
    desk.command(held_um + 1.0, 20.0);
    desk.run(1.0);
    assert_eq!(
        (desk.board.state(), desk.board.fault()),
        (BoardState::Running, Fault::None)
    );
    assert!((desk.applied_um() - held_um - 1.0).abs() <= STEP_UM);
}

#[test]
fn freeze_goes_to_the_last_neutral_estimate_holds_it_and_then_parks() {
    let config = Config::default();
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
    assert_eq!(desk.applied_um(), 0.0);
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
        let mut desk = Desk::armed(Config::default(), arm);
        desk.command(21.0, 20.0);
        desk.say(message);
        desk.run(17.0);
        assert_eq!(desk.board.state(), state);
        assert_eq!(desk.board.fault(), Fault::None);
        assert!((desk.applied_um() - 5.0).abs() <= STEP_UM);
    }
}

#[test]
fn a_board_that_was_never_armed_stays_where_it_was_switched_on() {
    let config = Config::default();
    let power_up_um = f64::from(config.power_up_pm) * 1e-6;
    assert_ne!(config.power_up_pm, config.park_pm);
    let mut desk = Desk::new(config);
    desk.say(ToBoard::Hello {
        protocol: PROTOCOL_VERSION,
    });
    desk.say(ToBoard::Disarm);
    desk.run(50.0);
    assert_eq!(desk.board.state(), BoardState::Disarmed);
    assert!((desk.applied_um() - power_up_um).abs() <= STEP_UM);
}

#[test]
fn ignored_commands_do_not_feed_the_watchdog() {
    let mut desk = Desk::armed(Config::default(), Arm::session(1));
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

#[test]
fn after_a_reset_in_mid_flight_the_output_ramps_to_park_before_anything_else() {
    let config = Config {
        park_pm: 2_000_000,
        ..Config::DEFAULT
    };
    let board = Board::after_reset(config, 23_000_000).unwrap();
    let mut desk = Desk::of(board);
    assert!((desk.applied_um() - 23.0).abs() <= STEP_UM, "no jump");
    let way = desk.run(10.0);
    desk.say(ToBoard::Hello {
        protocol: PROTOCOL_VERSION,
    });
    desk.say(ToBoard::Arm(Arm::session(1)));
    assert_eq!(desk.board.state(), BoardState::Disarmed);
    assert!(desk.hear().contains(&ToHost::Refused {
        request: Request::Arm,
        refusal: Refusal::State,
    }));
    let way: Vec<f64> = way.into_iter().chain(desk.run(20.0)).collect();
    for (k, um) in way.iter().enumerate() {
        let expected = (23.0 - 0.1 * (k + 1) as f64).max(2.0);
        assert!(
            (um - expected).abs() <= STEP_UM,
            "{k}: {um} against {expected}"
        );
    }
    desk.say(ToBoard::Arm(Arm::session(1)));
    assert_eq!(desk.board.state(), BoardState::Armed);
    assert!(Board::after_reset(config, 41_000_000).is_err());
}
