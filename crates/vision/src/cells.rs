//! Cells: what differs from a background frame, in one connected piece.
//!
//! For objects without a known shape. A cell's outline is where the contrast falls to half of its body's, found between
//! the pixels; place, area, length and width are those of the surface inside. The noise of the outline is known from the
//! slope there, so that the place comes with its covariance. Allocates only when made.

use crate::blobs::{Blob, Blobs};
use crate::config::ConfigError;
use crate::frame::{Frame, Pixels};
use crate::surface::Outliner;
use serde::{Deserialize, Serialize};

/// Runs kept per row.
const RUNS_PER_ROW: usize = 32;
/// Distance from a region within which the background is left alone, px.
const CLEAR_PX: usize = 6;
/// Pixels beside that, whose change stands for that behind the region.
const BESIDE_PX: usize = 12;
/// Each row of the background is refreshed once in so many frames.
const REFRESHED_EVERY: usize = 16;

/// Settings of a [`CellFinder`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CellConfig {
    /// A pixel belongs to a cell when it differs from the background by this many noise standard deviations.
    pub threshold_sigma: f64,
    /// Smallest area of a cell, px.
    pub min_area_px: f64,
    /// Most regions told apart in a frame.
    pub max_regions: u32,
    /// Frames over which the background follows slow changes of light and focus where no cell is; 0: it stays as it was
    /// recorded.
    pub refresh_frames: u32,
}

impl Default for CellConfig {
    fn default() -> Self {
        CellConfig {
            threshold_sigma: 5.0,
            min_area_px: 30.0,
            max_regions: 64,
            // Twenty seconds at 1000 frames a second.
            refresh_frames: 20_000,
        }
    }
}

/// A cell in a frame: its surface, bounded where the contrast is half of the body's. A hole counts as part of it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Cell {
    /// Middle of the surface, px.
    pub x_px: f64,
    /// Middle of the surface, px.
    pub y_px: f64,
    /// Variance of `x_px` from the noise of the pixels at the outline, px^2.
    pub var_x_px2: f64,
    /// Variance of `y_px`, px^2.
    pub var_y_px2: f64,
    /// Covariance of the two, px^2.
    pub cov_xy_px2: f64,
    /// Area, px.
    pub area_px: f64,
    /// Central second moments of the surface: x x, x y, y y, px^2.
    pub moments_px2: [f64; 3],
    /// Contrast of the body, grey levels, whatever its sign.
    pub body_grey: f64,
    /// Mean contrast over the pixels above the threshold, grey levels.
    pub mean_grey: f64,
    /// Largest contrast, grey levels.
    pub peak_grey: f64,
    /// Contrast of the body over the noise of one pixel.
    pub snr: f64,
    /// Whether it touches the frame's border: then all of the above is that of a part.
    pub at_border: bool,
}

impl Cell {
    /// Full length along a direction (a unit vector), px: of the ellipse with the same second moments.
    pub fn extent_px(&self, (ux, uy): (f64, f64)) -> f64 {
        let [xx, xy, yy] = self.moments_px2;
        // A uniform ellipse of full axis L has the second moment L^2 / 16 along it.
        4.0 * (ux * ux * xx + 2.0 * ux * uy * xy + uy * uy * yy)
            .max(0.0)
            .sqrt()
    }

    /// Full length and width along the long and the short axis, px.
    pub fn axes_px(&self) -> (f64, f64) {
        let [xx, xy, yy] = self.moments_px2;
        let (mean, half) = (0.5 * (xx + yy), 0.5 * f64::hypot(xx - yy, 2.0 * xy));
        (
            4.0 * (mean + half).sqrt(),
            4.0 * (mean - half).max(0.0).sqrt(),
        )
    }

    /// Angle of the long axis from the x axis towards y, rad, -pi/2 to pi/2.
    pub fn angle_rad(&self) -> f64 {
        let [xx, xy, yy] = self.moments_px2;
        0.5 * (2.0 * xy).atan2(xx - yy)
    }
}

/// Why a frame was not taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum CellError {
    /// The frame has another size than the finder was made for.
    #[error(
        "frame of {width} x {height} px: this cell finder was made for {expected_width} x {expected_height} px"
    )]
    Size {
        /// Its width, px.
        width: usize,
        /// Its height, px.
        height: usize,
        /// Width expected, px.
        expected_width: usize,
        /// Height expected, px.
        expected_height: usize,
    },
    /// The frame holds fewer pixels than it claims.
    #[error("frame holds {pixels} pixels, its size says {expected}")]
    Truncated {
        /// Pixels held.
        pixels: usize,
        /// Pixels expected.
        expected: usize,
    },
    /// No background yet.
    #[error("no background yet: take in at least 2 frames without a cell")]
    NoBackground,
}

/// Finds cells against a background learnt from frames without them.
#[derive(Debug, Clone)]
pub struct CellFinder {
    config: CellConfig,
    width: usize,
    height: usize,
    mean: Vec<f32>,
    /// Sum of squared deviations from the running mean, over all pixels.
    deviations: f64,
    frames: u32,
    blobs: Blobs,
    outliner: Outliner,
    cells: Vec<Cell>,
    /// Light of the last frame relative to the background's.
    light: f32,
    refreshed: usize,
    /// Changes of the row being refreshed.
    change: Vec<f32>,
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
        // A region shaped like a comb takes a label for each tooth.
        let room = 16 * config.max_regions as usize;
        Ok(CellFinder {
            config,
            width,
            height,
            mean: vec![0.0; width * height],
            deviations: 0.0,
            frames: 0,
            blobs: Blobs::with_spans(room.max(width / 2 + 1), room, RUNS_PER_ROW * height),
            outliner: Outliner::new(width, height),
            cells: Vec::with_capacity(room),
            light: 1.0,
            refreshed: 0,
            change: vec![0.0; width],
        })
    }

    /// Takes a frame without a cell into the background (running mean over all such frames).
    ///
    /// # Errors
    /// A frame of another size.
    pub fn take_background(&mut self, frame: &Frame) -> Result<(), CellError> {
        match frame.pixels {
            Pixels::Mono8(p) => self.average(self.checked(frame, p)?),
            Pixels::Mono16(p) => self.average(self.checked(frame, p)?),
        }
        Ok(())
    }

    /// Noise of a pixel, grey levels: the scatter of the background frames, at least that of rounding.
    pub fn noise_grey(&self) -> f64 {
        let degrees = f64::from(self.frames.saturating_sub(1)) * self.mean.len() as f64;
        (self.deviations / degrees.max(1.0)).max(1.0 / 12.0).sqrt()
    }

    /// Cells of a frame, the largest sum of contrast first. The background is scaled to the frame's light, so that flicker
    /// of the lamp is not taken for cells.
    ///
    /// # Errors
    /// A frame of another size, or no background yet.
    pub fn find(&mut self, frame: &Frame) -> Result<&[Cell], CellError> {
        if self.frames < 2 {
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

    /// Whether the last frame held more than there was room for: then it is no picture of a few cells, and what was found
    /// may be parts.
    pub fn is_cluttered(&self) -> bool {
        self.blobs.dropped_runs() > 0
    }

    /// Lets the background follow the frame last given to [`CellFinder::find`]: a sixteenth of the rows at a time, each by a
    /// little. Near a region it changes as it does beside it, so that a cell is never taken in, however long it stays; dust
    /// too small for a cell is.
    pub fn refresh(&mut self, frame: &Frame) {
        // In quite another light it is not the background that has changed.
        if self.config.refresh_frames == 0
            || self.is_cluttered()
            || !(0.8..1.25).contains(&self.light)
        {
            return;
        }
        match frame.pixels {
            Pixels::Mono8(p) => self.refresh_rows(p),
            Pixels::Mono16(p) => self.refresh_rows(p),
        }
    }

    fn refresh_rows<T: Copy>(&mut self, pixels: &[T])
    where
        f32: From<T>,
    {
        self.refreshed = (self.refreshed + 1) % REFRESHED_EVERY;
        let share = (REFRESHED_EVERY as f32 / self.config.refresh_frames as f32).min(1.0);
        let unlit = 1.0 / self.light;
        let (width, found) = (self.width, self.blobs.found());
        let rows = self
            .mean
            .chunks_exact_mut(width)
            .zip(pixels.chunks_exact(width))
            .enumerate();
        for (y, (mean, row)) in rows.skip(self.refreshed).step_by(REFRESHED_EVERY) {
            for ((change, m), p) in self.change.iter_mut().zip(&*mean).zip(row) {
                *change = share * (f32::from(*p) * unlit - m);
            }
            let mut x = 0;
            while let Some((from, to)) = next_near(found, x, y, width) {
                let open = |from: usize, to: usize| {
                    let shown = self.change.get(from..to).unwrap_or(&[]);
                    let sum: f32 = shown.iter().sum();
                    (!shown.is_empty()).then(|| sum / shown.len() as f32)
                };
                let left = open(from.saturating_sub(BESIDE_PX).max(x), from);
                let behind = next_near(found, to, y, width).map_or(width, |next| next.0);
                let right = open(to, (to + BESIDE_PX).min(behind));
                let (left, right) = match (left, right) {
                    (Some(left), Some(right)) => (left, right),
                    (Some(one), None) | (None, Some(one)) => (one, one),
                    (None, None) => (0.0, 0.0),
                };
                let steps = (to - from) as f32;
                if let Some(hidden) = self.change.get_mut(from..to) {
                    for (k, change) in hidden.iter_mut().enumerate() {
                        *change = left + (right - left) * (k as f32 + 0.5) / steps;
                    }
                }
                x = to;
            }
            for (m, change) in mean.iter_mut().zip(&self.change) {
                *m += change;
            }
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

    fn average<T: Copy>(&mut self, pixels: &[T])
    where
        f32: From<T>,
    {
        self.frames = self.frames.saturating_add(1);
        let share = 1.0 / self.frames as f32;
        for (mean, p) in self.mean.iter_mut().zip(pixels) {
            let v = f32::from(*p);
            let before = v - *mean;
            *mean += share * before;
            self.deviations += f64::from(before) * f64::from(v - *mean);
        }
    }

    fn measure<T: Copy>(&mut self, pixels: &[T])
    where
        f32: From<T>,
    {
        let light = self.light_of(pixels);
        self.light = light;
        let noise = self.noise_grey();
        let threshold = (self.config.threshold_sigma * noise) as f32;
        let (mean, width) = (&self.mean, self.width);
        let contrast = |x: usize, y: usize| {
            let k = y * width + x;
            match (pixels.get(k), mean.get(k)) {
                (Some(p), Some(m)) => (f32::from(*p) - light * m).abs(),
                _ => 0.0,
            }
        };
        let least_px = self.config.min_area_px;
        self.blobs
            .label((width, self.height), threshold, least_px, contrast);
        self.cells.clear();
        for blob in self.blobs.found() {
            let spans = self.blobs.spans(blob);
            let Some(surface) = self.outliner.measure(blob, spans, contrast) else {
                continue;
            };
            let [var_x, var_y, cov_xy] = surface.unit_variances.map(|v| v * noise * noise);
            self.cells.push(Cell {
                x_px: surface.x_px,
                y_px: surface.y_px,
                var_x_px2: var_x,
                var_y_px2: var_y,
                cov_xy_px2: cov_xy,
                area_px: surface.area_px,
                moments_px2: surface.moments_px2,
                body_grey: surface.body,
                mean_grey: blob.contrast_sum / blob.area_px,
                peak_grey: blob.peak,
                snr: surface.body / noise,
                at_border: blob.at_border,
            });
        }
    }

    /// Light of the frame relative to the background's: mean ratio over pixels that differ little from it.
    fn light_of<T: Copy>(&self, pixels: &[T]) -> f32
    where
        f32: From<T>,
    {
        let step = (pixels.len() / 2048).max(1) | 1;
        let (mut light, mut limit) = (1.0_f64, f64::INFINITY);
        for _ in 0..4 {
            let (mut over, mut under, mut spread, mut n) = (0.0_f64, 0.0_f64, 0.0_f64, 0.0_f64);
            for (p, m) in pixels.iter().zip(&self.mean).step_by(step) {
                let (v, m) = (f64::from(f32::from(*p)), f64::from(*m));
                let off = (v - light * m).abs();
                if off <= limit {
                    over += v;
                    under += m;
                    spread += off;
                    n += 1.0;
                }
            }
            if under <= 0.0 {
                break;
            }
            light = over / under;
            limit = 2.5 * spread / n.max(1.0) + self.noise_grey();
        }
        light as f32
    }
}

/// The first stretch of a row (from, to), at or behind column `x`, that is near a region; stretches that overlap are one.
fn next_near(found: &[Blob], x: usize, y: usize, width: usize) -> Option<(usize, usize)> {
    let near = || {
        found.iter().filter_map(|blob| {
            let [left, top, right, bottom] = blob.bounds.map(|b| b as usize);
            let rows = y + CLEAR_PX >= top && y < bottom + CLEAR_PX;
            let (from, to) = (left.saturating_sub(CLEAR_PX), right + CLEAR_PX);
            (rows && to > x).then_some((from.max(x), to.min(width)))
        })
    };
    let (from, mut to) = near().min().filter(|(from, to)| from < to)?;
    while let Some((_, further)) = near().find(|next| next.0 <= to && next.1 > to) {
        to = further;
    }
    Some((from, to))
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: (usize, usize) = (96, 48);

    struct Noise(u64);
    impl Noise {
        fn next(&mut self) -> f64 {
            let mut sum = 0.0;
            for _ in 0..12 {
                self.0 = self
                    .0
                    .wrapping_mul(6_364_136_223_846_793_005)
                    .wrapping_add(1_442_695_040_888_963_407);
                sum += (self.0 >> 11) as f64 / (1_u64 << 53) as f64;
            }
            sum - 6.0
        }
    }

    /// Uneven light, noise of 2 grey levels, and an elliptic cell with a dark rim when `cell` gives its centre.
    fn picture(cell: Option<(f64, f64)>, light: f64, noise: &mut Noise) -> Vec<u8> {
        let pixel = |k: usize| {
            let (x, y) = ((k % SIZE.0) as f64, (k / SIZE.0) as f64);
            let mut v = 110.0 + 0.4 * x - 0.3 * y;
            if let Some((cx, cy)) = cell {
                let r = f64::hypot((x - cx) / 12.0, (y - cy) / 7.0);
                v += if r < 0.8 {
                    30.0
                } else if r < 1.0 {
                    -30.0
                } else {
                    0.0
                };
            }
            (light * v + 2.0 * noise.next()).round().clamp(0.0, 255.0) as u8
        };
        (0..SIZE.0 * SIZE.1).map(pixel).collect()
    }

    fn frame(pixels: &[u8]) -> Frame<'_> {
        Frame {
            width: SIZE.0,
            height: SIZE.1,
            pixels: Pixels::Mono8(pixels),
        }
    }

    fn taught(noise: &mut Noise) -> CellFinder {
        let mut finder = CellFinder::new(SIZE.0, SIZE.1, CellConfig::default()).unwrap();
        for _ in 0..20 {
            finder
                .take_background(&frame(&picture(None, 1.0, noise)))
                .unwrap();
        }
        finder
    }

    #[test]
    fn a_cell_gets_its_place_size_and_intensity_in_uneven_and_flickering_light() {
        let mut noise = Noise(4);
        let mut finder = taught(&mut noise);
        assert!(
            (finder.noise_grey() - 2.02).abs() < 0.1,
            "{}",
            finder.noise_grey()
        );
        for (light, cell) in [
            (1.0, (40.2, 20.7)),
            (0.9, (55.0, 25.0)),
            (1.1, (30.5, 22.0)),
        ] {
            let pixels = picture(Some(cell), light, &mut noise);
            let found = finder.find(&frame(&pixels)).unwrap();
            assert_eq!(found.len(), 1, "{found:?}");
            let c = found[0];
            assert!(
                (c.x_px - cell.0).abs() < 0.2 && (c.y_px - cell.1).abs() < 0.2,
                "{c:?}"
            );
            let area = std::f64::consts::PI * 12.0 * 7.0;
            assert!((c.area_px / area - 1.0).abs() < 0.05, "{c:?}");
            let (length_px, width_px) = c.axes_px();
            assert!(
                (length_px - 24.0).abs() < 0.5 && (width_px - 14.0).abs() < 0.5,
                "{c:?}"
            );
            assert!((c.mean_grey / (30.0 * light) - 1.0).abs() < 0.1, "{c:?}");
            assert!(!c.at_border);
        }
    }

    #[test]
    fn an_empty_channel_has_no_cell() {
        let mut noise = Noise(5);
        let mut finder = taught(&mut noise);
        for light in [0.9, 1.0, 1.1] {
            let pixels = picture(None, light, &mut noise);
            assert!(finder.find(&frame(&pixels)).unwrap().is_empty());
        }
    }

    #[test]
    fn a_frame_of_another_size_a_short_one_and_a_missing_background_are_errors() {
        let mut noise = Noise(6);
        let pixels = picture(None, 1.0, &mut noise);
        let mut finder = CellFinder::new(SIZE.0, SIZE.1, CellConfig::default()).unwrap();
        assert_eq!(finder.find(&frame(&pixels)), Err(CellError::NoBackground));
        let wrong = Frame {
            width: 10,
            ..frame(&pixels)
        };
        assert!(matches!(
            finder.take_background(&wrong),
            Err(CellError::Size { width: 10, .. })
        ));
        let short = frame(&pixels[..100]);
        assert!(matches!(
            finder.take_background(&short),
            Err(CellError::Truncated { pixels: 100, .. })
        ));
        let bad = CellConfig {
            min_area_px: f64::NAN,
            ..CellConfig::default()
        };
        assert_eq!(CellFinder::new(8, 8, bad).unwrap_err().key, "min_area_px");
    }
}
