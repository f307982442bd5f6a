//! Finds the settings of vision with the live camera, and writes them into the rig file.

use crate::bench::Bench;
use crate::capture::Capture;
use crate::rig_text::change;
use crate::sight::Sight;
use crate::snapshot::{Seen, mark, picture};
use cellpos_rig::FrameBuffer;
use cellpos_session::Failure;
use cellpos_vision::suggest::{Suggestion, suggest};
use cellpos_vision::{Detector, FixQuality, Frame, Localiser, LocaliserConfig};
use image::RgbImage;
use serde::Serialize;
use std::path::Path;
use toml_edit::{DocumentMut, Item, Table, Value};

/// Number of frames for the search of settings, spread over the recording, and number of frames in the picture.
const LOOKED_AT: usize = 40;
const SHOWN: usize = 4;
/// Beads marked in a frame; more than a field of view holds.
const MOST_BEADS: usize = 100;

/// What was found.
#[derive(Debug, Clone, Serialize)]
pub struct FoundBeads {
    /// Which camera.
    pub camera: String,
    /// The table `[vision]`.
    pub vision: LocaliserConfig,
    /// Distinct objects in the examined frames.
    pub objects: usize,
    /// Objects accepted as beads.
    pub taken: usize,
    /// Refused objects: cut by the border, of unusual size or contrast, or not fitted by the mean profile.
    pub refused: [usize; 3],
    /// Median contrast over noise.
    pub snr: f64,
    /// Whether it moved by less than its radius, as dirt does: a free bead of 1 um diffuses by more in a second.
    pub rests: bool,
    /// How the loop's tracker sees with these settings.
    pub sight: Sight,
}

/// Records the camera of a rig for a time, finds settings for its beads and tries them with the loop's tracker. The picture marks
/// the accepted beads in a few frames below each other; there is a picture even if no bead was found.
///
/// # Errors
/// The camera does not deliver, or the rig follows a cell.
pub fn find(
    bench: &Bench,
    duration_s: f64,
) -> Result<(Result<FoundBeads, Failure>, RgbImage), Failure> {
    if bench.file().follows_a_cell() {
        return Err(Failure::bad_input(
            "[cell]: this rig follows a cell, which needs no description of a bead",
            "cells are found against the background of [cell]; take the table out for beads",
        ));
    }
    let capture = Capture::of(bench, duration_s)?;
    let spread = |count: usize| -> Vec<&FrameBuffer> {
        let stride = capture.frames.len().div_ceil(count).max(1);
        let frames = capture.frames.iter().step_by(stride);
        frames.map(|kept| &kept.frame).collect()
    };
    let frames: Vec<Frame> = spread(LOOKED_AT)
        .iter()
        .map(|frame| frame.frame())
        .collect();
    let found = suggest(&frames).map_err(|error| {
        Failure::Failed(miette::miette!(
            help = "bring a bead into view and into focus and give it more light; where objects of other kinds are in view record them \
                    (cellpos camera --rig RIG --record beads/) and give cellpos vision beads/ the size of the beads",
            "{}: {error}",
            capture.camera
        ))
    });
    let shown = spread(SHOWN);
    match found {
        Err(failure) => Ok((Err(failure), sheet(&shown, None)?)),
        Ok(found) => {
            let picture = sheet(&shown, Some(&found.config))?;
            Ok((tried(bench, &capture, found), picture))
        }
    }
}

/// The settings and the tracker's result with them.
fn tried(bench: &Bench, capture: &Capture, found: Suggestion) -> Result<FoundBeads, Failure> {
    let localiser = Localiser::new(found.config.clone()).map_err(Failure::input)?;
    let radius_px = localiser.template().radius_px();
    let sight = Sight::of_bead(bench, localiser, &capture.frames)?;
    if 2 * sight.seen < sight.frames.max(1) {
        return Err(Failure::Failed(miette::miette!(
            help = "the picture shows what was taken for beads: are they in focus, alone, and nothing else of that size? Record them \
                    (cellpos camera --rig RIG --record beads/) and see what cellpos vision beads/ says of each",
            "{}: the tracker believed in a bead in only {} of {} frames with the settings that were found",
            capture.camera,
            sight.seen,
            sight.frames
        )));
    }
    Ok(FoundBeads {
        camera: capture.camera.clone(),
        objects: found.objects,
        taken: found.taken,
        refused: [
            found.refused.at_border,
            found.refused.other,
            found.refused.bad_fit,
        ],
        snr: found.snr,
        vision: found.config,
        rests: sight.way_px < radius_px,
        sight,
    })
}

/// Frames below each other, enlarged, with the beads that settings find marked.
fn sheet(frames: &[&FrameBuffer], config: Option<&LocaliserConfig>) -> Result<RgbImage, Failure> {
    const WIDE_PX: u32 = 1024;
    let mut localiser = config
        .map(|config| Localiser::new(config.clone()))
        .transpose()
        .map_err(Failure::input)?;
    let width = frames.iter().map(|frame| frame.width as u32).max();
    let scale = (WIDE_PX / width.unwrap_or(1).max(1)).clamp(1, 4);
    let mut parts = Vec::new();
    for frame in frames {
        let small = picture(frame);
        let mut large = RgbImage::from_fn(scale * small.width(), scale * small.height(), |x, y| {
            *small.get_pixel(x / scale, y / scale)
        });
        if let Some(localiser) = &mut localiser {
            let mut detector = Detector::thorough(localiser, MOST_BEADS);
            let radius_px = localiser.template().radius_px();
            for blob in detector.detect(&frame.frame()) {
                let fix = localiser.locate(&frame.frame(), Some((blob.x_px, blob.y_px)));
                if fix.verdict == FixQuality::Good {
                    // The centre of a pixel is kept in the enlarged picture.
                    let at = |px: f64| (px + 0.5) * f64::from(scale) - 0.5;
                    let seen = Seen {
                        x_px: at(fix.x_px),
                        y_px: at(fix.y_px),
                        half_px: 1.5 * radius_px * f64::from(scale),
                        snr: fix.snr,
                        sd_px: fix.var_x_px2.sqrt(),
                        position_um: None,
                    };
                    mark(&mut large, &seen);
                }
            }
        }
        parts.push(large);
    }
    const GAP_PX: u32 = 4;
    let width = parts.iter().map(RgbImage::width).max().unwrap_or(1);
    let height = parts.iter().map(|part| part.height() + GAP_PX).sum::<u32>();
    let mut sheet = RgbImage::from_pixel(width, height.max(1), image::Rgb([255; 3]));
    let mut top = 0;
    for part in &parts {
        image::imageops::replace(&mut sheet, part, 0, i64::from(top));
        top += part.height() + GAP_PX;
    }
    Ok(sheet)
}

/// Writes the table `[vision]` of a rig file and changes nothing else, not even comments. True if there was a table.
///
/// # Errors
/// The file cannot be read or written, or is not TOML.
pub fn write_vision(rig: &Path, vision: &LocaliserConfig) -> Result<bool, Failure> {
    change(rig, "[vision]", |document| set(document, vision))
}

/// Gives the text of a rig file another table `[vision]`. True if there was one.
fn set(document: &mut DocumentMut, vision: &LocaliserConfig) -> Result<bool, String> {
    let words = |error: &dyn std::fmt::Display| error.to_string();
    let new: DocumentMut = toml::to_string(vision)
        .map_err(|error| words(&error))?
        .parse()
        .map_err(|error| words(&error))?;
    let old = document.remove("vision");
    let replaced = old.is_some();
    let mut table = match old {
        Some(Item::Table(mut old)) => {
            old.clear();
            old
        }
        _ => {
            let mut table = Table::new();
            table.decor_mut().set_prefix("\n");
            table
        }
    };
    for (key, item) in new.iter() {
        // Inner tables are written as a key of this table.
        let value = match item.clone() {
            Item::Table(inner) => Value::InlineTable(inner.into_inline_table()),
            Item::Value(value) => value,
            _ => continue,
        };
        table.insert(key, Item::Value(value));
    }
    document.insert("vision", Item::Table(table));
    Ok(replaced)
}

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_session::RigFile;
    use cellpos_vision::{Polarity, ProfileSpec};

    fn with_vision(text: &str, vision: &LocaliserConfig) -> Result<(String, bool), String> {
        let mut document: DocumentMut = text.parse().expect("TOML");
        let replaced = set(&mut document, vision)?;
        Ok((document.to_string(), replaced))
    }

    const RIG: &str = "# my rig\nfirst_neutral = \"20um\"   # believed\n\n[actuator]\nkind = \"emulated\"\n\n# what it looks like\n\
        [vision]                 # found by hand\nwindow_px = 21   # odd\nprofile = { kind = \"ring\", edge_px = 5.0 }\n\
        [vision.noise]\nkind = \"estimated\"\n\n[limits]    # of the command\npark = \"20um\"  # middle\n";

    #[test]
    fn another_table_takes_the_place_of_the_old_one_and_every_comment_elsewhere_stays() {
        let mut vision = LocaliserConfig::new(ProfileSpec::Gaussian { sigma_px: 2.5 });
        vision.polarity = Polarity::Dark;
        let without = RIG.replace("[vision]                 # found by hand\nwindow_px = 21   # odd\nprofile = { kind = \"ring\", edge_px = 5.0 }\n[vision.noise]\nkind = \"estimated\"\n", "");
        for (text, had_one) in [
            (RIG.to_string(), true),
            (without, false),
            (String::new(), false),
        ] {
            let (new, replaced) = with_vision(&text, &vision).expect("TOML");
            assert_eq!(replaced, had_one, "{new}");
            let kept = text
                .lines()
                .filter(|line| line.contains('#') && !line.contains("odd"));
            for line in kept {
                assert!(new.contains(line), "lost {line:?} in\n{new}");
            }
            assert!(
                !new.contains("edge_px") && !new.contains("[vision."),
                "{new}"
            );
            let folder = tempfile::tempdir().expect("a folder");
            let path = folder.path().join("rig.toml");
            std::fs::write(&path, &new).expect("written");
            let file =
                RigFile::load(Some(&path)).unwrap_or_else(|error| panic!("{error:?}\n{new}"));
            let read = file
                .bead_settings()
                .unwrap_or_else(|error| panic!("{error:?}"));
            assert_eq!(read, vision, "{new}");
            if had_one {
                assert_eq!(file.limits.park_um, 20.0);
            }
            // A second time changes nothing.
            assert_eq!(with_vision(&new, &vision).expect("TOML").0, new);
        }
    }

    #[test]
    fn a_file_that_is_no_toml_stays_as_it_is() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("rig.toml");
        std::fs::write(&path, "[vision\nx = 1").expect("written");
        let vision = LocaliserConfig::new(ProfileSpec::Gaussian { sigma_px: 2.5 });
        let error = write_vision(&path, &vision)
            .expect_err("no TOML")
            .to_string();
        assert!(
            error.contains("rig.toml") && error.contains("[vision]"),
            "{error}"
        );
        assert_eq!(
            std::fs::read_to_string(&path).expect("there"),
            "[vision\nx = 1"
        );
    }
}
