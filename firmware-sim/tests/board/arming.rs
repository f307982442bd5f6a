//! What the board can be armed with, and configured as.

use crate::Desk;
use cellpos_firmware_sim::{Board, BoardConfig};
use cellpos_link::{Arm, BoardState, Limits, PROTOCOL_VERSION, Refusal, Request, ToBoard, ToHost};

#[test]
fn arming_is_refused_with_the_reason() {
    let mut desk = Desk::new(BoardConfig::default());
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
    let mut desk = Desk::new(BoardConfig {
        high_um: 40.000_000_3,
        ..BoardConfig::default()
    });
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
fn a_configuration_that_cannot_be_names_its_key() {
    let base = BoardConfig::default();
    for (config, key) in [
        (
            BoardConfig {
                high_um: -1.0,
                ..base
            },
            "high_um",
        ),
        (
            BoardConfig {
                slew_um_per_s: f64::NAN,
                ..base
            },
            "slew_um_per_s",
        ),
        (
            BoardConfig {
                ramp_um_per_s: 1e6,
                ..base
            },
            "ramp_um_per_s",
        ),
        (
            BoardConfig {
                park_um: 41.0,
                ..base
            },
            "park_um",
        ),
        (
            BoardConfig {
                dac_bits: 17,
                ..base
            },
            "dac_bits",
        ),
        (
            BoardConfig {
                watchdog_ms: 0,
                ..base
            },
            "watchdog_ms",
        ),
    ] {
        assert_eq!(Board::new(config).unwrap_err().key, key);
    }
}
