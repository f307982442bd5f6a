//! The board's promises: whatever comes in, and when nothing comes in any more.

use cellpos_firmware_sim::{Board, BoardConfig};
use cellpos_link::{
    Arm, BoardState, Command, Decoder, Fault, Limits, MAX_FRAME, PROTOCOL_VERSION, Refusal,
    Request, Status, ToBoard, ToHost, encode, picometres,
};
use proptest::prelude::*;

fn wire(message: &ToBoard) -> Vec<u8> {
    let mut frame = [0; MAX_FRAME];
    let length = encode(message, &mut frame).unwrap();
    frame[..length].to_vec()
}

/// A board with a host that can speak and listen.
struct Desk {
    board: Board,
    decoder: Decoder<ToHost>,
    now_us: u64,
    seq: u32,
}

impl Desk {
    fn new(config: BoardConfig) -> Self {
        Self {
            board: Board::new(config).unwrap(),
            decoder: Decoder::new(),
            now_us: 0,
            seq: 0,
        }
    }

    fn armed(config: BoardConfig, arm: Arm) -> Self {
        let mut desk = Self::new(config);
        desk.say(ToBoard::Hello {
            protocol: PROTOCOL_VERSION,
        });
        desk.say(ToBoard::Arm(arm));
        assert_eq!(desk.board.state(), BoardState::Armed);
        desk.hear();
        desk
    }

    fn say(&mut self, message: ToBoard) {
        self.board.receive(&wire(&message), self.now_us);
    }

    fn command(&mut self, um: f64, neutral_um: f64) {
        self.seq += 1;
        let command = Command {
            session: 1,
            seq: self.seq,
            time_us: self.now_us,
            displacement_pm: picometres(um).unwrap(),
            neutral_pm: picometres(neutral_um).unwrap(),
        };
        self.say(ToBoard::Command(command));
    }

    fn hear(&mut self) -> Vec<ToHost> {
        let mut heard = Vec::new();
        let mut bytes = [0; 100];
        loop {
            let count = self.board.transmit(&mut bytes);
            if count == 0 {
                return heard;
            }
            let mut rest = &bytes[..count];
            while let Some(message) = self.decoder.next_message(&mut rest) {
                heard.push(message);
            }
        }
    }

    fn status(&mut self) -> Status {
        self.say(ToBoard::StatusRequest);
        self.hear()
            .iter()
            .rev()
            .find_map(|m| match m {
                ToHost::Status(status) => Some(*status),
                _ => None,
            })
            .expect("a status was asked for")
    }

    /// Ticks every 100 us for `ms`; returns the applied displacement after each tick.
    fn run(&mut self, ms: f64) -> Vec<f64> {
        (0..(ms * 10.0) as usize)
            .map(|_| {
                self.now_us += 100;
                self.board.tick(self.now_us)
            })
            .collect()
    }
}

const STEP_UM: f64 = 40.0 / 65535.0;

#[test]
fn a_command_is_applied_to_half_a_converter_step() {
    let mut desk = Desk::armed(BoardConfig::default(), Arm::session(1));
    for um in [20.1, 0.0, 40.0, 13.371_337] {
        for _ in 0..12 {
            desk.command(um, 20.0);
            desk.run(1.0);
        }
        assert!((desk.board.applied_um() - um).abs() <= 0.5 * STEP_UM + 1e-12);
        let code = desk.board.applied_um() / STEP_UM;
        assert!((code - code.round()).abs() < 1e-6, "{code} is not a code");
        let status = desk.status();
        assert_eq!(status.state, BoardState::Running);
        assert_eq!(status.last_seq, Some(desk.seq));
        assert_eq!(
            status.applied_pm,
            picometres(desk.board.applied_um()).unwrap()
        );
    }
}

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
fn old_doubled_reordered_and_foreign_commands_are_ignored_and_counted() {
    let mut desk = Desk::armed(BoardConfig::default(), Arm::session(1));
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
        assert!((desk.board.applied_um() - 21.0).abs() <= STEP_UM);
        assert_eq!(desk.status().ignored, ignored as u32 + 1);
    }
    desk.say(with(1, 105, 22.0));
    desk.run(1.0);
    assert!((desk.board.applied_um() - 22.0).abs() <= STEP_UM);
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

#[test]
fn commands_beyond_the_limits_are_clipped_and_counted() {
    let limits = Limits {
        low_pm: 15_000_000,
        high_pm: 25_000_000,
        slew_nm_per_s: 2_000_000,
    };
    let mut desk = Desk::armed(
        BoardConfig::default(),
        Arm {
            limits: Some(limits),
            ..Arm::session(1)
        },
    );
    let mut previous = desk.board.applied_um();
    for _ in 0..10 {
        desk.command(2000.0, 20.0);
        for um in desk.run(1.0) {
            assert!((um - previous).abs() <= 0.2 + STEP_UM, "2 um/ms at most");
            previous = um;
        }
    }
    assert!((desk.board.applied_um() - 25.0).abs() <= STEP_UM);
    assert_eq!(desk.status().clipped, 10);
}

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
fn interpolation_draws_a_straight_line_over_one_command_period() {
    let mut desk = Desk::armed(
        BoardConfig::default(),
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
fn a_command_held_up_on_its_way_counts_as_late_and_a_slow_clock_does_not() {
    let mut desk = Desk::armed(BoardConfig::default(), Arm::session(1));
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
    let mut desk = Desk::armed(BoardConfig::default(), Arm::session(1));
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
fn the_next_event_is_never_later_than_the_next_change_of_the_output() {
    let mut desk = Desk::armed(BoardConfig::default(), Arm::session(1));
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
                desk.board.applied_um(),
                "changed before the event at {next_us}"
            );
        }
        now_us = next_us;
        assert_eq!(fine.tick(next_us), desk.board.tick(next_us));
    }
    assert_eq!(desk.board.state(), BoardState::Safe);
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

#[derive(Debug, Clone)]
enum Event {
    Tick,
    Bytes(Vec<u8>),
    Message(ToBoard),
}

fn event() -> impl Strategy<Value = Event> {
    let pm = prop_oneof![any::<i32>(), 0..40_000_000_i32];
    let arm = (
        0..3_u16,
        proptest::option::of(0..200_u16),
        proptest::option::of(0..200_u16),
        proptest::option::of(pm.clone()),
        proptest::option::of((0..20_000_000_i32, 20_000_000..40_000_000_i32, any::<u32>())),
        any::<bool>(),
    )
        .prop_map(
            |(session, watchdog_ms, hold_watchdog_ms, park_pm, limits, interpolate)| {
                ToBoard::Arm(Arm {
                    session,
                    watchdog_ms,
                    hold_watchdog_ms,
                    park_pm,
                    limits: limits.map(|(low_pm, high_pm, slew)| Limits {
                        low_pm,
                        high_pm,
                        slew_nm_per_s: slew % 50_000_000,
                    }),
                    interpolate,
                    status_every: 1,
                })
            },
        );
    let command = (0..3_u16, 0..500_u32, any::<u64>(), pm.clone(), pm).prop_map(
        |(session, seq, time_us, displacement_pm, neutral_pm)| {
            ToBoard::Command(Command {
                session,
                seq,
                time_us,
                displacement_pm,
                neutral_pm,
            })
        },
    );
    prop_oneof![
        6 => Just(Event::Tick),
        1 => proptest::collection::vec(any::<u8>(), 0..60).prop_map(Event::Bytes),
        2 => arm.prop_map(Event::Message),
        12 => command.prop_map(Event::Message),
        1 => prop_oneof![
            Just(ToBoard::Freeze),
            Just(ToBoard::Park),
            Just(ToBoard::Disarm),
            Just(ToBoard::StatusRequest),
            Just(ToBoard::Hello { protocol: PROTOCOL_VERSION }),
        ].prop_map(Event::Message),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]

    #[test]
    fn whatever_comes_in_the_output_never_leaves_range_or_slew(
        events in proptest::collection::vec((prop_oneof![0..200_u64, 0..50_000_u64, any::<u64>()], any::<bool>(), event()), 1..300),
    ) {
        let config = BoardConfig::default();
        let mut board = Board::new(config).unwrap();
        board.receive(&wire(&ToBoard::Hello { protocol: PROTOCOL_VERSION }), 0);
        let step_um = config.step_um();
        let mut now_us = 0_u64;
        let mut latest_us = 0_u64;
        let mut before_um = board.applied_um();
        // Output and state after the last tick: a tick is sure to have used up the time before it.
        let mut anchor = (0_u64, before_um, board.state());
        for (dt_us, backwards, event) in events {
            now_us = if backwards && dt_us < 200 {
                now_us.saturating_sub(dt_us)
            } else {
                now_us.saturating_add(dt_us % 10_000_000)
            };
            latest_us = latest_us.max(now_us);
            let ticked = matches!(event, Event::Tick);
            match event {
                Event::Tick => {
                    board.tick(now_us);
                }
                Event::Bytes(bytes) => board.receive(&bytes, now_us),
                Event::Message(message) => board.receive(&wire(&message), now_us),
            }
            let after_um = board.applied_um();
            prop_assert!((config.low_um..=config.high_um).contains(&after_um), "{after_um} um");
            let per_call_um = config.slew_um_per_s * 1e-6 * f64::from(config.update_us);
            prop_assert!((after_um - before_um).abs() <= per_call_um + step_um, "{before_um} to {after_um} um in one call");
            let (anchor_us, anchor_um, anchor_state) = anchor;
            let calm = |state| matches!(state, BoardState::Safe | BoardState::Disarmed);
            // A state that was left and entered again within one message cannot be: ticks lie in between.
            let rate = if calm(anchor_state) && ticked && calm(board.state()) { config.ramp_um_per_s } else { config.slew_um_per_s };
            let reach_um = rate * 1e-6 * (latest_us - anchor_us) as f64;
            prop_assert!(
                (after_um - anchor_um).abs() <= reach_um + step_um + 1e-9,
                "{anchor_um} um to {after_um} um in {} us", latest_us - anchor_us
            );
            before_um = after_um;
            if ticked {
                anchor = (latest_us, after_um, board.state());
            } else if !calm(board.state()) {
                anchor.2 = board.state();
            }
        }
    }
}
