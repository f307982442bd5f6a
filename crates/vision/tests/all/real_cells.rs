//! Cells and beads that deformability cytometers recorded, against the instruments' own masks.

use crate::common::Random;
use crate::common::change::{Change, Picture};
use crate::common::stack::{Stack, masks};
use cellpos_vision::{Cell, CellConfig, CellFinder, Frame, Pixels};

/// What a mask says: pixels, middle, and 4 standard deviations along the rows.
struct Mask {
    area: f64,
    x: f64,
    y: f64,
    length: f64,
}

fn moments(mask: &[u8], width: usize) -> Mask {
    let (mut n, mut sx, mut sy, mut sxx) = (0.0, 0.0, 0.0, 0.0);
    for (k, _) in mask.iter().enumerate().filter(|(_, m)| **m > 0) {
        let (x, y) = ((k % width) as f64, (k / width) as f64);
        n += 1.0;
        sx += x;
        sy += y;
        sxx += x * x;
    }
    let mean = sx / n;
    let length = 4.0 * (sxx / n - mean * mean + 1.0 / 12.0).sqrt();
    Mask {
        area: n,
        x: mean,
        y: sy / n,
        length,
    }
}

/// A mask without its notches: filled to its convex hull.
fn filled(mask: &[u8], width: usize) -> Vec<u8> {
    let inside = |k: usize| mask[k] > 0;
    let points: Vec<(f64, f64)> = (0..mask.len())
        .filter(|k| inside(*k))
        .map(|k| ((k % width) as f64, (k / width) as f64))
        .collect();
    // Within the hull is what no straight line separates from the mask: tried over directions of half a degree.
    let directions: Vec<(f64, f64, f64)> = (0..720)
        .map(|n| {
            let (sin, cos) = (f64::from(n) * std::f64::consts::PI / 360.0).sin_cos();
            let along = points.iter().map(|p| p.0 * cos + p.1 * sin);
            (cos, sin, along.fold(f64::NEG_INFINITY, f64::max))
        })
        .collect();
    let held = |k: usize| {
        let (x, y) = ((k % width) as f64, (k / width) as f64);
        directions
            .iter()
            .all(|(c, s, most)| x * c + y * s <= most + 1e-9)
    };
    (0..mask.len())
        .map(|k| u8::from(!points.is_empty() && held(k)))
        .collect()
}

fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted[sorted.len() / 2]
}

/// The cell over each mask, and the mask as the change leaves it.
fn pairs(name: &str, least_mask_px: f64, change: Change) -> Vec<(usize, Option<Cell>, Mask)> {
    let stack = Stack::open(name, "frames.tif");
    let empty = Stack::open(name, "background.tif");
    let masks = masks(name);
    let mut random = Random(11);
    // The rows that a header is written into: no microscope blurs it.
    let header = match (name, change) {
        (_, Change::None) => 0,
        ("cells-low-contrast", _) => 6 * stack.width,
        _ => 0,
    };
    let mut changed = |page: &[u8], empty: bool| {
        let page = &page[..page.len() - header];
        let picture = change.apply(&Picture::of(page, stack.width), empty, &mut random);
        (picture.pixels(), picture.width, picture.height)
    };
    let frame = |(pixels, width, height): &(Vec<u8>, usize, usize)| -> Frame<'static> {
        // Leaked: a few pictures of a test.
        let pixels = Pixels::Mono8(pixels.clone().leak());
        Frame {
            width: *width,
            height: *height,
            pixels,
        }
    };
    let mut finder: Option<CellFinder> = None;
    for page in empty.pages.iter().take(16) {
        let frame = frame(&changed(page, true));
        let finder = finder.get_or_insert_with(|| {
            CellFinder::new(frame.width, frame.height, CellConfig::default()).unwrap()
        });
        finder.take_background(&frame).unwrap();
    }
    let mut finder = finder.unwrap();
    let mut pairs = Vec::new();
    for (n, (page, mask)) in stack.pages.iter().zip(&masks).enumerate() {
        let found = finder.find(&frame(&changed(page, false))).unwrap();
        // The masks of this set have notches where a cell is as bright as the channel.
        let mut mask = if name == "cells-low-contrast" {
            moments(&filled(mask, stack.width), stack.width)
        } else {
            moments(mask, stack.width)
        };
        if mask.area < least_mask_px || mask.area.is_nan() {
            continue;
        }
        (mask.x, mask.y) = change.place((mask.x, mask.y), stack.height - header / stack.width);
        mask.area *= change.size().powi(2);
        mask.length *= change.size();
        let own = found
            .iter()
            .find(|c| f64::hypot(c.x_px - mask.x, c.y_px - mask.y) < 8.0);
        if let Some(c) = own {
            println!(
                "{name} {n} {change:?}: {} found; area {:.3} +- {:.3} and length {:.3} of the mask's, place {:.2} {:.2} px off, \
                 sd {:.3} px, rim {:.1}, halo {:.1}{}",
                found.len(),
                c.area_px / mask.area,
                c.var_area_px2.sqrt() / mask.area,
                c.extent_px((1.0, 0.0)) / mask.length,
                c.x_px - mask.x,
                c.y_px - mask.y,
                c.var_x_px2.sqrt(),
                c.body_grey,
                c.halo_grey,
                if c.in_contact { ", in contact" } else { "" },
            );
        }
        pairs.push((n, own.copied(), mask));
    }
    pairs
}

fn areas(pairs: &[(usize, Option<Cell>, Mask)]) -> Vec<f64> {
    let ratio = |(_, cell, mask): &(usize, Option<Cell>, Mask)| cell.map(|c| c.area_px / mask.area);
    pairs.iter().filter_map(ratio).collect()
}

/// Every mask has its cell, its area within `each` of the mask's and the median within `most`.
fn check(name: &str, change: Change, most: f64, each: f64) {
    let pairs = pairs(name, 100.0, change);
    let ratios = areas(&pairs);
    assert_eq!(ratios.len(), pairs.len(), "{name} {change:?}");
    let middle = median(&ratios);
    println!("{name} {change:?}: median area {middle:.3} of the masks'");
    assert!((middle - 1.0).abs() <= most, "{name} {change:?}: {middle}");
    for ratio in ratios {
        assert!((ratio - 1.0).abs() <= each, "{name} {change:?}: {ratio}");
    }
}

#[test]
#[cfg_attr(no_shared_data, ignore = "needs ../shared/data/cells-in-channels")]
fn measured_cells_and_beads_have_the_area_length_and_place_of_the_instruments_masks() {
    for name in ["calibration-beads", "cells-wide-channel"] {
        check(name, Change::None, 0.05, 0.15);
        let pairs = pairs(name, 100.0, Change::None);
        let own = |(_, cell, mask): &(usize, Option<Cell>, Mask)| {
            let c = cell.unwrap();
            let away = f64::hypot(c.x_px - mask.x, c.y_px - mask.y);
            (c.extent_px((1.0, 0.0)) / mask.length, away)
        };
        let (lengths, away): (Vec<f64>, Vec<f64>) = pairs.iter().map(own).unzip();
        let (low, high) = lengths
            .iter()
            .fold((9.0_f64, 0.0_f64), |(l, h), v| (l.min(*v), h.max(*v)));
        println!(
            "{name}: length {low:.3} .. {high:.3} of the masks', place {:.2} px off",
            median(&away)
        );
        assert!(high - low <= 0.03, "{name}: {low} .. {high}");
        assert!(median(&away) <= 0.3, "{name}: {away:?}");
    }
}

#[test]
#[cfg_attr(no_shared_data, ignore = "needs ../shared/data/cells-in-channels")]
fn faint_cells_stay_whole_and_have_the_area_that_the_file_says() {
    let pairs = pairs("cells-low-contrast", 100.0, Change::None);
    let areas: Vec<f64> = pairs.iter().map(|(_, c, _)| c.unwrap().area_px).collect();
    // The file's own areas of these events, px.
    let file = [218.5, 215.0, 217.0, 220.5, 210.5, 218.0, 204.0, 218.0];
    let ratio = median(&areas) / median(&file);
    println!("median area {ratio:.3} of the file's own");
    assert!((ratio - 1.0).abs() <= 0.1, "{ratio}");
    for (area, file) in areas.iter().zip(file) {
        assert!((area / file - 1.0).abs() < 0.25, "{area} {file}");
    }
    // Against masks of 17 px, each quantised and some cut at the top: they tell no better than 1 %.
    let length =
        |(_, c, mask): &(usize, Option<Cell>, Mask)| c.unwrap().extent_px((1.0, 0.0)) / mask.length;
    let mut lengths: Vec<f64> = pairs.iter().map(length).collect();
    lengths.sort_by(f64::total_cmp);
    let (low, high) = (lengths[0], lengths[lengths.len() - 1]);
    println!("length {low:.3} .. {high:.3} of the masks'");
    assert!(high - low < 0.04, "{low} .. {high}");
    // Whose scatter that is: cells of one kind have one length for the root of their area, to what they differ in shape.
    let spread = |values: Vec<f64>| {
        let (low, high) = values
            .iter()
            .fold((9.0_f64, 0.0_f64), |(l, h), v| (l.min(*v), h.max(*v)));
        high / low - 1.0
    };
    let shape = |cell: &Cell| cell.extent_px((1.0, 0.0)) / cell.area_px.sqrt();
    let own = spread(pairs.iter().map(|(_, c, _)| shape(&c.unwrap())).collect());
    let masks = spread(
        pairs
            .iter()
            .map(|(_, _, m)| m.length / m.area.sqrt())
            .collect(),
    );
    println!("length over the root of the area: within {own:.3}, the masks' within {masks:.3}");
    assert!(own <= 0.03 && own < masks, "{own} {masks}");
    // The file's own places along the channel.
    let file_x = [
        63.494, 60.957, 56.423, 28.22, 26.859, 55.047, 57.742, 20.255,
    ];
    let away: Vec<f64> = pairs
        .iter()
        .zip(file_x)
        .map(|((_, c, _), x)| (c.unwrap().x_px - x).abs())
        .collect();
    let file_y = [
        20.025, 20.026, 20.234, 19.054, 19.183, 20.124, 20.285, 18.785,
    ];
    let across = pairs.iter().zip(file_y);
    let across: Vec<f64> = across.map(|((_, c, _), y)| c.unwrap().y_px - y).collect();
    println!(
        "from the file's places: along the channel {:.2} px, across it {across:.2?} px",
        median(&away)
    );
    assert!(away.iter().all(|away| *away <= 0.3), "{away:?}");
}

#[test]
#[cfg_attr(no_shared_data, ignore = "needs ../shared/data/cells-in-channels")]
fn the_fast_outlines_of_measured_cells_are_those_through_all_rays() {
    for name in [
        "calibration-beads",
        "cells-wide-channel",
        "cells-low-contrast",
    ] {
        let stack = Stack::open(name, "frames.tif");
        let mut finder = CellFinder::new(stack.width, stack.height, CellConfig::default()).unwrap();
        for frame in Stack::open(name, "background.tif").frames() {
            finder.take_background(&frame).unwrap();
        }
        let mut compared = 0;
        for frame in stack.frames() {
            finder.set_thorough(true);
            let all = finder.find(&frame).unwrap().to_vec();
            finder.set_thorough(false);
            let fast = finder.find(&frame).unwrap();
            assert_eq!(all.len(), fast.len(), "{name}");
            for (all, fast) in all.iter().zip(fast).filter(|(all, _)| !all.at_border) {
                let area = fast.area_px / all.area_px - 1.0;
                let length = fast.extent_px((1.0, 0.0)) / all.extent_px((1.0, 0.0)) - 1.0;
                let place = f64::hypot(fast.x_px - all.x_px, fast.y_px - all.y_px);
                println!("{name}: area {area:.4}, length {length:.4}, place {place:.3} px apart");
                compared += 1;
                assert!(
                    area.abs() < 0.01 && length.abs() < 0.01 && place < 0.1,
                    "{name}"
                );
            }
        }
        assert!(compared >= 7, "{name}: {compared}");
    }
}

#[test]
#[cfg_attr(no_shared_data, ignore = "needs ../shared/data/cells-in-channels")]
fn other_polarity_light_noise_focus_and_side_change_the_outlines_little() {
    for change in [
        Change::Inverted,
        Change::Scaled(0.5, 0.0),
        Change::Scaled(1.0, 40.0),
        Change::Noise(3.0),
        Change::Blurred(0.8),
        Change::Flipped,
    ] {
        check("calibration-beads", change, 0.08, 0.15);
        check("cells-wide-channel", change, 0.06, 0.15);
    }
    // A third of the rim's contrast is hidden in noise as deep as a quarter of it.
    let noisy = pairs("cells-low-contrast", 100.0, Change::Noise(2.5));
    assert!(noisy.iter().all(|(_, cell, _)| cell.is_some()));
    let middle = median(&areas(&noisy));
    assert!((middle - 1.0).abs() < 0.15, "{middle}");
}

/// Frames of one cell each, enlarged, with the outline in green and the mask's edge in red, below each other.
fn draw(
    name: &str,
    from: &[usize],
    (width, height): (usize, usize),
    scale: usize,
) -> image::RgbImage {
    let stack = Stack::open(name, "frames.tif");
    let empty = Stack::open(name, "background.tif");
    let masks = masks(name);
    let mut finder = CellFinder::new(stack.width, stack.height, CellConfig::default()).unwrap();
    empty
        .frames()
        .for_each(|frame| finder.take_background(&frame).unwrap());
    let mut sheet =
        image::RgbImage::new((width * scale) as u32, (from.len() * height * scale) as u32);
    for (tile, n) in from.iter().enumerate() {
        let frame = stack.frames().nth(*n).unwrap();
        let cell = finder.find(&frame).unwrap()[0];
        let (page, mask) = (&stack.pages[*n], &masks[*n]);
        let left = (cell.x_px as usize)
            .saturating_sub(width / 2)
            .min(stack.width - width);
        let top = (cell.y_px as usize)
            .saturating_sub(height / 2)
            .min(stack.height - height);
        let inside = |x: usize, y: usize| mask[y * stack.width + x] > 0;
        let rest = &page[..stack.width * (stack.height - 6)];
        let (low, high) = (rest.iter().min().unwrap(), rest.iter().max().unwrap());
        for y in 0..height * scale {
            for x in 0..width * scale {
                let (i, j) = (left + x / scale, top + y / scale);
                let v = f64::from(page[j * stack.width + i]) - f64::from(*low);
                let grey = (255.0 * v / f64::from(high - low)).clamp(0.0, 255.0) as u8;
                let edge = (x % scale == 0 && inside(i, j) != inside(i.saturating_sub(1), j))
                    || (y % scale == 0 && inside(i, j) != inside(i, j.saturating_sub(1)));
                let colour = if edge { [230, 60, 60] } else { [grey; 3] };
                sheet.put_pixel(
                    x as u32,
                    (tile * height * scale + y) as u32,
                    image::Rgb(colour),
                );
            }
        }
        let outline = finder.outline(0);
        for (k, a) in outline.iter().enumerate() {
            let b = outline[(k + 1) % outline.len()];
            for t in 0..20 {
                let t = f64::from(t) / 20.0;
                let at = |a: f64, b: f64, from: usize| {
                    (a + t * (b - a) + 0.5 - from as f64) * scale as f64
                };
                let (x, y) = (at(a.0, b.0, left), at(a.1, b.1, top));
                if x >= 0.0 && y >= 0.0 && x < (width * scale) as f64 && y < (height * scale) as f64
                {
                    sheet.put_pixel(
                        x as u32,
                        tile as u32 * (height * scale) as u32 + y as u32,
                        image::Rgb([60, 230, 90]),
                    );
                }
            }
        }
    }
    sheet
}

#[test]
#[ignore = "writes docs/images/outlines-*.png: cargo test -p cellpos-vision --test all real_cells -- --ignored draw"]
fn draw_the_outlines_of_the_documentation() {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/images");
    std::fs::create_dir_all(folder).unwrap();
    for (name, frames, size, scale) in [
        ("calibration-beads", vec![0, 1, 4], (64, 40), 6),
        ("cells-wide-channel", vec![0, 3, 7], (128, 90), 4),
        ("cells-low-contrast", vec![0, 1, 4], (64, 36), 6),
    ] {
        let sheet = draw(name, &frames, size, scale);
        sheet.save(format!("{folder}/outlines-{name}.png")).unwrap();
    }
}

/// What a change does to the cells of a set: shares found, median area and its extremes over the masks'.
fn effect(name: &str, change: Change) -> (usize, usize, [f64; 3]) {
    let pairs = pairs(name, 100.0, change);
    let mut ratios = areas(&pairs);
    ratios.sort_by(f64::total_cmp);
    let of = |at: usize| ratios.get(at).copied().unwrap_or(f64::NAN);
    let last = ratios.len().saturating_sub(1);
    let spread = [of(ratios.len() / 2), of(0), of(last)];
    println!(
        "{name} {change:?}: {} of {}, {spread:.3?}",
        ratios.len(),
        pairs.len()
    );
    (ratios.len(), pairs.len(), spread)
}

#[test]
#[cfg_attr(
    not(no_shared_data),
    ignore = "nightly: 4 s of a debug build; the fast one changes polarity, light, noise, focus and side"
)]
#[cfg_attr(no_shared_data, ignore = "needs ../shared/data/cells-in-channels")]
fn another_contrast_curve_focus_pixel_or_place_of_the_chip_changes_the_outlines_little() {
    for change in [
        Change::Scaled(0.5, 60.0),
        Change::Gamma(0.5),
        Change::Gamma(2.0),
        Change::Noise(4.0),
        Change::Blurred(1.6),
        Change::Defocused(-1.0),
        Change::Defocused(0.5),
        Change::Resized(0.5),
        Change::Resized(1.5),
        Change::Drifted(0.3),
        Change::Drifted(1.0),
        Change::Lamp(0.9),
        Change::Lamp(1.1),
    ] {
        for name in ["calibration-beads", "cells-wide-channel"] {
            let (found, count, [middle, least, most]) = effect(name, change);
            assert_eq!(found, count, "{name} {change:?}");
            assert!((middle - 1.0).abs() <= 0.05, "{name} {change:?}: {middle}");
            assert!(
                least > 0.85 && most < 1.15,
                "{name} {change:?}: {least} {most}"
            );
        }
    }
    // Cells of 17 px at three times the noise.
    for change in [
        Change::Inverted,
        Change::Scaled(0.5, 60.0),
        Change::Gamma(0.5),
        Change::Gamma(2.0),
        Change::Noise(2.0),
        Change::Blurred(0.8),
        Change::Defocused(-0.5),
        Change::Defocused(0.25),
        Change::Resized(0.7),
        Change::Resized(1.5),
        Change::Drifted(0.3),
        Change::Drifted(1.0),
        Change::Lamp(0.9),
    ] {
        let (found, count, [middle, least, most]) = effect("cells-low-contrast", change);
        assert_eq!(found, count, "{change:?}");
        assert!((middle - 1.0).abs() <= 0.1, "{change:?}: {middle}");
        assert!(least > 0.85 && most < 1.15, "{change:?}: {least} {most}");
    }
}

#[test]
#[cfg_attr(no_shared_data, ignore = "needs ../shared/data/cells-in-channels")]
fn text_written_into_the_pictures_is_no_cell_and_changes_none() {
    for rows in [8, 16, 24] {
        for name in [
            "calibration-beads",
            "cells-wide-channel",
            "cells-low-contrast",
        ] {
            // A header that fills more than a quarter of the picture is not taken for one.
            if name == "cells-low-contrast" && rows > 16 {
                continue;
            }
            let (found, count, [middle, least, most]) = effect(name, Change::Header(rows));
            assert_eq!(found, count, "{name} {rows}");
            assert!((middle - 1.0).abs() <= 0.05, "{name} {rows}: {middle}");
            assert!(least > 0.85 && most < 1.15, "{name} {rows}: {least} {most}");
        }
    }
}
