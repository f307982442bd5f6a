//! Finds every bead of a frame by threshold above the background about it: seeds for [`crate::Localiser::locate`].

use crate::blobs::{Blob, Blobs, WIDEST};
use crate::crop::LANES;
use crate::fix::squared;
use crate::frame::{Frame, Pixels};
use crate::level::Level;
use crate::localiser::Localiser;
use crate::seed::{LEAST_NOISE, PATCH, background, patch_sums};
use crate::speckle;
use wide::f32x4;

/// Share of the strongest contrast in the frame that a bead must reach to be seen in the same look.
const WEAKEST_SHARE: f32 = 0.3;
/// Share of a bead's disc that must stand out.
const LEAST_AREA_SHARE: f64 = 0.15;
/// An object that a weaker look finds within this number of radii of a stronger one is its ring.
const OWN_RADII: f64 = 1.5;
/// Threshold for means of 3 x 3 pixels, as a share of that for one, and the radius of a bead from which they raise its contrast
/// over the noise, px. They lower the noise 3 times, and a Gaussian of 0.75 px 2.8 times.
const SMOOTHED: f32 = 0.4;
const SMOOTH_RADIUS_PX: f64 = 1.5;
/// A region as small as this may be one hot pixel, or two next to each other, or their image in means of 3 x 3 pixels.
const SPECK_AREA_PX: f64 = 12.0;
/// Most beads that a detector is made for.
const MOST_BEADS: usize = 20_000;

/// Finds beads. Allocates only when made.
#[derive(Debug, Clone)]
pub struct Detector {
    blobs: Blobs,
    level: Level,
    found: Vec<Blob>,
    /// Sums over patches along a row.
    sums: Vec<f32>,
    sign: f64,
    radius_px: f64,
    min_snr: f64,
    thorough: bool,
    left_out: u64,
}

impl Detector {
    /// A detector for beads like the localiser's, with room for `max_beads` beads in a frame. One look at a frame: objects much
    /// weaker than the strongest are not seen.
    pub fn new(localiser: &Localiser, max_beads: usize) -> Self {
        let max_beads = max_beads.clamp(1, MOST_BEADS);
        // A region shaped like a comb takes a label for each tooth.
        let room = (16 * max_beads).min(16_000).max(4 * max_beads);
        Detector {
            blobs: Blobs::new(room, room),
            level: Level::new(),
            found: Vec::with_capacity(room),
            sums: Vec::with_capacity(WIDEST),
            sign: localiser.sign(),
            radius_px: localiser.template().radius_px(),
            min_snr: localiser.config().min_snr,
            thorough: false,
            left_out: 0,
        }
    }

    /// The same for recordings: a second look shows beads that are weak compared with the strongest, or hidden in the noise.
    pub fn thorough(localiser: &Localiser, max_beads: usize) -> Self {
        Detector {
            thorough: true,
            ..Detector::new(localiser, max_beads)
        }
    }

    /// What the last call of [`Detector::detect`] found.
    pub fn found(&self) -> &[Blob] {
        &self.found
    }

    /// Runs of pixels that the last frame held beyond the room made: when not zero, there may be more beads.
    pub fn left_out(&self) -> u64 {
        self.left_out
    }

    /// Bead-like regions of the frame, the largest contrast first. Empty when nothing stands out of the noise.
    pub fn detect(&mut self, frame: &Frame) -> &[Blob] {
        self.found.clear();
        self.left_out = 0;
        let pixels = frame.width.saturating_mul(frame.height);
        match frame.pixels {
            Pixels::Mono8(p) if p.len() >= pixels => self.detect_in(p, frame),
            Pixels::Mono16(p) if p.len() >= pixels => self.detect_in(p, frame),
            _ => {}
        }
        &self.found
    }

    fn detect_in<T: Copy>(&mut self, pixels: &[T], frame: &Frame)
    where
        f32: From<T>,
    {
        let (width, height) = (frame.width, frame.height);
        let (mean, noise) = background(pixels);
        let sign = self.sign as f32;
        self.level
            .take(pixels, (width, height), self.radius_px, mean as f32);
        let step = if self.radius_px >= 3.0 { 2 } else { 1 };
        let strongest = self.strongest(pixels, (width, height), sign, step);
        let least = (self.min_snr.max(4.0) * noise.max(LEAST_NOISE)) as f32;
        let smooth = self.thorough && self.radius_px >= SMOOTH_RADIUS_PX;
        if strongest <= if smooth { SMOOTHED * least } else { least } {
            return;
        }
        let min_area_px =
            LEAST_AREA_SHARE * core::f64::consts::PI * self.radius_px * self.radius_px;
        let strong = least.max(WEAKEST_SHARE * strongest);
        let thresholds = [
            Some(strong),
            (self.thorough && !smooth && strong > least).then_some(least),
        ];
        for threshold in thresholds.into_iter().flatten() {
            let level = &mut self.level;
            self.blobs
                .label((width, height), threshold, min_area_px, |y, row| {
                    let from = pixels.get(y * width..).unwrap_or(&[]);
                    for ((c, v), level) in row.iter_mut().zip(from).zip(level.row(y)) {
                        *c = sign * (f32::from(*v) - level);
                    }
                });
            self.keep_new(pixels, (width, height), least, 0);
        }
        if smooth {
            // Beads as weak as the noise of a pixel: means of 3 x 3 pixels have a third of that noise.
            let (level, sums) = (&mut self.level, &mut self.sums);
            let inside = (width.saturating_sub(2), height.saturating_sub(2));
            let threshold = SMOOTHED * least;
            self.blobs.label(inside, threshold, min_area_px, |y, row| {
                patch_sums(pixels, width, y, sums);
                let levels = level.row(y + 1).get(1..).unwrap_or(&[]);
                for ((c, sum), level) in row.iter_mut().zip(sums.iter()).zip(levels) {
                    *c = sign * (sum / (PATCH * PATCH) as f32 - level);
                }
            });
            // The means' places are those of their first pixels.
            self.keep_new(pixels, (width, height), least, 1);
        }
        self.found
            .sort_unstable_by(|a, b| b.contrast_sum.total_cmp(&a.contrast_sum));
    }

    /// Largest contrast of a patch, patches `step` rows apart, of the sign asked for, grey levels.
    fn strongest<T: Copy>(
        &mut self,
        pixels: &[T],
        (width, height): (usize, usize),
        sign: f32,
        step: usize,
    ) -> f32
    where
        f32: From<T>,
    {
        // The largest of every fourth column apart: one for all would wait for every comparison before it.
        let (mut best, mut rest) = (f32x4::ZERO, 0.0_f32);
        if width < PATCH || height < PATCH {
            return rest;
        }
        let area = (PATCH * PATCH) as f32;
        for y in (0..=height - PATCH).step_by(step) {
            patch_sums(pixels, width, y, &mut self.sums);
            let levels = self.level.row(y + 1).get(1..).unwrap_or(&[]);
            let levels = levels.get(..self.sums.len()).unwrap_or(&[]);
            let (sums, last_sums) = self.sums.as_chunks::<LANES>();
            let (levels, last_levels) = levels.as_chunks::<LANES>();
            for (sums, level) in sums.iter().zip(levels) {
                let mean = f32x4::from(*sums) / f32x4::splat(area);
                best = best.fast_max(f32x4::splat(sign) * (mean - f32x4::from(*level)));
            }
            for (sum, level) in last_sums.iter().zip(last_levels) {
                rest = rest.max(sign * (sum / area - level));
            }
        }
        best.to_array().into_iter().fold(rest, f32::max)
    }

    /// Keeps of the last look what no stronger one has shown.
    fn keep_new<T: Copy>(&mut self, pixels: &[T], size: (usize, usize), least: f32, offset: u32)
    where
        f32: From<T>,
    {
        self.left_out += self.blobs.dropped_runs();
        let own_px = OWN_RADII * self.radius_px;
        let known = self.found.len();
        for blob in self.blobs.found() {
            let mut blob = *blob;
            blob.x_px += f64::from(offset);
            blob.y_px += f64::from(offset);
            blob.bounds = blob.bounds.map(|b| b + offset);
            let [left, top, right, bottom] = blob.bounds.map(f64::from);
            // Of a stronger one this look shows more, or the ring about it.
            let holds = |b: &Blob| {
                let inside = (left..=right).contains(&b.x_px) && (top..=bottom).contains(&b.y_px);
                inside || squared(b.x_px - blob.x_px, b.y_px - blob.y_px) < own_px * own_px
            };
            let seen = self.found.iter().take(known).any(holds);
            if blob.area_px <= SPECK_AREA_PX {
                let (x, y) = (blob.x_px.round() as usize, blob.y_px.round() as usize);
                let noise = least / self.min_snr.max(4.0) as f32;
                let level = self.level.row(y).get(x).copied().unwrap_or(0.0);
                let mean = speckle::mean_without(pixels, size, (x, y), noise);
                let contrast = |mean: f32| self.sign as f32 * (mean - level);
                if mean.is_some_and(|mean| contrast(mean) < SMOOTHED * least) {
                    continue;
                }
            }
            if !seen && self.found.len() < self.found.capacity() {
                self.found.push(blob);
            }
        }
    }
}
