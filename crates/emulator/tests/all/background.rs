//! Backgrounds for cells, recorded from the emulated channel.

use cellpos_drivers::background::{BackgroundError, finder, load, save};
use cellpos_emulator::{CellConfig as EmulatedCell, World, WorldConfig};
use cellpos_rig::FrameBuffer;
use cellpos_vision::CellConfig;

fn empty(count: usize) -> Vec<FrameBuffer> {
    let world = WorldConfig {
        pixel_um: 0.2,
        height_px: 64,
        cell: Some(EmulatedCell::default()),
        ..WorldConfig::ideal()
    };
    let buffer = |mono8| FrameBuffer::of_mono8(256, 64, mono8);
    let frames = World::empty_frames(&world, count).unwrap();
    frames.into_iter().map(buffer).collect()
}

#[test]
fn a_stack_written_is_the_stack_read_and_nothing_is_overwritten() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("empty.tif");
    let frames = empty(20);
    save(&path, &frames).unwrap();
    let read = load(&path, CellConfig::default()).unwrap();
    let direct = finder(&frames, "camera", CellConfig::default()).unwrap();
    assert_eq!(read.noise_grey(), direct.noise_grey());
    assert!(
        (read.noise_grey() - 1.9).abs() < 0.1,
        "{}",
        read.noise_grey()
    );
    let error = save(&path, &frames).unwrap_err().to_string();
    assert!(error.contains("empty.tif"), "{error}");
    let deep: Vec<FrameBuffer> = frames
        .iter()
        .map(|frame| FrameBuffer {
            bits: 16,
            mono16: frame.mono8.iter().map(|p| u16::from(*p) * 16).collect(),
            mono8: Vec::new(),
            ..frame.clone()
        })
        .collect();
    let path = folder.path().join("deep.tif");
    save(&path, &deep).unwrap();
    let deep = load(&path, CellConfig::default()).unwrap();
    assert!((deep.noise_grey() / direct.noise_grey() / 16.0 - 1.0).abs() < 0.01);
}

#[test]
fn a_frame_in_which_something_swims_past_is_named() {
    let mut frames = empty(40);
    for k in 0..200 {
        frames[17].mono8[(20 + k / 20) * 256 + 100 + k % 20] = 180;
    }
    let error = finder(&frames, "empty.tif", CellConfig::default()).unwrap_err();
    let BackgroundError::NotEmpty { frame, x_px, .. } = &error else {
        panic!("{error}");
    };
    assert!(*frame == 17 && (x_px - 109.5).abs() < 1.0, "{error}");
    let error = finder(&frames[..1], "one.tif", CellConfig::default()).unwrap_err();
    assert!(error.to_string().contains("one.tif: 1 frames"), "{error}");
    frames[3].width = 128;
    frames[3].height = 128;
    let error = finder(&frames, "x", CellConfig::default()).unwrap_err();
    assert!(error.to_string().contains("frame 3"), "{error}");
}
