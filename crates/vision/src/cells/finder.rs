//! The finder: background, regions, outlines.

use super::background::Background;
use super::focus::{Last, Left, Moved};
use super::regions::{Part, Regions, is_object};
use super::softer::{MOST_REACH, Softer};
use super::{Cell, CellConfig, CellError};
use crate::blobs::Blob;
use crate::config::ConfigError;
use crate::frame::{Frame, Pixels};
use crate::outline::{Contrast, MAX_RAYS, Outline, Outliner};

/// An object needs a patch of this many times the threshold.
const SEED: f64 = 2.0;
/// An outline less convex than this is that of two cells: two discs that touch have 0.88.
const LEAST_SOLIDITY: f64 = 0.93;
/// Depth of a waist (both dents together) and of a single dent, as a share of the short half axis: two discs of one radius whose
/// middles are 0.7 radii apart have a waist of 0.13. And so many standard deviations of a point of the outline.
const WAIST: f64 = 0.07;
const DENT: f64 = 0.15;
const DENT_SIGMA: f64 = 3.0;
/// Width of a halo that belongs to the cell, px and share of the short half axis.
const HALO: (f64, f64) = (6.0, 0.35);
/// Largest shift and blur of a frame that the background follows, px.
const MOST_REFRESHED_PX: f64 = 0.5;
/// Cells of a frame whose outlines are kept.
const KEPT_OUTLINES: usize = 8;
/// Contrast that counts at most, in RMS contrasts of the region.
const MOST_CONTRAST: f32 = 3.0;
/// Share of the region's RMS contrast that another cell next to it has: fringes are weaker.
const BESIDE: f64 = 0.6;
/// Share of the cell's area that may lie beyond its halo.
const MOST_BESIDE: f64 = 0.2;

/// Finds cells against a background learnt from frames without them.
#[derive(Debug, Clone)]
pub struct CellFinder {
    config: CellConfig,
    width: usize,
    height: usize,
    background: Background,
    /// Signed contrast of the last frame, grey levels.
    contrast: Vec<f32>,
    /// Room for another explanation of the same pixels.
    other: Vec<f32>,
    regions: Regions,
    outliner: Outliner,
    cells: Vec<Cell>,
    /// Outlines of the first cells, px.
    outlines: Vec<Vec<(f64, f64)>>,
    /// Regions of the last frame that were no cells.
    dust: u32,
    /// Light of the last frame relative to the background's.
    light: f32,
    /// How the last frame differs from the background.
    moved: Moved,
    last: Last,
    softer: Softer,
    /// A row of the moved background, and what lies beyond it.
    row: Vec<f32>,
}

impl CellFinder {
    /// Buffers for frames of `width` x `height` pixels.
    ///
    /// # Errors
    /// Names the first setting that cannot be used.
    pub fn new(width: usize, height: usize, config: CellConfig) -> Result<Self, ConfigError> {
        let range = |key, value: f64, low: f64, high: f64, must_be| {
            if value >= low && value <= high {
                Ok(())
            } else {
                Err(ConfigError {
                    key,
                    value,
                    must_be,
                })
            }
        };
        range("width", width as f64, 1.0, 16384.0, "1 to 16384 px")?;
        range("height", height as f64, 1.0, 16384.0, "1 to 16384 px")?;
        range(
            "threshold_sigma",
            config.threshold_sigma,
            1.0,
            100.0,
            "1 to 100 standard deviations",
        )?;
        range("min_area_px", config.min_area_px, 1.0, 1e9, "1 px or more")?;
        range(
            "max_regions",
            f64::from(config.max_regions),
            1.0,
            65_536.0,
            "1 to 65536",
        )?;
        range(
            "refresh_frames",
            f64::from(config.refresh_frames),
            0.0,
            1e9,
            "0 (never) to 1e9 frames",
        )?;
        let max_regions = config.max_regions as usize;
        Ok(CellFinder {
            config,
            width,
            height,
            background: Background::new(width, height),
            contrast: vec![0.0; width * height],
            other: vec![0.0; width * height],
            regions: Regions::new(width, height, max_regions),
            outliner: Outliner::new(),
            cells: Vec::with_capacity(16 * max_regions),
            outlines: (0..KEPT_OUTLINES)
                .map(|_| Vec::with_capacity(MAX_RAYS))
                .collect(),
            dust: 0,
            light: 1.0,
            moved: Moved::default(),
            last: Last::none(),
            softer: Softer::new(width * height),
            row: vec![0.0; width + 2 * MOST_REACH],
        })
    }

    /// The settings.
    pub fn config(&self) -> &CellConfig {
        &self.config
    }

    /// Whether outlines use all rays and all passes. The fast way uses every other ray of a large cell and stops when nothing
    /// moves.
    pub fn set_thorough(&mut self, thorough: bool) {
        self.outliner.thorough = thorough;
    }

    /// Sets the motion of cells during the next frames, from the start to the end of an exposure (px); zeros for a shutter too
    /// fast to matter. The outline is that at mid-exposure.
    pub fn expect_smear(&mut self, way_px: (f64, f64)) {
        self.outliner.expect_smear(way_px);
    }

    /// Takes a frame without a cell into the background (running mean over all such frames).
    ///
    /// # Errors
    /// A frame of another size.
    pub fn take_background(&mut self, frame: &Frame) -> Result<(), CellError> {
        match frame.pixels {
            Pixels::Mono8(p) => {
                let p = self.checked(frame, p)?;
                self.background.average(p);
            }
            Pixels::Mono16(p) => {
                let p = self.checked(frame, p)?;
                self.background.average(p);
            }
        }
        Ok(())
    }

    /// Takes one picture of the empty channel, a mean of many, for the background in place of frames; the noise must then be
    /// learnt from frames.
    ///
    /// # Errors
    /// A frame of another size.
    pub fn set_background(&mut self, frame: &Frame) -> Result<(), CellError> {
        match frame.pixels {
            Pixels::Mono8(p) => {
                let p = self.checked(frame, p)?;
                self.background.be(p);
            }
            Pixels::Mono16(p) => {
                let p = self.checked(frame, p)?;
                self.background.be(p);
            }
        }
        Ok(())
    }

    /// Learns the noise from a frame of which less than half shows cells; the least of several counts. Allocates.
    ///
    /// # Errors
    /// A frame of another size, or no background yet.
    pub fn learn_noise(&mut self, frame: &Frame) -> Result<(), CellError> {
        if self.background.frames < 2 {
            return Err(CellError::NoBackground);
        }
        match frame.pixels {
            Pixels::Mono8(p) => {
                let p = self.checked(frame, p)?;
                self.background.learn_noise(p);
            }
            Pixels::Mono16(p) => {
                let p = self.checked(frame, p)?;
                self.background.learn_noise(p);
            }
        }
        Ok(())
    }

    /// Noise of a pixel, grey levels: the scatter of the background frames, at least that of rounding.
    pub fn noise_grey(&self) -> f64 {
        self.background.noise_grey()
    }

    /// Cells of a frame, the largest sum of contrast first. The background is scaled to the frame's light, so that flicker
    /// of the lamp is not taken for cells.
    ///
    /// # Errors
    /// A frame of another size, or no background yet.
    pub fn find(&mut self, frame: &Frame) -> Result<&[Cell], CellError> {
        if self.background.frames < 2 {
            return Err(CellError::NoBackground);
        }
        match frame.pixels {
            Pixels::Mono8(p) => {
                self.checked(frame, p)?;
                self.measure(p);
            }
            Pixels::Mono16(p) => {
                self.checked(frame, p)?;
                self.measure(p);
            }
        }
        Ok(&self.cells)
    }

    /// Cells of the last frame, as [`CellFinder::find`] gave them.
    pub fn found(&self) -> &[Cell] {
        &self.cells
    }

    /// Regions of the last frame that stood out but have no outline, or one smaller than a cell.
    pub fn dust(&self) -> u32 {
        self.dust
    }

    /// Outline (px) of the cell `k` of the last frame, of the first few; empty for others.
    pub fn outline(&self, k: usize) -> &[(f64, f64)] {
        let known = k < self.cells.len();
        self.outlines
            .get(k)
            .filter(|_| known)
            .map_or(&[], Vec::as_slice)
    }

    /// Whether the last frame held more than there was room for: then it is no picture of a few cells, and what was found
    /// may be parts.
    pub fn is_cluttered(&self) -> bool {
        self.regions.is_cluttered()
    }

    /// Lets the background follow the last frame given to [`CellFinder::find`]: a sixteenth of the rows at a time, each by a
    /// little. Near a region it changes as the pixels around it do, so a cell is never taken in, however long it stays.
    pub fn refresh(&mut self, frame: &Frame) {
        // In quite another light it is not the background that has changed.
        let frames = self.config.refresh_frames;
        let (x_px, y_px) = self.moved.shift_px;
        let moved = f64::hypot(x_px, y_px).max(self.moved.blur_px) > MOST_REFRESHED_PX;
        if frames == 0 || moved || self.is_cluttered() || !(0.8..1.25).contains(&self.light) {
            return;
        }
        let bounds = &self.regions.bounds;
        match frame.pixels {
            Pixels::Mono8(p) => self.background.refresh(p, self.light, frames, bounds),
            Pixels::Mono16(p) => self.background.refresh(p, self.light, frames, bounds),
        }
    }

    fn checked<'p, T>(&self, frame: &Frame, pixels: &'p [T]) -> Result<&'p [T], CellError> {
        if (frame.width, frame.height) != (self.width, self.height) {
            return Err(CellError::Size {
                width: frame.width,
                height: frame.height,
                expected_width: self.width,
                expected_height: self.height,
            });
        }
        let expected = self.width * self.height;
        pixels.get(..expected).ok_or(CellError::Truncated {
            pixels: pixels.len(),
            expected,
        })
    }

    fn measure<T: Copy>(&mut self, pixels: &[T])
    where
        f32: From<T>,
    {
        let light = self.background.light_of(pixels);
        self.light = light;
        self.background.choose_steep();
        self.softer.follow(&self.background, &mut self.row);
        let softer = &self.softer;
        self.moved = self.background.moved(softer, pixels, light, &mut self.last);
        self.outliner.expect_blur(self.moved.blur_px);
        let noise = self.noise_grey();
        let threshold = self.config.threshold_sigma * noise;
        self.compare(pixels, self.moved);
        if !self.last.is_noise {
            self.compare_by_rows(pixels, threshold as f32);
        }
        self.background.calm(&mut self.contrast);
        let strong = (SEED * threshold).powi(2);
        self.regions
            .find(&self.contrast, self.width, threshold as f32, strong);
        self.cells.clear();
        self.dust = 0;
        let size = (self.width, self.height);
        for blob in self.regions.found() {
            if !is_object(blob, strong) {
                self.dust = self.dust.saturating_add(1);
                continue;
            }
            let mean_square = blob.contrast_sum / blob.area_px;
            let contrast = Contrast {
                pixels: &self.contrast,
                width: self.width,
                height: self.height,
                within: self.regions.room(blob, size),
                most: MOST_CONTRAST * mean_square.max(0.0).sqrt() as f32,
            };
            let parts = self.regions.parts(blob);
            for k in 0..parts.len() {
                let part = parts.get(k);
                let start = self.regions.start(blob, &part);
                let outline = start.and_then(|s| self.outliner.outline(&contrast, &s, noise));
                match outline {
                    Some(outline)
                        if outline.area_px >= self.config.min_area_px
                            && self.cells.len() < self.cells.capacity() =>
                    {
                        let strong = strong.max(BESIDE * BESIDE * mean_square) as f32;
                        let beside = beside(&self.regions, blob, &part, &outline, strong);
                        if let Some(kept) = self.outlines.get_mut(self.cells.len()) {
                            kept.clear();
                            kept.extend(self.outliner.points().iter().take(MAX_RAYS));
                        }
                        self.cells.push(cell(blob, &outline, beside, noise));
                    }
                    _ => self.dust = self.dust.saturating_add(1),
                }
            }
        }
    }
}

/// What a frame differs by from the background.
impl CellFinder {
    /// From the background moved and blurred.
    fn compare<T: Copy>(&mut self, pixels: &[T], moved: Moved)
    where
        f32: From<T>,
    {
        let light = self.light;
        if moved.is_none() {
            let means = pixels.iter().zip(&self.background.mean);
            for (c, (p, m)) in self.contrast.iter_mut().zip(means) {
                *c = f32::from(*p) - light * m;
            }
        } else {
            let buffers = (self.contrast.as_mut_slice(), self.row.as_mut_slice());
            self.background
                .contrast_moved(pixels, light, moved, buffers);
        }
    }

    /// Without what whole rows differ by: from the moved background or from the one at rest, by whichever the walls are explained
    /// better. What belongs to the camera does not move with the walls.
    fn compare_by_rows<T: Copy>(&mut self, pixels: &[T], threshold: f32)
    where
        f32: From<T>,
    {
        self.background.take_off_rows(&mut self.contrast, threshold);
        let explained = |left: &Option<Left>| left.as_ref().is_none_or(|left| left.is_noise);
        let moved = self.background.left_in(&self.contrast);
        if self.moved.is_none() || explained(&moved) {
            return;
        }
        std::mem::swap(&mut self.contrast, &mut self.other);
        self.compare(pixels, Moved::default());
        self.background.take_off_rows(&mut self.contrast, threshold);
        let cost = |left: Option<Left>| left.map_or(f64::INFINITY, |left| left.cost);
        if cost(self.background.left_in(&self.contrast)) > cost(moved) {
            std::mem::swap(&mut self.contrast, &mut self.other);
        }
    }
}

/// Whether the outline is that of two objects in one.
fn is_of_two(outline: &Outline) -> bool {
    let sd = DENT_SIGMA * outline.point_variance.sqrt();
    let short_px = short_half_axis_px(outline);
    let [deepest, second] = outline.dents_px;
    // Where the outline has no edge it goes over a gap between two. A gap that is narrower than an edge does not show.
    outline.solidity < LEAST_SOLIDITY
        || outline.open_px > outline.edge_px
        || deepest > DENT * short_px + sd
        || second > 0.25 * deepest && deepest + second > WAIST * short_px + sd
}

/// Short half axis of the ellipse with the outline's moments, px.
fn short_half_axis_px(outline: &Outline) -> f64 {
    let [xx, xy, yy] = outline.moments_px2;
    let (mean, half) = (0.5 * (xx + yy), 0.5 * f64::hypot(xx - yy, 2.0 * xy));
    2.0 * (mean - half).max(1.0).sqrt()
}

/// Area of what stands out strongly beyond the outline and its halo, px.
fn beside(regions: &Regions, blob: &Blob, part: &Part, outline: &Outline, strong: f32) -> f64 {
    let [xx, xy, yy] = outline.moments_px2;
    let determinant = (xx * yy - xy * xy).max(1e-9);
    let short_px = short_half_axis_px(outline);
    let reach = 1.0 + HALO.0 / short_px + HALO.1;
    regions.area_where(blob, strong, |x, y| {
        let (dx, dy) = (x - outline.x_px, y - outline.y_px);
        let r2 = (yy * dx * dx - 2.0 * xy * dx * dy + xx * dy * dy) / determinant;
        // A uniform ellipse has a quarter of its squared half axes as second moments.
        r2 > 4.0 * reach * reach && part.holds(x, y)
    })
}

fn cell(blob: &Blob, outline: &Outline, beside_px: f64, noise: f64) -> Cell {
    let [var_x_px2, var_y_px2, cov_xy_px2] = outline.place_variances;
    Cell {
        x_px: outline.x_px,
        y_px: outline.y_px,
        var_x_px2,
        var_y_px2,
        cov_xy_px2,
        area_px: outline.area_px,
        var_area_px2: outline.area_variance,
        moments_px2: outline.moments_px2,
        moments_var_px4: outline.moment_variances,
        body_grey: outline.rim_grey.abs(),
        dark: outline.rim_grey < 0.0,
        halo_grey: outline.halo_grey.abs(),
        mean_grey: (blob.contrast_sum / blob.area_px).max(0.0).sqrt(),
        peak_grey: blob.peak.max(0.0).sqrt(),
        snr: outline.rim_grey.abs() / noise,
        at_border: outline.at_border,
        in_contact: is_of_two(outline) || beside_px > MOST_BESIDE * outline.area_px,
    }
}
