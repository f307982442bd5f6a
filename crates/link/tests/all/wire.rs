//! The wire protocol under fire: no byte string makes the decoder panic or accept a bad frame, and it always finds its
//! way back.

use cellpos_link::*;
use proptest::prelude::*;

fn limits() -> impl Strategy<Value = Limits> {
    any::<(i32, i32, u32)>().prop_map(|(low_pm, high_pm, slew_nm_per_s)| Limits {
        low_pm,
        high_pm,
        slew_nm_per_s,
    })
}

fn to_board() -> impl Strategy<Value = ToBoard> {
    prop_oneof![
        any::<u16>().prop_map(|protocol| ToBoard::Hello { protocol }),
        (
            any::<u16>(),
            any::<Option<u16>>(),
            any::<Option<u16>>(),
            any::<Option<i32>>(),
            proptest::option::of(limits()),
            any::<bool>(),
            any::<u16>()
        )
            .prop_map(
                |(session, watchdog_ms, hold_watchdog_ms, park_pm, limits, interpolate, every)| {
                    ToBoard::Arm(Arm {
                        session,
                        watchdog_ms,
                        hold_watchdog_ms,
                        park_pm,
                        limits,
                        interpolate,
                        status_every: every,
                    })
                }
            ),
        any::<(u16, u32, u64, i32, i32)>().prop_map(
            |(session, seq, time_us, displacement_pm, neutral_pm)| {
                ToBoard::Command(Command {
                    session,
                    seq,
                    time_us,
                    displacement_pm,
                    neutral_pm,
                })
            }
        ),
        Just(ToBoard::Freeze),
        Just(ToBoard::Park),
        Just(ToBoard::Disarm),
        any::<bool>().prop_map(|on| ToBoard::Led { on }),
        Just(ToBoard::StatusRequest),
        any::<u32>().prop_map(|token| ToBoard::Ping { token }),
    ]
}

fn longest_status() -> Status {
    Status {
        session: u16::MAX,
        last_seq: Some(u32::MAX),
        last_time_us: u64::MAX,
        state: BoardState::Holding,
        applied_pm: i32::MIN,
        neutral_pm: i32::MIN,
        board_time_us: u64::MAX,
        fault: Fault::ArmTimeout,
        led: true,
        bad_frames: u32::MAX,
        ignored: u32::MAX,
        late: u32::MAX,
        clipped: u32::MAX,
        unsent: u32::MAX,
        holds: u16::MAX,
    }
}

fn frame<M: Message>(message: &M) -> Vec<u8> {
    let mut wire = [0; MAX_FRAME];
    let length = encode(message, &mut wire).unwrap();
    wire[..length].to_vec()
}

fn decode_all<M: Message>(mut bytes: &[u8]) -> (Vec<M>, u32) {
    let mut decoder = Decoder::new();
    let messages = core::iter::from_fn(|| decoder.next_message(&mut bytes)).collect();
    (messages, decoder.bad_frames())
}

/// Part of the messages of a real session.
fn session_traffic() -> Vec<ToBoard> {
    let mut traffic = vec![
        ToBoard::Hello {
            protocol: PROTOCOL_VERSION,
        },
        ToBoard::Arm(Arm::session(3)),
    ];
    traffic.extend((0..200).map(|k| {
        ToBoard::Command(Command {
            session: 3,
            seq: k,
            time_us: u64::from(k) * 1000 + 37,
            displacement_pm: 20_000_000 + 1000 * k as i32,
            neutral_pm: 20_001_234,
        })
    }));
    traffic.extend([ToBoard::Freeze, ToBoard::Park, ToBoard::Disarm]);
    traffic
}

#[test]
fn the_longest_messages_fit_their_bounds() {
    let pm = i32::MIN;
    let limits = Limits {
        low_pm: pm,
        high_pm: pm,
        slew_nm_per_s: u32::MAX,
    };
    let to_host = [
        ToHost::Status(longest_status()),
        ToHost::Identity(Identity {
            protocol: u16::MAX,
            firmware: [255; 3],
            serial: u32::MAX,
            limits,
            ramp_nm_per_s: u32::MAX,
            park_pm: pm,
            dac_bits: 255,
            watchdog_ms: u16::MAX,
            hold_watchdog_ms: u16::MAX,
        }),
        ToHost::Fault {
            fault: Fault::FreezeTimeout,
            board_time_us: u64::MAX,
        },
    ];
    for message in to_host {
        let wire = frame(&message);
        assert!(wire.len() <= MAX_FRAME, "{message:?}: {}", wire.len());
        assert_eq!(decode_all::<ToHost>(&wire), (vec![message], 0));
    }
    let arm = ToBoard::Arm(Arm {
        session: u16::MAX,
        watchdog_ms: Some(u16::MAX),
        hold_watchdog_ms: Some(u16::MAX),
        park_pm: Some(pm),
        limits: Some(limits),
        interpolate: true,
        status_every: u16::MAX,
    });
    assert_eq!(decode_all::<ToBoard>(&frame(&arm)), (vec![arm], 0));
}

#[test]
fn a_typical_command_takes_less_than_a_third_of_a_millisecond_at_921600_baud() {
    let wire = frame(&session_traffic()[150]);
    assert!(wire.len() * 10 * 3 < 922, "{} bytes", wire.len());
}

#[test]
fn an_output_that_is_too_short_is_an_error_at_every_length() {
    let message = ToHost::Status(longest_status());
    let length = frame(&message).len();
    for short in 0..length {
        assert_eq!(
            encode(&message, &mut vec![0; short]),
            Err(EncodeError::OutputTooShort)
        );
    }
    assert_eq!(encode(&message, &mut vec![0; length]), Ok(length));
}

#[test]
fn an_echo_of_the_hosts_own_frames_is_refused() {
    let (messages, bad) = decode_all::<ToHost>(&frame(&ToBoard::StatusRequest));
    assert_eq!((messages.len(), bad), (0, 1));
}

#[test]
fn every_16_bit_code_survives_the_way_over_picometres() {
    for code in 0..=u16::MAX {
        let um = f64::from(code) * 40.0 / 65535.0;
        let back = um_from_picometres(picometres(um).unwrap()) * 65535.0 / 40.0;
        assert_eq!(back.round(), f64::from(code));
    }
    assert_eq!(picometres(f64::NAN), None);
    assert_eq!(picometres(f64::INFINITY), Some(i32::MAX));
    assert_eq!(picometres(-0.250_000_4), Some(-250_000));
    assert_eq!(picometres(-0.250_000_6), Some(-250_001));
}

#[test]
fn sequence_numbers_are_ordered_across_the_wrap() {
    assert_eq!(order(u32::MAX, 0), Order::Newer { skipped: 0 });
    assert_eq!(order(0, u32::MAX), Order::Older);
    assert_eq!(order(9, 9), Order::Same);
    assert_eq!(order(10, 14), Order::Newer { skipped: 3 });
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(512))]

    #[test]
    fn every_message_reads_back_as_it_was_written_whatever_the_pieces(
        messages in proptest::collection::vec(to_board(), 1..20),
        cut in 1_usize..40,
    ) {
        let wire: Vec<u8> = messages.iter().flat_map(frame).collect();
        let mut decoder = Decoder::<ToBoard>::new();
        let mut seen = Vec::new();
        for mut piece in wire.chunks(cut) {
            while let Some(message) = decoder.next_message(&mut piece) {
                seen.push(message);
            }
        }
        prop_assert_eq!(seen, messages);
        prop_assert_eq!(decoder.bad_frames(), 0);
    }

    #[test]
    fn no_byte_string_makes_the_decoder_panic_or_believe_it(
        bytes in proptest::collection::vec(any::<u8>(), 0..2000),
    ) {
        let (messages, bad) = decode_all::<ToBoard>(&bytes);
        prop_assert!(messages.is_empty(), "random bytes pass a CRC-32 with a chance of 2e-10");
        prop_assert!(bad as usize <= bytes.len());
    }

    #[test]
    fn no_byte_string_rich_in_zeros_makes_the_decoder_panic_or_believe_it(
        drawn in proptest::collection::vec(any::<u16>(), 0..2000),
    ) {
        // A fifth each of zeros, ones, twos, bytes of 0xb1, and any byte. (A separate strategy for each byte takes seconds.)
        let bytes: Vec<u8> = drawn
            .iter()
            .map(|n| *[0, 1, 2, 0xb1].get(usize::from(n >> 8) % 5).unwrap_or(&(*n as u8)))
            .collect();
        prop_assert!(decode_all::<ToBoard>(&bytes).0.is_empty());
    }

    #[test]
    fn a_single_flipped_bit_costs_frames_and_never_makes_a_wrong_one(
        message in to_board(),
        bit in any::<prop::sample::Index>(),
    ) {
        let follower = ToBoard::Ping { token: 0xdead_beef };
        let mut wire = frame(&message);
        let flipped = bit.index(wire.len() * 8);
        wire[flipped / 8] ^= 1 << (flipped % 8);
        wire.extend(frame(&follower));
        let (messages, _) = decode_all::<ToBoard>(&wire);
        // A flip in the opening or closing zero leaves the message itself whole at times; nothing else may come out.
        for seen in &messages[..messages.len() - 1] {
            prop_assert_eq!(seen, &message);
        }
        prop_assert_eq!(messages.last(), Some(&follower));
    }

    #[test]
    fn a_truncated_frame_is_dropped_and_the_next_one_read(
        message in to_board(),
        follower in to_board(),
        keep in any::<prop::sample::Index>(),
    ) {
        let mut wire = frame(&message);
        wire.truncate(1 + keep.index(wire.len() - 2));
        let cut_inside = wire.len() > 1;
        wire.extend(frame(&follower));
        let (messages, bad) = decode_all::<ToBoard>(&wire);
        prop_assert_eq!(messages, vec![follower]);
        prop_assert_eq!(bad, u32::from(cut_inside));
    }

    #[test]
    fn garbage_before_a_frame_never_takes_the_frame_with_it(
        garbage in proptest::collection::vec(any::<u8>(), 0..400),
        message in to_board(),
    ) {
        let mut wire = garbage;
        wire.extend(frame(&message));
        prop_assert_eq!(decode_all::<ToBoard>(&wire).0, vec![message]);
    }

    #[test]
    fn a_session_with_bursts_of_garbage_loses_only_the_frames_that_were_hit(
        bursts in proptest::collection::vec((any::<prop::sample::Index>(), proptest::collection::vec(any::<u8>(), 1..50)), 0..12),
    ) {
        let traffic = session_traffic();
        let mut wire: Vec<u8> = traffic.iter().flat_map(frame).collect();
        for (place, burst) in &bursts {
            let at = place.index(wire.len());
            wire.splice(at..at, burst.iter().copied());
        }
        let (messages, _) = decode_all::<ToBoard>(&wire);
        let mut expected = traffic.iter();
        for message in &messages {
            prop_assert!(expected.any(|sent| sent == message), "{message:?} was never sent, or out of order");
        }
        prop_assert!(messages.len() + bursts.len() >= traffic.len());
    }

    #[test]
    fn overwritten_stretches_of_a_session_never_make_a_wrong_message(
        holes in proptest::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..60),
    ) {
        let traffic = session_traffic();
        let mut wire: Vec<u8> = traffic.iter().flat_map(frame).collect();
        for (place, byte) in &holes {
            let at = place.index(wire.len());
            wire[at] = *byte;
        }
        let (messages, _) = decode_all::<ToBoard>(&wire);
        let mut expected = traffic.iter();
        for message in &messages {
            prop_assert!(expected.any(|sent| sent == message), "{message:?} was never sent, or out of order");
        }
        prop_assert!(messages.len() + 2 * holes.len() >= traffic.len());
    }
}
