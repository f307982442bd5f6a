//! The wire as others see it: the code agrees with `docs/protocol-vectors.json`, and the C99 file under `firmware/c` reads and
//! writes the same bytes.

use crate::wire_in_c::InC;
use cellpos_link::*;
use proptest::prelude::*;
use proptest::strategy::ValueTree;
use proptest::test_runner::{Config, RngAlgorithm, TestRng, TestRunner};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

const TO_BOARD: u8 = 0xb1;

const TO_HOST: u8 = 0x4e;

pub(crate) fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

fn frame<M: Message>(message: &M) -> Vec<u8> {
    let mut wire = [0; MAX_FRAME];
    let length = encode(message, &mut wire).expect("room for the longest");
    wire[..length].to_vec()
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

fn to_board() -> Vec<(&'static str, ToBoard)> {
    let command = |seq, time_us, displacement_pm, neutral_pm| {
        ToBoard::Command(Command {
            session: 0x1234,
            seq,
            time_us,
            displacement_pm,
            neutral_pm,
        })
    };
    vec![
        (
            "hello",
            ToBoard::Hello {
                protocol: PROTOCOL_VERSION,
            },
        ),
        (
            "arm with the board's defaults",
            ToBoard::Arm(Arm::session(1)),
        ),
        (
            "arm with everything given",
            ToBoard::Arm(Arm {
                session: u16::MAX,
                watchdog_ms: Some(20),
                hold_watchdog_ms: Some(2_000),
                park_pm: Some(12_000_000),
                limits: Some(Limits {
                    low_pm: 2_000_000,
                    high_pm: 38_000_000,
                    slew_nm_per_s: 20_000_000,
                }),
                interpolate: true,
                status_every: 10,
            }),
        ),
        ("first command", command(0, 0, 20_000_000, 20_000_000)),
        (
            "a command in the middle",
            command(123_456, 123_456_789, 21_234_567, 19_876_543),
        ),
        ("extremes", command(u32::MAX, u64::MAX, i32::MIN, i32::MAX)),
        ("minus one", command(1, 127, -1, 1)),
        ("groups of seven bits", command(128, 16_384, 63, -64)),
        ("freeze", ToBoard::Freeze),
        ("park", ToBoard::Park),
        ("disarm", ToBoard::Disarm),
        ("led on", ToBoard::Led { on: true }),
        ("led off", ToBoard::Led { on: false }),
        ("status request", ToBoard::StatusRequest),
        ("ping", ToBoard::Ping { token: 0xdead_beef }),
    ]
}

fn status() -> Status {
    Status {
        session: 0x1234,
        last_seq: Some(41),
        last_time_us: 41_000,
        state: BoardState::Running,
        applied_pm: 20_500_000,
        neutral_pm: 20_000_000,
        board_time_us: 1_234_567_890,
        fault: Fault::None,
        led: false,
        bad_frames: 1,
        ignored: 2,
        late: 3,
        clipped: 4,
        unsent: 5,
        holds: 6,
    }
}

fn to_host() -> Vec<(String, ToHost)> {
    let mut all = vec![(
        "identity".to_string(),
        ToHost::Identity(Identity {
            protocol: PROTOCOL_VERSION,
            firmware: [0, 2, 0],
            serial: 386,
            limits: Limits {
                low_pm: 0,
                high_pm: 40_000_000,
                slew_nm_per_s: 40_000_000,
            },
            ramp_nm_per_s: 1_000_000,
            park_pm: 0,
            dac_bits: 16,
            watchdog_ms: 20,
            hold_watchdog_ms: 2_000,
        }),
    )];
    for request in [
        Request::Hello,
        Request::Arm,
        Request::Command,
        Request::Freeze,
        Request::Park,
        Request::Disarm,
        Request::Led,
    ] {
        all.push((format!("ack of {request:?}"), ToHost::Ack { request }));
    }
    for refusal in [
        Refusal::Protocol,
        Refusal::Limits,
        Refusal::Park,
        Refusal::Watchdog,
        Refusal::State,
        Refusal::Busy,
    ] {
        let request = Request::Arm;
        all.push((
            format!("refusal for {refusal:?}"),
            ToHost::Refused { request, refusal },
        ));
    }
    for state in [
        BoardState::Disarmed,
        BoardState::Armed,
        BoardState::Running,
        BoardState::Frozen,
        BoardState::Safe,
        BoardState::Holding,
    ] {
        let message = ToHost::Status(Status { state, ..status() });
        all.push((format!("status {state:?}"), message));
    }
    all.push((
        "status before the first command".to_string(),
        ToHost::Status(Status {
            last_seq: None,
            led: true,
            ..status()
        }),
    ));
    for fault in [
        Fault::None,
        Fault::CommandTimeout,
        Fault::FreezeTimeout,
        Fault::ArmTimeout,
    ] {
        let board_time_us = 69_000;
        all.push((
            format!("fault {fault:?}"),
            ToHost::Fault {
                fault,
                board_time_us,
            },
        ));
    }
    let pong = ToHost::Pong {
        token: 0xdead_beef,
        board_time_us: u64::MAX,
    };
    all.push(("pong".to_string(), pong));
    all
}

/// A frame around any payload, with a check sum that fits.
fn framed(direction: u8, payload: &[u8]) -> Vec<u8> {
    let mut body = vec![direction];
    body.extend(payload);
    let crc = crc::Crc::<u32>::new(&crc::CRC_32_ISO_HDLC).checksum(&body);
    body.extend(crc.to_le_bytes());
    let mut encoded = vec![0; cobs::max_encoding_length(body.len())];
    let length = cobs::encode(&body, &mut encoded);
    let mut wire = vec![0];
    wire.extend(&encoded[..length]);
    wire.push(0);
    wire
}

/// What must not be read, and why.
fn damaged() -> Vec<(&'static str, u8, Vec<u8>)> {
    let command = frame(&to_board()[4].1);
    let flipped = |at: usize| {
        let mut wire = command.clone();
        wire[at] ^= 0x10;
        wire
    };
    let mut torn = command.clone();
    torn.drain(8..11);
    vec![
        ("a flipped bit in the middle", TO_BOARD, flipped(9)),
        (
            "a flipped bit in the check sum",
            TO_BOARD,
            flipped(command.len() - 3),
        ),
        ("three bytes lost", TO_BOARD, torn),
        ("an echo: the other direction", TO_HOST, command.clone()),
        (
            "a code byte that points beyond the end",
            TO_BOARD,
            vec![0, 9, TO_BOARD, 1, 2, 0],
        ),
        (
            "longer than any frame",
            TO_BOARD,
            [vec![0], vec![1; 200], vec![0]].concat(),
        ),
        ("no such message", TO_BOARD, framed(TO_BOARD, &[9])),
        ("a byte left over", TO_BOARD, framed(TO_BOARD, &[3, 0])),
        (
            "a bool that is neither 0 nor 1",
            TO_BOARD,
            framed(TO_BOARD, &[6, 2]),
        ),
        (
            "a number longer than its type",
            TO_BOARD,
            framed(TO_BOARD, &[0, 0x82, 0x80, 0x04]),
        ),
        (
            "a number with more groups than its type",
            TO_BOARD,
            framed(TO_BOARD, &[0, 0x80, 0x80, 0x80, 0x00]),
        ),
        ("no such refusal", TO_HOST, framed(TO_HOST, &[2, 1, 6])),
    ]
}

fn vectors() -> Value {
    let good = |direction: &str, name: &str, message: Value, wire: &[u8]| json!({ "name": name, "direction": direction, "message": message, "wire": hex(wire) });
    let mut all: Vec<Value> = (to_board().iter())
        .map(|(name, message)| good("to board", name, json!(message), &frame(message)))
        .collect();
    all.extend((to_host().iter()).map(|(name, m)| good("to host", name, json!(m), &frame(m))));
    let bad: Vec<Value> = (damaged().iter())
        .map(|(name, direction, wire)| {
            let direction = if *direction == TO_BOARD {
                "to board"
            } else {
                "to host"
            };
            json!({ "name": name, "direction": direction, "wire": hex(wire) })
        })
        .collect();
    json!({ "protocol": PROTOCOL_VERSION, "good": all, "damaged": bad })
}

#[test]
fn the_vectors_in_the_docs_are_what_the_code_says() {
    let path = root().join("docs/protocol-vectors.json");
    let text = serde_json::to_string_pretty(&vectors()).expect("plain data") + "\n";
    if std::env::var_os("CELLPOS_UPDATE_VECTORS").is_some() {
        std::fs::write(&path, &text).expect("the docs can be written");
    }
    let there = std::fs::read_to_string(&path).expect("docs/protocol-vectors.json is there");
    assert!(
        there == text,
        "docs/protocol-vectors.json differs: after a change of the protocol (with a new version number) write it anew with \
         CELLPOS_UPDATE_VECTORS=1 cargo test -p cellpos-link --test all vectors"
    );
}

/// What a decoder finds in bytes: each message encoded again, then the number of bad frames.
fn found(direction: u8, bytes: &[u8]) -> String {
    fn of<M: Message>(mut bytes: &[u8]) -> String {
        let mut decoder = Decoder::<M>::new();
        let mut text = String::new();
        while let Some(message) = decoder.next_message(&mut bytes) {
            text += &hex(&frame(&message));
            text.push(' ');
        }
        text + &decoder.bad_frames().to_string()
    }
    match direction {
        TO_BOARD => of::<ToBoard>(bytes),
        _ => of::<ToHost>(bytes),
    }
}

#[test]
fn good_vectors_are_read_and_damaged_ones_are_counted() {
    for (name, message) in to_board() {
        let wire = frame(&message);
        assert_eq!(
            found(TO_BOARD, &wire),
            format!("{} 0", hex(&wire)),
            "{name}"
        );
    }
    for (name, message) in to_host() {
        let wire = frame(&message);
        assert_eq!(found(TO_HOST, &wire), format!("{} 0", hex(&wire)), "{name}");
    }
    for (name, direction, wire) in damaged() {
        assert_eq!(found(direction, &wire), "1", "{name}");
    }
}

#[test]
fn the_vectors_pass_in_c() {
    let c = InC::compile("vectors");
    let mut strings: Vec<(u8, Vec<u8>)> = Vec::new();
    strings.extend(to_board().iter().map(|(_, m)| (TO_BOARD, frame(m))));
    strings.extend(to_host().iter().map(|(_, m)| (TO_HOST, frame(m))));
    let good = strings.len();
    strings.extend(
        damaged()
            .into_iter()
            .map(|(_, direction, wire)| (direction, wire)),
    );
    let answers = c.found(&strings);
    assert_eq!(answers.len(), strings.len());
    for (k, ((direction, wire), answer)) in strings.iter().zip(&answers).enumerate() {
        let expected = if k < good {
            format!("{} 0", hex(wire))
        } else {
            "1".to_string()
        };
        assert_eq!(*answer, expected, "vector {k}");
        assert_eq!(*answer, found(*direction, wire), "vector {k}");
    }
}

/// Byte strings of every kind that a line delivers: noise; noise rich in zeros; valid check sums around random payloads and
/// near-messages. Also real traffic that was cut, joined and overwritten.
fn any_bytes() -> impl Strategy<Value = (u8, Vec<u8>)> {
    let direction = prop_oneof![Just(TO_BOARD), Just(TO_HOST)];
    let payload = |direction: u8| {
        let real: Vec<Vec<u8>> = match direction {
            TO_BOARD => to_board().iter().map(|(_, m)| frame(m)).collect(),
            _ => to_host().iter().map(|(_, m)| frame(m)).collect(),
        };
        let open = |wire: &[u8]| {
            let mut body = vec![0; wire.len()];
            let length = cobs::decode(&wire[1..wire.len() - 1], &mut body)
                .expect("a frame")
                .frame_size();
            body[1..length - 4].to_vec()
        };
        let payloads: Vec<Vec<u8>> = real.iter().map(|wire| open(wire)).collect();
        let nearly = (
            proptest::sample::select(payloads),
            proptest::collection::vec((any::<proptest::sample::Index>(), any::<u8>()), 0..4),
            proptest::collection::vec(any::<u8>(), 0..3),
        )
            .prop_map(|(mut payload, changes, tail)| {
                for (at, byte) in changes {
                    let at = at.index(payload.len());
                    payload[at] = byte;
                }
                payload.extend(tail);
                payload
            });
        let starting = (0..10_u8, proptest::collection::vec(any::<u8>(), 0..40)).prop_map(
            |(first, mut rest)| {
                rest.insert(0, first);
                rest
            },
        );
        let payload = prop_oneof![3 => nearly, 2 => starting];
        let framed = payload.prop_map(move |payload| framed(direction, &payload));
        let overwritten = (
            proptest::collection::vec(proptest::sample::select(real), 1..4),
            proptest::collection::vec((any::<proptest::sample::Index>(), any::<u8>()), 0..4),
        )
            .prop_map(|(frames, changes)| {
                let mut bytes = frames.concat();
                for (at, byte) in changes {
                    let at = at.index(bytes.len());
                    bytes[at] = byte;
                }
                bytes
            });
        let zeros = prop_oneof![Just(0_u8), any::<u8>(), 0..6_u8];
        prop_oneof![
            2 => proptest::collection::vec(any::<u8>(), 0..120),
            2 => proptest::collection::vec(zeros, 0..120),
            4 => framed,
            2 => overwritten,
        ]
        .prop_map(move |bytes| (direction, bytes))
    };
    direction.prop_flat_map(payload)
}

fn decode_the_same(count: usize, name: &str) {
    let c = InC::compile(name);
    let mut runner = TestRunner::new_with_rng(
        Config::default(),
        TestRng::deterministic_rng(RngAlgorithm::ChaCha),
    );
    let strategy = any_bytes();
    let mut messages = 0;
    for batch in (0..count).step_by(20_000) {
        let strings: Vec<(u8, Vec<u8>)> = (batch..count.min(batch + 20_000))
            .map(|_| strategy.new_tree(&mut runner).expect("no filter").current())
            .collect();
        let in_c = c.found(&strings);
        assert_eq!(in_c.len(), strings.len());
        for ((direction, bytes), answer) in strings.iter().zip(&in_c) {
            assert_eq!(
                *answer,
                found(*direction, bytes),
                "{direction:02x}: {}",
                hex(bytes)
            );
            messages += usize::from(answer.contains(' '));
        }
    }
    println!(
        "{count} byte strings, {messages} of them with messages, decoded the same in Rust and C"
    );
    assert!(messages > count / 10, "too few of them mean anything");
}

#[test]
fn random_byte_strings_decode_the_same_in_rust_and_c() {
    decode_the_same(2_500, "short");
}

#[test]
#[ignore = "a million strings take a minute: cargo test -p cellpos-link --release --test all vectors -- --ignored"]
fn a_million_random_byte_strings_decode_the_same_in_rust_and_c() {
    decode_the_same(1_000_000, "long");
}
