//! A frame that is shifted against the background: a chip or a stage that has crept or shakes.
//!
//! Walls are the strongest edges in a channel: a shift of a third of a pixel makes lines of them that join nearby objects. The
//! shift is found by least squares at the background's own slopes, objects left out, and the background is moved by it.

use super::background::{Background, SAMPLES};

/// Largest shift that is made good, px.
pub(super) const MOST_PX: f64 = 3.5;
/// Shifts below this count as zero, px; and below this number of standard deviations.
const LEAST: (f64, f64) = (0.03, 4.0);
/// Frames after which the pixels are chosen again.
const CHOSEN_EVERY: u32 = 4096;
const PASSES: usize = 5;
/// A step that changes nothing any more, px.
const SETTLED_PX: f64 = 0.005;
/// A shift up to here is measured by the slopes at rest, px. It does not count below this share of the least one, or if it leaves
/// more than this share of the squares.
const LINEAR_PX: f64 = 0.5;
const STILL: f64 = 0.5;
const ALIKE: f64 = 0.99;
/// A shift is believed if it leaves at most this share of the squares, each counted up to this number of standard deviations.
const BETTER: f64 = 0.9;
const MOST_OFF: f64 = 20.0;

/// Sums of the least squares.
#[derive(Debug, Clone, Copy, Default)]
struct Sums {
    xx: f64,
    xy: f64,
    yy: f64,
    rx: f64,
    ry: f64,
    /// Sum of what pixels differ by, and their number.
    off: f64,
    n: f64,
    /// Sum of squares, large ones clipped.
    clipped: f64,
}

/// What a pixel differs by, and the background's slopes there, grey levels per px.
#[derive(Debug, Clone, Copy, Default)]
struct Slope {
    off: f64,
    x: f64,
    y: f64,
}

/// A step of the least squares.
#[derive(Debug, Clone, Copy)]
struct Step {
    px: (f64, f64),
    /// Standard deviations of the shift.
    sd: (f64, f64),
    /// What pixels differ by, grey levels, at least the noise.
    spread: f64,
    /// What a pixel of the background differs by at most.
    limit: f64,
}

impl Sums {
    /// Sums for a shift that the slopes at rest make good.
    fn of(slopes: &[Slope], at: (f64, f64), limit: f64, noise: f64) -> Self {
        let mut sums = Sums::default();
        for slope in slopes {
            let off = slope.off + at.0 * slope.x + at.1 * slope.y;
            sums.take(slope, off, limit, noise);
        }
        sums
    }

    fn take(&mut self, slope: &Slope, off: f64, limit: f64, noise: f64) {
        self.clipped += off.abs().min(MOST_OFF * noise).powi(2);
        if off.abs() > limit {
            return;
        }
        self.xx += slope.x * slope.x;
        self.xy += slope.x * slope.y;
        self.yy += slope.y * slope.y;
        self.rx -= slope.x * off;
        self.ry -= slope.y * off;
        self.off += off.abs();
        self.n += 1.0;
    }

    /// The next step from a shift; `None` where there are no slopes.
    fn step(&self, at: (f64, f64), noise: f64) -> Option<Step> {
        // A shift by a pixel is not expected: without slopes along a direction the shift is zero.
        let least = noise * noise;
        let (xx, xy, yy) = (self.xx + least, self.xy, self.yy + least);
        let (rx, ry) = (self.rx - at.0 * least, self.ry - at.1 * least);
        let determinant = xx * yy - xy * xy;
        if determinant <= 0.0 || self.n < 1.0 {
            return None;
        }
        let most = |v: f64| v.clamp(-1.0, 1.0);
        let spread = 1.25 * self.off / self.n;
        let least_spread = spread.max(noise);
        let variance = least_spread * least_spread;
        Some(Step {
            px: (
                most((rx * yy - ry * xy) / determinant),
                most((ry * xx - rx * xy) / determinant),
            ),
            sd: (
                (variance * yy / determinant).sqrt(),
                (variance * xx / determinant).sqrt(),
            ),
            spread: least_spread,
            limit: (8.0 * spread).max(4.0 * noise),
        })
    }
}

impl Background {
    fn height(&self) -> usize {
        self.mean.len() / self.width.max(1)
    }

    /// Between the pixels, linearly; `None` near the border.
    fn between(&self, x: f64, y: f64) -> Option<f64> {
        let (x, y) = (x as f32, y as f32);
        if !(x >= 0.0 && y >= 0.0) {
            return None;
        }
        let (i, j) = (x as usize, y as usize);
        let (u, v) = (x - i as f32, y - j as f32);
        let k = j * self.width + i;
        let [a, b] = *self.mean.get(k..k + 2)? else {
            return None;
        };
        let [c, d] = *self.mean.get(k + self.width..k + self.width + 2)? else {
            return None;
        };
        let (upper, lower) = (a + u * (b - a), c + u * (d - c));
        Some(f64::from(upper + v * (lower - upper)))
    }

    /// Grey level at a place and its differences over a pixel to the right and down; `None` near the border.
    fn around(&self, x: f64, y: f64) -> Option<[f64; 3]> {
        let (left, right) = (self.between(x - 0.5, y)?, self.between(x + 0.5, y)?);
        let (above, below) = (self.between(x, y - 0.5)?, self.between(x, y + 0.5)?);
        Some([self.between(x, y)?, right - left, below - above])
    }

    /// The same at a pixel.
    fn at_rest(&self, k: usize) -> Option<[f64; 3]> {
        let &[left, own, right] = self.mean.get(k.checked_sub(1)?..k + 2)? else {
            return None;
        };
        let above = self.mean.get(k.checked_sub(self.width)?)?;
        let below = self.mean.get(k + self.width)?;
        Some([own, 0.5 * (right - left), 0.5 * (below - above)].map(f64::from))
    }

    /// Chooses the pixels at which the background is steep, now and then.
    pub(super) fn choose_steep(&mut self) {
        self.steep_age = self.steep_age.wrapping_add(1);
        if self.steep_age % CHOSEN_EVERY != 1 {
            return;
        }
        let (width, height) = (self.width, self.height());
        let least = 2.0 * self.noise_grey() as f32;
        let rows = self.mean.chunks_exact(width.max(1));
        for (level, row) in self.row_levels.iter_mut().zip(rows) {
            *level = row.iter().sum::<f32>() / width as f32;
        }
        self.steep.clear();
        if width < 16 || height < 16 {
            return;
        }
        // Taken out while the rest is looked at: its room stays.
        let mut kept = std::mem::take(&mut self.steep);
        let steep = |k: &usize| {
            let at = |k: usize| self.mean.get(k).copied().unwrap_or(0.0);
            let (x, y) = (k % width, k / width);
            let within = (4..width - 5).contains(&x) && (4..height - 5).contains(&y);
            let across = (at(k + 1) - at(k.saturating_sub(1))).abs();
            within
                && !self.is_restless(x, y)
                && across.max((at(k + width) - at(k.saturating_sub(width))).abs()) > least
        };
        let count = (0..self.mean.len()).filter(steep).count();
        let every = count.div_ceil(SAMPLES).max(1);
        let chosen = (0..self.mean.len()).filter(steep).step_by(every);
        kept.extend(chosen.take(SAMPLES).map(|k| k as u32));
        self.steep = kept;
    }

    /// Shift of the frame against the background, px to the right and down; zeros if it is negligible.
    pub(super) fn drift_of<T: Copy>(&self, pixels: &[T], light: f32) -> (f64, f64)
    where
        f32: From<T>,
    {
        let (noise, light) = (self.noise_grey(), f64::from(light));
        let none = (0.0, 0.0);
        let mut slopes = [Slope::default(); SAMPLES];
        let mut count = 0;
        let at_rest = self.steep.iter().filter_map(|k| {
            let around = self.at_rest(*k as usize)?;
            self.slope(pixels, *k as usize, light, around)
        });
        for (to, slope) in slopes.iter_mut().zip(at_rest) {
            *to = slope;
            count += 1;
        }
        let slopes = slopes.get(..count).unwrap_or(&[]);
        let unmoved = Sums::of(slopes, none, f64::INFINITY, noise);
        let Some(first) = unmoved.step(none, noise) else {
            return none;
        };
        if f64::hypot(first.px.0, first.px.1) < 0.5 * LEAST.0 {
            return none;
        }
        // Without the objects, by the slopes at rest.
        let (mut at, mut last) = (none, first);
        for _ in 0..PASSES {
            let Some(next) = Sums::of(slopes, at, last.limit, noise).step(at, noise) else {
                return none;
            };
            at = (at.0 + next.px.0, at.1 + next.px.1);
            last = next;
            if f64::hypot(next.px.0, next.px.1) < SETTLED_PX {
                break;
            }
        }
        // By the noise alone: objects, and a shift that has not been made good, count as spread.
        let own = noise / last.spread;
        let small = |d: f64, sd: f64| d.abs() < STILL * LEAST.0.max(LEAST.1 * own * sd);
        if f64::hypot(at.0, at.1) < LINEAR_PX {
            let left = Sums::of(slopes, at, last.limit, noise).clipped;
            if small(at.0, last.sd.0) && small(at.1, last.sd.1) || left > ALIKE * unmoved.clipped {
                return none;
            }
        } else {
            (at, last) = (none, first);
        }
        for _ in 0..PASSES {
            let Some(next) = self.sums_at(pixels, light, at, last.limit).step(at, noise) else {
                return none;
            };
            at = (at.0 + next.px.0, at.1 + next.px.1);
            last = next;
            if !(at.0.abs() <= MOST_PX && at.1.abs() <= MOST_PX) {
                return none;
            }
            if f64::hypot(next.px.0, next.px.1) < SETTLED_PX {
                break;
            }
        }
        let moved = self.sums_at(pixels, light, at, last.limit).clipped;
        if moved > BETTER * unmoved.clipped {
            return none;
        }
        let told = |d: f64, sd: f64| {
            if d.abs() > LEAST.0.max(LEAST.1 * sd) {
                d
            } else {
                0.0
            }
        };
        (told(at.0, last.sd.0), told(at.1, last.sd.1))
    }

    /// What a pixel differs by, where the background (its grey level there, its differences across and down) is steep.
    fn slope<T: Copy>(
        &self,
        pixels: &[T],
        k: usize,
        light: f64,
        [own, across, down]: [f64; 3],
    ) -> Option<Slope>
    where
        f32: From<T>,
    {
        let noise = self.noise_grey();
        // A smooth slope cannot tell a shift from light that has changed.
        let steep = |slope: f64| if slope.abs() > noise { slope } else { 0.0 };
        let (x, y) = (light * steep(across), light * steep(down));
        let off = f64::from(f32::from(*pixels.get(k)?)) - light * own;
        (x != 0.0 || y != 0.0).then_some(Slope { off, x, y })
    }

    /// Sums with the background moved by `at` px; pixels that differ by more than `limit` are left out.
    fn sums_at<T: Copy>(&self, pixels: &[T], light: f64, at: (f64, f64), limit: f64) -> Sums
    where
        f32: From<T>,
    {
        let noise = self.noise_grey();
        let mut sums = Sums::default();
        for k in self.steep.iter().map(|k| *k as usize) {
            let (i, j) = (k % self.width, k / self.width);
            let around = self.around(i as f64 - at.0, j as f64 - at.1);
            if let Some(slope) = around.and_then(|around| self.slope(pixels, k, light, around)) {
                sums.take(&slope, slope.off, limit, noise);
            }
        }
        sums
    }
}
