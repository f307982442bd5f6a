//! A frame as a picture, if wanted with the bead or cell as vision sees it.

use crate::bench::Bench;
use cellpos_drivers::sources::{self, SourceError};
use cellpos_rig::{Camera, Clock, FrameBuffer};
use cellpos_session::Failure;
use cellpos_vision::{CellTracker, Commanded, Localiser, Tracker, TrackerConfig};
use image::{Rgb, RgbImage};
use serde::Serialize;
use std::path::Path;

/// How long a frame may let wait, ns.
const PATIENCE_NS: i64 = 2_000_000_000;
/// Longest search for a bead or cell, ns: after a lost one the next may come.
const LOOKING_NS: i64 = 5_000_000_000;

/// Result of the frame that was kept.
#[derive(Debug, Clone, Serialize)]
pub struct Snapshot {
    /// Which camera.
    pub camera: String,
    /// Pixels per row.
    pub width_px: usize,
    /// Rows.
    pub height_px: usize,
    /// Darkest and brightest pixel, and full scale, grey levels: light and gain are well set when the brightest stays below
    /// full scale.
    pub grey: [u16; 3],
    /// Bead or cell, if requested and seen.
    pub seen: Option<Seen>,
}

/// A bead or a cell in a frame.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Seen {
    /// Column, px.
    pub x_px: f64,
    /// Row, px.
    pub y_px: f64,
    /// Half width of the mark drawn around it, px.
    pub half_px: f64,
    /// Contrast over noise.
    pub snr: f64,
    /// Standard deviation of the column, as stated by the fit, px.
    pub sd_px: f64,
    /// Position along the channel, um; none without a calibration.
    pub position_um: Option<f64>,
}

/// The next frame of a camera.
///
/// # Errors
/// None comes.
pub fn next_frame(camera: &mut dyn Camera, buffer: &mut FrameBuffer) -> Result<i64, Failure> {
    let deadline_ns = Clock::Real.now_ns() + PATIENCE_NS;
    match camera.next_frame(buffer, deadline_ns) {
        Ok(Some(stamp)) => Ok(stamp.mid_exposure_ns),
        Ok(None) => Err(Failure::bad_input(
            format!("{}: no frame for 2 s", camera.info().name),
            "test it with cellpos camera",
        )),
        Err(error) => Err(Failure::failed(error)),
    }
}

/// Takes a frame; with `overlay` the first in which a bead or cell is seen, if one is within five seconds.
///
/// # Errors
/// No frame comes, or a setting that vision needs is missing.
pub fn take(bench: &Bench, overlay: bool) -> Result<(Snapshot, RgbImage), Failure> {
    let mut camera = bench.camera()?;
    let mut buffer = FrameBuffer::default();
    let start_ns = next_frame(camera.as_mut(), &mut buffer)?;
    let mut seen = None;
    if overlay {
        let mut eye = Eye::of(bench)?;
        let end_ns = Clock::Real.now_ns() + LOOKING_NS;
        while seen.is_none() && Clock::Real.now_ns() < end_ns {
            let at_ns = next_frame(camera.as_mut(), &mut buffer)?;
            seen = eye.look(&buffer, (at_ns - start_ns) as f64 * 1e-9)?;
        }
    }
    let grey = grey_levels(&buffer);
    let mut picture = picture(&buffer);
    if let Some(seen) = &seen {
        mark(&mut picture, seen);
    }
    let snapshot = Snapshot {
        camera: camera.info().name,
        width_px: buffer.width,
        height_px: buffer.height,
        grey,
        seen,
    };
    Ok((snapshot, picture))
}

/// Finds the bead or the cell of a rig file, frame by frame.
pub enum Eye {
    /// A bead.
    Bead(Box<Tracker>, Option<cellpos_drivers::Calibration>),
    /// A cell.
    Cell(Box<CellTracker>, Option<cellpos_drivers::Calibration>),
}

impl Eye {
    /// As the rig file describes it.
    ///
    /// # Errors
    /// Invalid settings; no background for a cell.
    pub fn of(bench: &Bench) -> Result<Self, Failure> {
        let file = bench.file();
        if file.follows_a_cell() {
            let config = tracker_config(bench);
            let tracker = CellTracker::new(file.finder()?, config).map_err(Failure::input)?;
            Ok(Self::Cell(Box::new(tracker), file.calibration))
        } else {
            Self::of_bead(bench, file.localiser()?)
        }
    }

    /// Finds a bead with another localiser.
    ///
    /// # Errors
    /// Invalid settings of the tracker.
    pub fn of_bead(bench: &Bench, localiser: Localiser) -> Result<Self, Failure> {
        let tracker = Tracker::new(localiser, tracker_config(bench)).map_err(Failure::input)?;
        Ok(Self::Bead(Box::new(tracker), bench.file().calibration))
    }

    /// Looks at the next frame; `None` without a valid object.
    ///
    /// # Errors
    /// A frame of another size than the background.
    pub fn look(&mut self, buffer: &FrameBuffer, time_s: f64) -> Result<Option<Seen>, Failure> {
        let frame = buffer.frame();
        let (fix, half_px, calibration) = match self {
            Self::Bead(tracker, calibration) => {
                let step = tracker.step(Some(&frame), time_s, Commanded::default());
                let half_px = 10.0;
                (
                    step.decision.is_accepted().then_some(step.fix),
                    half_px,
                    *calibration,
                )
            }
            Self::Cell(tracker, calibration) => {
                let step = tracker
                    .step(Some(&frame), time_s, Commanded::default())
                    .map_err(Failure::input)?;
                let half_px = step.cell.map_or(10.0, |cell| cell.area_px.sqrt() * 0.6);
                let accepted = step.track.decision.is_accepted();
                (accepted.then_some(step.track.fix), half_px, *calibration)
            }
        };
        Ok(fix.map(|fix| Seen {
            x_px: fix.x_px,
            y_px: fix.y_px,
            half_px,
            snr: fix.snr,
            sd_px: fix.var_x_px2.sqrt(),
            position_um: calibration.map(|c| c.position_um(fix.x_px, fix.y_px)),
        }))
    }
}

fn tracker_config(bench: &Bench) -> TrackerConfig {
    /// Pixel size assumed before a calibration, for a bead of 1 um under a 100x objective, um.
    const USUAL_PIXEL_UM: f64 = 0.1;
    let file = bench.file();
    let pixel_um = file.calibration.map_or(USUAL_PIXEL_UM, |c| c.pixel_um);
    file.tracking
        .unwrap_or_else(|| TrackerConfig::for_pixel_um(pixel_um))
}

fn full_scale(buffer: &FrameBuffer) -> u16 {
    u16::try_from((1_u32 << buffer.bits.clamp(1, 16)) - 1).unwrap_or(u16::MAX)
}

fn grey_levels(buffer: &FrameBuffer) -> [u16; 3] {
    let levels = |each: &mut dyn Iterator<Item = u16>| {
        each.fold((u16::MAX, 0), |(low, high), p| (low.min(p), high.max(p)))
    };
    let (low, high) = if buffer.bits > 8 {
        levels(&mut buffer.mono16.iter().copied())
    } else {
        levels(&mut buffer.mono8.iter().map(|p| u16::from(*p)))
    };
    [low, high, full_scale(buffer)]
}

pub(crate) fn picture(buffer: &FrameBuffer) -> RgbImage {
    let full = f64::from(full_scale(buffer));
    let (width, height) = (buffer.width as u32, buffer.height as u32);
    RgbImage::from_fn(width, height, |x, y| {
        let at = y as usize * buffer.width + x as usize;
        let grey = if buffer.bits > 8 {
            f64::from(buffer.mono16.get(at).copied().unwrap_or(0)) / full * 255.0
        } else {
            f64::from(buffer.mono8.get(at).copied().unwrap_or(0))
        };
        Rgb([grey as u8; 3])
    })
}

/// A square around the object, and a cross at its centre.
pub(crate) fn mark(picture: &mut RgbImage, seen: &Seen) {
    const COLOUR: Rgb<u8> = Rgb([255, 64, 0]);
    let (x, y, half) = (
        seen.x_px.round() as i64,
        seen.y_px.round() as i64,
        seen.half_px.round() as i64,
    );
    let mut dot = |x: i64, y: i64| {
        if let (Ok(x), Ok(y)) = (u32::try_from(x), u32::try_from(y))
            && x < picture.width()
            && y < picture.height()
        {
            picture.put_pixel(x, y, COLOUR);
        }
    };
    for k in -half..=half {
        dot(x + k, y - half);
        dot(x + k, y + half);
        dot(x - half, y + k);
        dot(x + half, y + k);
    }
    for k in -2..=2 {
        dot(x + k, y);
        dot(x, y + k);
    }
}

/// Spacing of the lines of a stage micrometre in a picture: along the rows or along the columns, wherever they repeat, px, with
/// its standard deviation.
///
/// # Errors
/// The picture cannot be read, or has no lines that repeat at least four times.
pub fn line_spacing(path: &Path) -> Result<(f64, f64), Failure> {
    let read = || -> Result<FrameBuffer, SourceError> {
        let mut buffer = FrameBuffer::default();
        sources::open(path)?.read(0, &mut buffer)?;
        Ok(buffer)
    };
    let buffer = read().map_err(Failure::input)?;
    let frame_at = |at: usize| -> f64 {
        if buffer.bits > 8 {
            buffer.mono16.get(at).map_or(0.0, |p| f64::from(*p))
        } else {
            buffer.mono8.get(at).map_or(0.0, |p| f64::from(*p))
        }
    };
    let (width, height) = (buffer.width, buffer.height);
    let across = |x: usize| (0..height).map(|y| frame_at(y * width + x)).sum::<f64>();
    let along = |y: usize| (0..width).map(|x| frame_at(y * width + x)).sum::<f64>();
    let rows: Vec<f64> = (0..width).map(across).collect();
    let columns: Vec<f64> = (0..height).map(along).collect();
    [rows, columns]
        .iter()
        .filter_map(|profile| spacing(profile))
        .min_by(|a, b| (a.1 / a.0).total_cmp(&(b.1 / b.0)))
        .ok_or_else(|| {
            Failure::bad_input(
                format!("{}: no lines that repeat at least four times", path.display()),
                "focus on the stage micrometre, its lines across the channel, with ten lines or more in view",
            )
        })
}

/// Spacing of the lines of a profile, and its standard deviation. A straight line is fitted to the lines' places (centroids of
/// the pixels darker or brighter than the middle) against their numbers.
fn spacing(profile: &[f64]) -> Option<(f64, f64)> {
    let n = profile.len() as f64;
    let mean = profile.iter().sum::<f64>() / n;
    let dark = profile.iter().filter(|v| **v < mean).count() * 2 < profile.len();
    let depth: Vec<f64> = (profile.iter())
        .map(|v| if dark { mean - v } else { v - mean })
        .collect();
    let deepest = depth.iter().copied().fold(0.0, f64::max);
    let (mut lines, mut weight, mut moment, mut from_border) = (Vec::new(), 0.0, 0.0, true);
    for (x, d) in depth.iter().enumerate() {
        let d = d - 0.5 * deepest;
        if d > 0.0 {
            weight += d;
            moment += d * x as f64;
        } else {
            // A line cut off by the border has its centroid in the wrong place.
            if weight > 0.0 && !from_border {
                lines.push(moment / weight);
            }
            (weight, moment, from_border) = (0.0, 0.0, false);
        }
    }
    let count = lines.len() as f64;
    if count < 4.0 {
        return None;
    }
    let middle = 0.5 * (count - 1.0);
    let centre = lines.iter().sum::<f64>() / count;
    let numbers: f64 = (0..lines.len()).map(|k| (k as f64 - middle).powi(2)).sum();
    let slope = (lines.iter().enumerate())
        .map(|(k, x)| (k as f64 - middle) * (x - centre))
        .sum::<f64>()
        / numbers;
    let residual: f64 = (lines.iter().enumerate())
        .map(|(k, x)| (x - centre - slope * (k as f64 - middle)).powi(2))
        .sum();
    let sd = (residual / (count - 2.0) / numbers).sqrt();
    // Unevenly spaced lines are not a stage micrometre.
    (sd * numbers.sqrt() < 0.1 * slope).then_some((slope, sd))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_lines_of_a_micrometre_give_their_spacing_and_noise_gives_none() {
        let lines = |spacing: f64| -> Vec<f64> {
            (0..400)
                .map(|x| {
                    let phase = (x as f64 + 3.3) / spacing;
                    let off = (phase - phase.round()) * spacing;
                    200.0 - 120.0 * (-off * off / 8.0).exp()
                })
                .collect()
        };
        for truth in [20.0, 33.37, 61.2] {
            let (found, sd) = spacing(&lines(truth)).expect("lines");
            assert!((found - truth).abs() < 0.02 && sd < 0.05, "{found} +- {sd}");
        }
        let mut value = 0.3_f64;
        let noise: Vec<f64> = (0..400)
            .map(|_| {
                value = 3.99 * value * (1.0 - value);
                100.0 * value
            })
            .collect();
        assert_eq!(spacing(&noise), None);
    }
}
