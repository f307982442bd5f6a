//! `docs/camera-vectors.json` holds the camera socket's test vectors: frames with their bytes, and streams to refuse. The code
//! must agree.

use crate::vectors::root;
use cellpos_link::frames::{FrameGatherer, FrameHeader, HEADER_LEN};
use serde_json::{Value, json};

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

fn bytes(hex: &str) -> Vec<u8> {
    let pair = |at| u8::from_str_radix(&hex[at..at + 2], 16).expect("hex");
    (0..hex.len()).step_by(2).map(pair).collect()
}

/// Frames with their pixels as they go over the socket.
fn frames() -> Vec<(&'static str, FrameHeader, Vec<u8>)> {
    let page = FrameHeader {
        frame_id: 77,
        mid_exposure_ns: 123_456_789_012,
        sent_ns: 123_458_789_012,
        exposure_ns: 500_000,
        width: 6,
        height: 2,
        bits: 8,
    };
    let deep = FrameHeader {
        frame_id: 78,
        mid_exposure_ns: page.mid_exposure_ns + 1_000_000,
        sent_ns: page.sent_ns + 1_000_000,
        width: 3,
        bits: 12,
        ..page
    };
    let late = FrameHeader {
        frame_id: u64::from(u32::MAX) + 2,
        exposure_ns: 0,
        width: 2,
        height: 1,
        bits: 16,
        ..deep
    };
    let little = |values: &[u16]| values.iter().flat_map(|v| v.to_le_bytes()).collect();
    vec![
        (
            "the frame of the page, 8 bits",
            page,
            (0..12).map(|p| p * 20).collect(),
        ),
        (
            "12 bits: two bytes a pixel, least significant first",
            deep,
            little(&[0, 1, 255, 256, 4095, 2048]),
        ),
        (
            "16 bits, a number beyond 32 bits, no exposure known",
            late,
            little(&[0x1234, 65_535]),
        ),
    ]
}

/// Headers that end the run: the stream is out of step.
fn refused() -> Vec<(&'static str, [u8; HEADER_LEN])> {
    let good = frames()[0].1.to_bytes();
    // The check sum made right again, so that only what is named is wrong.
    let with = |change: &dyn Fn(&mut [u8; HEADER_LEN])| {
        let mut head = good;
        change(&mut head);
        let crc = crc::Crc::<u32>::new(&crc::CRC_32_ISO_HDLC).checksum(&head[..60]);
        head[60..].copy_from_slice(&crc.to_le_bytes());
        head
    };
    let mut flipped = good;
    flipped[20] ^= 1;
    vec![
        ("another magic", with(&|head| head[0] = b'X')),
        ("another version", with(&|head| head[4] = 2)),
        (
            "one bit of a time stamp flipped, check sum as before",
            flipped,
        ),
        (
            "width 7 with the pixels of width 6",
            with(&|head| head[36] = 7),
        ),
        ("7 bits", with(&|head| head[40] = 7)),
        ("17 bits", with(&|head| head[40] = 17)),
        (
            "no pixels",
            with(&|head| {
                head[36] = 0;
                head[44] = 0;
            }),
        ),
        (
            "more than 32 MiB",
            with(&|head| {
                head[36..40].copy_from_slice(&[0xff; 4]);
                head[44..48].copy_from_slice(&(65_535_u32 * 65_535).to_le_bytes());
            }),
        ),
    ]
}

fn vectors() -> Value {
    let frame = |(name, head, pixels): &(&str, FrameHeader, Vec<u8>)| {
        json!({
            "name": name,
            "frame_id": head.frame_id,
            "mid_exposure_ns": head.mid_exposure_ns,
            "sent_ns": head.sent_ns,
            "exposure_ns": head.exposure_ns,
            "width": head.width,
            "height": head.height,
            "bits": head.bits,
            "header": hex(&head.to_bytes()),
            "pixels": hex(pixels),
        })
    };
    let refuse =
        |(name, head): &(&str, [u8; HEADER_LEN])| json!({ "name": name, "header": hex(head) });
    json!({
        "about": "Frames of the camera's socket (docs/camera-socket.md), version 1. All bytes in hexadecimal.",
        "frames": frames().iter().map(frame).collect::<Vec<_>>(),
        "refused": refused().iter().map(refuse).collect::<Vec<_>>(),
    })
}

#[test]
fn the_published_frames_are_what_the_code_says_and_what_it_refuses() {
    let path = root().join("docs/camera-vectors.json");
    let text = serde_json::to_string_pretty(&vectors()).expect("JSON") + "\n";
    if std::env::var_os("CELLPOS_UPDATE_VECTORS").is_some() {
        std::fs::write(&path, &text).expect("written");
    }
    let published = std::fs::read_to_string(&path).expect("docs/camera-vectors.json");
    assert_eq!(published, text, "CELLPOS_UPDATE_VECTORS=1 writes it anew");
    let published: Value = serde_json::from_str(&published).expect("JSON");
    // One stream of all frames, in pieces of any length.
    let mut stream = Vec::new();
    for frame in published["frames"].as_array().expect("frames") {
        stream.extend(bytes(frame["header"].as_str().expect("hex")));
        stream.extend(bytes(frame["pixels"].as_str().expect("hex")));
    }
    for piece in [1, 7, 64, 1000] {
        let mut gatherer = FrameGatherer::new();
        let mut read = Vec::new();
        for mut part in stream.chunks(piece) {
            while !part.is_empty() {
                if let Some((head, pixels)) = gatherer.next_frame(&mut part).expect("frames") {
                    read.push((head, pixels.to_vec()));
                }
            }
        }
        let expected: Vec<_> = frames()
            .into_iter()
            .map(|(_, head, pixels)| (head, pixels))
            .collect();
        assert_eq!(read, expected, "pieces of {piece}");
    }
    for refused in published["refused"].as_array().expect("refused") {
        let head: [u8; HEADER_LEN] = bytes(refused["header"].as_str().expect("hex"))
            .try_into()
            .expect("64 bytes");
        assert!(
            FrameHeader::from_bytes(&head).is_err(),
            "{}",
            refused["name"]
        );
    }
}

#[test]
fn the_page_shows_the_first_of_them() {
    let page = std::fs::read_to_string(root().join("docs/camera-socket.md")).expect("the page");
    let (_, behind) = page.split_once("```text\n").expect("the header");
    let (block, _) = behind.split_once("```").expect("its end");
    let shown: String = block.split_whitespace().collect();
    assert_eq!(shown, hex(&frames()[0].1.to_bytes()));
}
