//! Recordings as other programs publish them: folders of TIFF pictures, stacks of ImageJ.

use cellpos_drivers::sources::{self, Playback};
use cellpos_rig::{Camera, Clock, FrameBuffer};
use std::fs;
use std::path::Path;
use tiff::encoder::{TiffEncoder, colortype};

/// A picture of three equal channels, as many programs save grey ones.
fn write_rgb_tiff(path: &Path, value: u8) {
    let mut encoder = TiffEncoder::new(fs::File::create(path).unwrap()).unwrap();
    let pixels: Vec<u8> = (0..12).flat_map(|k| [value + k; 3]).collect();
    encoder
        .write_image::<colortype::RGB8>(4, 3, &pixels)
        .unwrap();
}

#[test]
fn a_folder_of_tiff_pictures_with_equal_channels_keeps_its_gaps() {
    let folder = tempfile::tempdir().unwrap();
    for n in [1_u8, 2, 3, 6] {
        write_rgb_tiff(&folder.path().join(format!("run_{n:04}.tif")), n);
    }
    let mut recording = sources::open(folder.path()).unwrap();
    let info = recording.info().clone();
    assert_eq!((info.frames, info.lost, info.bits), (4, 2, 8));
    assert!(info.note.unwrap().contains("equal channels"));
    let mut buffer = FrameBuffer::default();
    recording.read(3, &mut buffer).unwrap();
    assert_eq!(recording.number(3), 5);
    assert_eq!((buffer.mono8[0], buffer.mono8[11]), (6, 17));
    let clock = Clock::virtual_at(0);
    let mut playback = Playback::new(recording, Some(100.0), None, clock).unwrap();
    let mut stamps = Vec::new();
    for _ in 0..4 {
        let stamp = playback.next_frame(&mut buffer, i64::MAX).unwrap().unwrap();
        stamps.push((stamp.id, stamp.mid_exposure_ns / 1_000_000));
    }
    assert_eq!(stamps, [(1, 0), (2, 10), (3, 20), (6, 50)]);
    fs::copy(
        folder.path().join("run_0001.tif"),
        folder.path().join("x.png"),
    )
    .unwrap();
    let error = sources::open(folder.path()).unwrap_err();
    assert!(error.to_string().contains("1 PNG and 4 TIFF"), "{error}");
}

/// A TIFF of one directory before `count` pictures, big-endian, as ImageJ writes large stacks.
fn imagej(compression: u16, count: usize) -> Vec<u8> {
    let text = format!("ImageJ=1.53t\nimages={count}\nslices={count}\n\0");
    let entries = 9_u16;
    let after = 8 + 2 + 12 * u32::from(entries) + 4;
    let data = after + text.len() as u32;
    let mut bytes = b"MM\0*\0\0\0\x08".to_vec();
    bytes.extend(entries.to_be_bytes());
    let mut entry = |tag: u16, kind: u16, count: u32, value: u32| {
        bytes.extend(tag.to_be_bytes());
        bytes.extend(kind.to_be_bytes());
        bytes.extend(count.to_be_bytes());
        // Short values are left-justified.
        let value = if kind == 3 { value << 16 } else { value };
        bytes.extend(value.to_be_bytes());
    };
    entry(256, 3, 1, 4);
    entry(257, 3, 1, 3);
    entry(258, 3, 1, 16);
    entry(259, 3, 1, compression.into());
    entry(262, 3, 1, 1);
    entry(270, 2, text.len() as u32, after);
    entry(273, 4, 1, data);
    entry(278, 3, 1, 3);
    entry(279, 4, 1, 24);
    bytes.extend([0; 4]);
    bytes.extend(text.as_bytes());
    for n in 0..count as u16 {
        (0..12).for_each(|k| bytes.extend((1000 * n + k).to_be_bytes()));
    }
    bytes
}

#[test]
fn a_stack_of_one_directory_is_read_to_its_end_and_a_short_one_or_another_compression_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("large.tif");
    let whole = imagej(1, 5);
    fs::write(&path, &whole).unwrap();
    let mut recording = sources::open(&path).unwrap();
    assert_eq!((recording.info().frames, recording.info().bits), (5, 16));
    let mut buffer = FrameBuffer::default();
    for n in [4, 0, 2] {
        recording.read(n, &mut buffer).unwrap();
        assert_eq!(buffer.mono16[11], 1000 * n as u16 + 11);
    }
    fs::write(&path, &whole[..whole.len() - 30]).unwrap();
    let error = sources::open(&path).unwrap_err().to_string();
    assert!(error.contains("3 of the 5 pictures"), "{error}");
    fs::write(&path, imagej(34_712, 1)).unwrap();
    let error = sources::open(&path).unwrap_err().to_string();
    assert!(error.contains("JPEG 2000"), "{error}");
}
