//! The picture of the emulated cell, measured by vision against the truth.

use cellpos_emulator::{CellConfig, FaultEvent, FaultKind, Faults, World, WorldConfig};
use cellpos_plant::Model;
use cellpos_vision::{CellFinder, FixQuality, Frame, Pixels};

fn config() -> WorldConfig {
    WorldConfig {
        pixel_um: 0.2,
        height_px: 64,
        cell: Some(CellConfig::default()),
        ..WorldConfig::ideal()
    }
}

fn frame<'a>(config: &WorldConfig, pixels: &'a [u8]) -> Frame<'a> {
    Frame {
        width: usize::from(config.width_px),
        height: usize::from(config.height_px),
        pixels: Pixels::Mono8(pixels),
    }
}

fn finder(config: &WorldConfig) -> CellFinder {
    let (width, height) = (usize::from(config.width_px), usize::from(config.height_px));
    let mut finder = CellFinder::new(width, height, Default::default()).unwrap();
    for empty in World::empty_frames(config, 64).unwrap() {
        finder.take_background(&frame(config, &empty)).unwrap();
    }
    finder
}

/// Runs with the board's output at `applied_um`; calls `each` with every frame.
fn watch(
    config: &WorldConfig,
    seconds: f64,
    applied_um: f64,
    mut each: impl FnMut(&World, cellpos_emulator::FrameInfo, &[u8]),
) {
    let mut world = World::new(config, &Model::eq6(), 0).unwrap();
    let mut pixels = Vec::new();
    while (world.now_ns() as f64) < seconds * 1e9 {
        world.advance_to(world.now_ns() + 500_000, applied_um);
        while let Some(info) = world.take_frame(&mut pixels) {
            each(&world, info, &pixels);
        }
    }
}

#[test]
fn vision_finds_place_length_and_area_of_the_cell_that_was_drawn_at_rest_and_stretched() {
    for (start_um, most_length) in [(-12.0, 1.01), (8.0, 3.81)] {
        let config = WorldConfig {
            start_um,
            ..config()
        };
        let cell = config.cell.unwrap();
        let mut finder = finder(&config);
        let (mut n, mut longest) = (0, 0.0_f64);
        let [mut error2, mut predicted2] = [0.0; 2];
        watch(&config, 0.4, config.neutral_um, |world, info, pixels| {
            let found = finder.find(&frame(&config, pixels)).unwrap();
            assert_eq!(found.len(), 1, "{found:?}");
            let c = found[0];
            n += 1;
            error2 += (config.um_from_px(c.x_px) - info.true_um).powi(2);
            predicted2 += c.var_x_px2 * config.pixel_um * config.pixel_um;
            let length_um = config.pixel_um * c.extent_px((1.0, 0.0));
            // The frame is 2 ms old: compared once the cell has nearly its last length.
            let now_um = world.length_um().unwrap();
            if info.mid_exposure_ns > 250_000_000 {
                assert!(
                    (length_um / now_um - 1.0).abs() < 0.01,
                    "{length_um} {now_um}"
                );
            }
            let area_um2 = config.pixel_um * config.pixel_um * c.area_px;
            let of_length = std::f64::consts::FRAC_PI_4 * cell.rest_um.powf(1.5) * length_um.sqrt();
            assert!(
                (area_um2 / of_length - 1.0).abs() < 0.015,
                "{area_um2} {of_length}"
            );
            longest = longest.max(length_um / cell.rest_um);
        });
        assert!(n > 390);
        assert!((longest / most_length - 1.0).abs() < 0.015, "{longest}");
        let ratio = (error2 / predicted2).sqrt();
        assert!((0.8..1.5).contains(&ratio), "error over predicted {ratio}");
        assert!((error2 / f64::from(n)).sqrt() < 0.01, "um");
    }
}

#[test]
fn a_cell_with_rim_and_halo_keeps_its_length_and_area_through_the_focus() {
    // A dark body of 9 um, as weak as a cell's in bright field, with rim and halo of either order.
    // A body and a halo alike in strength and sign, and one that absorbs more than its edge bends.
    let kinds = [
        (9.0, -0.35, 0.6),
        (9.0, 0.35, 0.6),
        (14.0, 0.35, 0.3),
        (14.0, -0.35, 0.3),
        (8.0, 1.0, 0.5),
        (6.0, -0.35, 0.6),
        (6.0, 0.35, 0.6),
        (6.0, 1.0, 0.5),
    ];
    for focus_um in [-2.0, -1.0, 0.0, 1.0, 2.0] {
        for (rest_um, body, halo) in kinds {
            let config = WorldConfig {
                height_px: 96,
                start_um: -12.0,
                cell: Some(CellConfig {
                    body,
                    focus_um,
                    rest_um,
                    halo,
                    stretch_first: 2.0,
                    stretch_last: 2.0,
                    ..CellConfig::default()
                }),
                ..config()
            };
            let cell = config.cell.unwrap();
            let mut finder = finder(&config);
            let [mut n, mut length, mut area, mut z2, mut length2] = [0.0; 5];
            watch(&config, 0.1, config.neutral_um, |_, info, pixels| {
                let found = finder.find(&frame(&config, pixels)).unwrap();
                assert_eq!(found.len(), 1, "{focus_um} {body}: {found:?}");
                let c = found[0];
                n += 1.0;
                let own = config.pixel_um * c.extent_px((1.0, 0.0)) / cell.rest_um;
                length += own;
                length2 += own * own;
                area += config.pixel_um.powi(2) * c.area_px
                    / (0.25 * std::f64::consts::PI * rest_um * rest_um);
                let sd_um = config.pixel_um * c.var_x_px2.sqrt();
                z2 += ((config.um_from_px(c.x_px) - info.true_um) / sd_um).powi(2);
            });
            let (length, area, z) = (length / n, area / n, (z2 / n).sqrt());
            println!(
                "focus {focus_um} um, body {body}, halo {halo}, {rest_um} um: length {length:.4}, area {area:.4}, error/sd {z:.2}"
            );
            assert!(
                (length - 1.0).abs() < 0.01,
                "{focus_um} {body} {halo}: length {length}"
            );
            assert!(
                (area - 1.0).abs() < 0.02,
                "{focus_um} {body} {halo}: area {area}"
            );
            assert!((0.6..1.5).contains(&z), "{focus_um} {body}: {z}");
        }
    }
}

#[test]
fn empty_frames_show_the_walls_and_no_cell_and_change_nothing_in_a_world() {
    let config = config();
    let mut finder = finder(&config);
    let empty = World::empty_frames(&config, 70).unwrap();
    for pixels in empty.iter().skip(64) {
        assert!(finder.find(&frame(&config, pixels)).unwrap().is_empty());
    }
    let wall_row = |um: f64| ((config.origin_y_px() - um / 0.2).round() as usize) * 256 + 20;
    assert!(empty[0][wall_row(4.8)] < 80 && empty[0][wall_row(0.0)] > 90);
    let first = |config: &WorldConfig| {
        let mut all = Vec::new();
        watch(config, 0.02, 20.0, |_, _, pixels| {
            all.extend_from_slice(pixels)
        });
        all
    };
    let before = first(&config);
    World::empty_frames(&config, 3).unwrap();
    assert_eq!(before, first(&config));
}

#[test]
fn a_cell_that_reaches_out_of_the_frame_is_at_the_border_with_and_without_pictures() {
    let config = WorldConfig {
        start_um: 23.0,
        cell: Some(CellConfig {
            stretch_first: 1.0,
            stretch_last: 1.0,
            ..CellConfig::default()
        }),
        ..config()
    };
    let mut finder = finder(&config);
    watch(&config, 0.05, config.neutral_um, |_, _, pixels| {
        let found = finder.find(&frame(&config, pixels)).unwrap();
        assert!(found[0].at_border);
    });
    let mut world = World::new(&config, &Model::eq6(), 0).unwrap();
    world.advance_to(10_000_000, config.neutral_um);
    let fix = world.take_position().unwrap();
    assert_eq!(fix.verdict, FixQuality::AtBorder);
    assert!(fix.length_um.is_nan() && fix.area_um2.is_nan());
}

#[test]
fn a_second_cell_is_drawn_whole() {
    let config = WorldConfig {
        start_um: -14.0,
        faults: Faults {
            second_bead_um: 12.0,
            event: vec![FaultEvent {
                kind: FaultKind::SecondBead,
                at_s: 0.0,
                for_s: None,
            }],
            ..Faults::default()
        },
        ..config()
    };
    let mut finder = finder(&config);
    watch(&config, 0.02, config.neutral_um, |_, _, pixels| {
        let found = finder.find(&frame(&config, pixels)).unwrap();
        assert_eq!(found.len(), 2);
        for cell in found {
            let length_um = 0.2 * cell.extent_px((1.0, 0.0));
            assert!((length_um / 8.0 - 1.0).abs() < 0.03, "{length_um}");
        }
    });
}

#[test]
fn a_cell_that_does_not_fit_into_the_frame_is_refused_by_name() {
    let low = WorldConfig {
        cell: Some(CellConfig::default()),
        ..WorldConfig::ideal()
    };
    let error = low.validate().unwrap_err().to_string();
    assert!(
        error.contains("cell.rest_um") && error.contains("height_px"),
        "{error}"
    );
    let narrow = WorldConfig {
        width_px: 128,
        ..config()
    };
    let error = narrow.validate().unwrap_err().to_string();
    assert!(
        error.contains("stretch") && error.contains("width_px"),
        "{error}"
    );
}
