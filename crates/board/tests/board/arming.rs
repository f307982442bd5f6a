//! What the board can be armed with, and configured as.

use crate::Desk;
use cellpos_board::{Board, Config, ConfigError};
use cellpos_link::{Arm, BoardState, Limits, PROTOCOL_VERSION, Refusal, Request, ToBoard, ToHost};

#[test]
fn arming_is_refused_with_the_reason() {
    let mut desk = Desk::new(Config::default());
    let limits = |low_pm, high_pm, slew_nm_per_s| {
        Some(Limits {
            low_pm,
            high_pm,
            slew_nm_per_s,
        })
    };
    let base = Arm::session(1);
    let refused = |desk: &mut Desk, arm: Arm, refusal| {
        desk.say(ToBoard::Arm(arm));
        let heard = desk.hear();
        let expected = ToHost::Refused {
            request: Request::Arm,
            refusal,
        };
        assert!(heard.contains(&expected), "{arm:?}: {heard:?}");
        assert_eq!(desk.board.state(), BoardState::Disarmed);
    };
    refused(&mut desk, base, Refusal::Protocol);
    desk.say(ToBoard::Hello {
        protocol: PROTOCOL_VERSION + 1,
    });
    refused(&mut desk, base, Refusal::Protocol);
    desk.say(ToBoard::Hello {
        protocol: PROTOCOL_VERSION,
    });
    for (arm, refusal) in [
        (
            Arm {
                limits: limits(0, 41_000_000, 1000),
                ..base
            },
            Refusal::Limits,
        ),
        (
            Arm {
                limits: limits(9, 9, 1000),
                ..base
            },
            Refusal::Limits,
        ),
        (
            Arm {
                limits: limits(0, 9_000_000, 0),
                ..base
            },
            Refusal::Limits,
        ),
        (
            Arm {
                limits: limits(0, 9_000_000, 40_000_001),
                ..base
            },
            Refusal::Limits,
        ),
        (
            Arm {
                park_pm: Some(-1),
                ..base
            },
            Refusal::Park,
        ),
        (
            Arm {
                watchdog_ms: Some(0),
                ..base
            },
            Refusal::Watchdog,
        ),
        (
            Arm {
                hold_watchdog_ms: Some(10_001),
                ..base
            },
            Refusal::Watchdog,
        ),
    ] {
        refused(&mut desk, arm, refusal);
    }
}

#[test]
fn the_limits_read_from_the_identity_are_accepted_when_arming() {
    let mut desk = Desk::new(Config::default());
    desk.say(ToBoard::Hello {
        protocol: PROTOCOL_VERSION,
    });
    let Some(ToHost::Identity(identity)) = desk.hear().first().copied() else {
        panic!("a hello is answered by the identity");
    };
    desk.say(ToBoard::Arm(Arm {
        limits: Some(identity.limits),
        ..Arm::session(1)
    }));
    assert_eq!(desk.board.state(), BoardState::Armed);
}

#[test]
fn a_configuration_that_cannot_be_names_what_is_wrong() {
    let of = |change: fn(&mut Config)| {
        let mut config = Config::DEFAULT;
        change(&mut config);
        Board::new(config).unwrap_err()
    };
    assert_eq!(of(|c| c.limits.high_pm = -1), ConfigError::Range);
    assert_eq!(of(|c| c.limits.slew_nm_per_s = 0), ConfigError::Slew);
    assert_eq!(of(|c| c.ramp_nm_per_s = 1_000_000_000), ConfigError::Ramp);
    assert_eq!(of(|c| c.power_up_pm = -1), ConfigError::PowerUp);
    assert_eq!(of(|c| c.park_pm = 41_000_000), ConfigError::Park);
    assert_eq!(of(|c| c.dac_bits = 17), ConfigError::DacBits);
    assert_eq!(of(|c| c.update_us = 0), ConfigError::Update);
    assert_eq!(of(|c| c.hold_watchdog_ms = 0), ConfigError::Watchdog);
}

#[test]
fn a_second_host_cannot_take_a_running_board_and_can_take_one_that_is_left_alone() {
    let mut desk = Desk::armed(Config::default(), Arm::session(1));
    desk.command(21.0, 20.0);
    desk.run(1.0);
    let other = ToBoard::Arm(Arm::session(9));
    desk.say(other);
    let expected = ToHost::Refused {
        request: Request::Arm,
        refusal: Refusal::Busy,
    };
    assert!(desk.hear().contains(&expected));
    assert_eq!(desk.status().session, 1);
    desk.command(21.5, 20.0);
    desk.run(1.0);
    assert_eq!(desk.status().ignored, 0, "the first goes on");
    // Silent for the command watchdog: whoever comes may take over.
    desk.run(20.0);
    desk.say(other);
    let status = desk.status();
    assert_eq!((status.session, status.state), (9, BoardState::Armed));
    desk.command(22.0, 20.0);
    let status = desk.status();
    assert_eq!((status.ignored, status.state), (1, BoardState::Armed));
}
