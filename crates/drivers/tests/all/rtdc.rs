//! Files of deformability cytometers, written by the HDF5 library itself.

use cellpos_drivers::sources::{self, SourceError};
use cellpos_rig::FrameBuffer;
use std::path::{Path, PathBuf};

fn file(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("tests/data")
        .join(name)
}

fn sum(frame: &FrameBuffer) -> u64 {
    frame.mono8.iter().map(|v| u64::from(*v)).sum()
}

#[test]
fn pictures_background_pixel_size_rate_and_frame_numbers_come_out_as_they_were_written() {
    let mut recording = sources::open(&file("faint-cells.rtdc")).unwrap();
    let info = recording.info().clone();
    assert_eq!((info.width_px, info.height_px, info.frames), (100, 45, 3));
    assert_eq!((info.pixel_um, info.rate_hz), (Some(0.68), Some(2000.0)));
    assert_eq!([0, 1, 2].map(|n| recording.number(n)), [0, 3, 4]);
    let mut frame = FrameBuffer::default();
    for (n, expected) in [291_493, 292_892, 331_428].into_iter().enumerate() {
        recording.read(n, &mut frame).unwrap();
        assert_eq!((frame.bits, sum(&frame)), (8, expected), "{n}");
    }
    let empty = recording.background().unwrap().unwrap();
    assert_eq!((empty.width, empty.height, sum(&empty)), (100, 45, 292_832));
    let beyond = recording.read(3, &mut frame).unwrap_err();
    assert!(
        matches!(beyond, SourceError::NoSuchFrame { .. }),
        "{beyond}"
    );
}

#[test]
fn pictures_of_sixteen_bits_come_out_in_either_byte_order_and_numbers_that_are_no_pixels_are_told()
{
    let mut recording = sources::open(&file("sixteen-bits.rtdc")).unwrap();
    let info = recording.info().clone();
    assert_eq!((info.width_px, info.height_px, info.bits), (10, 8, 16));
    assert_eq!([0, 1, 2].map(|n| recording.number(n)), [0, 2, 3]);
    let mut frame = FrameBuffer::default();
    for n in 0..3 {
        recording.read(n, &mut frame).unwrap();
        let expected: Vec<u16> = (0..80).map(|k| (80 * n as u16 + k) * 137 + 300).collect();
        assert_eq!((frame.bits, &frame.mono16), (16, &expected), "{n}");
    }
    let empty = recording.background().unwrap().unwrap();
    assert_eq!((empty.bits, empty.mono16), (16, vec![4000; 80]));
    let error = sources::open(&file("of-numbers.rtdc")).unwrap_err();
    assert!(matches!(error, SourceError::PixelKind { .. }), "{error}");
}

#[test]
fn what_zstandard_has_compressed_comes_back_whatever_the_chunks_and_filters_before_it() {
    let mut recording = sources::open(&file("zstandard.rtdc")).unwrap();
    let mut frame = FrameBuffer::default();
    recording.read(0, &mut frame).unwrap();
    assert_eq!(sum(&frame), 291_493);
    // Several frames, and a part of their rows, in a chunk; the last chunks are partly filled.
    let mut recording = sources::open(&file("zstandard-chunks.rtdc")).unwrap();
    let info = recording.info().clone();
    assert_eq!((info.width_px, info.height_px, info.frames), (11, 9, 7));
    assert_eq!((info.pixel_um, info.rate_hz), (Some(0.34), Some(3000.0)));
    assert_eq!([0, 1, 6].map(|n| recording.number(n)), [0, 2, 12]);
    for n in [0, 6, 3, 4] {
        recording.read(n, &mut frame).unwrap();
        let expected: Vec<u8> = (0..99)
            .map(|k| (((99 * n + k) * 7 + 3) % 251) as u8)
            .collect();
        assert_eq!(frame.mono8, expected, "{n}");
    }
    let empty = recording.background().unwrap().unwrap();
    let mut of_pixel = |k: usize| {
        let mut values: Vec<u8> = (0..7)
            .map(|n| (((99 * n + k) * 5 + 1) % 253) as u8)
            .collect();
        values.sort_unstable();
        values[3]
    };
    let expected: Vec<u8> = (0..99).map(&mut of_pixel).collect();
    assert_eq!(empty.mono8, expected);
    let mut recording = sources::open(&file("zstandard-words.rtdc")).unwrap();
    for n in [5, 0] {
        recording.read(n, &mut frame).unwrap();
        let expected: Vec<u16> = (0..99).map(|k| ((99 * n + k) * 137 + 300) as u16).collect();
        assert_eq!((frame.bits, &frame.mono16), (16, &expected), "{n}");
    }
}

#[test]
fn what_is_cut_off_or_no_hdf5_is_told() {
    let folder = tempfile::tempdir().unwrap();
    let whole = std::fs::read(file("faint-cells.rtdc")).unwrap();
    let packed = std::fs::read(file("zstandard.rtdc")).unwrap();
    let mut flipped = packed.clone();
    // The first bytes of a compressed chunk.
    let at = packed
        .windows(4)
        .position(|w| w == [0x28, 0xB5, 0x2F, 0xFD])
        .unwrap();
    flipped[at] = 0;
    for (name, bytes) in [
        ("cut.rtdc", &whole[..whole.len() / 2]),
        ("text.rtdc", b"text"),
        ("zstandard.rtdc", &packed[..packed.len() - 200]),
        ("flipped.rtdc", &flipped),
    ] {
        let path = folder.path().join(name);
        std::fs::write(&path, bytes).unwrap();
        let error = sources::open(&path).unwrap_err();
        assert!(error.to_string().contains(name), "{error}");
        assert!(matches!(error, SourceError::Damaged { .. }), "{error}");
    }
    let missing = sources::open(&folder.path().join("none.rtdc")).unwrap_err();
    assert!(
        matches!(missing, SourceError::Unreadable { .. }),
        "{missing}"
    );
}
