//! A frame that is softer than the background: the focus has crept, or the table shakes while a frame is exposed.
//!
//! To first order another focus blurs the picture by a Gaussian. Shift and blur are fitted together by least squares at the
//! background's steep pixels, objects left out. The background is then moved and blurred by them. So a softer wall leaves no
//! contrast that could be taken for a cell.

use super::background::Background;
use super::drift::MOST_PX;
use super::softer::{Kernel, MOST_REACH, Reader, Softer};
use nalgebra::{Matrix4, Vector4};

/// Most blur that is made good, px (standard deviation).
pub(super) const MOST_BLUR_PX: f64 = 4.0;
/// Blur that does not count, px: it is hidden in the pixels' own width, whose standard deviation this is.
const LEAST_BLUR_PX: f64 = 0.29;
/// Frame and background are first blurred by this, px, so that the slopes reach a shift of several pixels; then by less, then not
/// at all.
const SOFTENED_PX: [f64; 3] = [2.0, 0.8, 0.0];
const PASSES: usize = 10;
/// Blur (px) that a fit starts from, one after the other.
const STARTS_PX: [f64; 2] = [0.0, 2.5];
/// Steps that change nothing any more: px, and px^2 of blur.
const SETTLED: (f64, f64) = (0.005, 0.01);
/// Largest steps of shift (px) and blur (px^2).
const STEP: (f64, f64) = (1.0, 2.0);
/// Least gain per pixel by a softer background, on average (minus the logarithm of the likelihood, with the weights'
/// distribution): several times the gain of four parameters from noise that neighbours share.
const BETTER: f64 = 0.4;
/// About this number of steep pixels is used, and at least this number.
const SAMPLES: usize = 160;
const FEWEST: f64 = 12.0;
/// A pixel that differs by this number of standard deviations counts half: it may belong to an object (weights of Cauchy's
/// distribution).
const OBJECT: f64 = 2.0;
/// A pixel that is off by this many standard deviations of the noise counts half of its square.
const FAR: f64 = 6.0;
/// The scatter that is an object's falls by this factor from pass to pass at most.
const NARROWER: f64 = 0.7;
/// The light is known to this share (standard deviation) before.
const LIGHT: f64 = 0.02;
/// So many pixels count as one against what is expected: neighbours are off alike.
const ALIKE: f64 = 2.0;
/// Standard deviation of the expected shift, px: without slopes the shift stays near zero.
const EXPECTED_PX: f64 = 2.0;
/// If nothing has changed, this share of the steep pixels is within this number of standard deviations of the noise. Of pixels
/// with noise alone half and 0.95 are, and an object may cover a seventh of them.
const CALM: ((f64, f64), (f64, f64)) = ((0.674, 0.43), (2.0, 0.8));

/// How a frame differs from the background: moved, px, and softer by a Gaussian of this standard deviation, px.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Moved {
    pub shift_px: (f64, f64),
    pub blur_px: f64,
    /// Light that was fitted with them, relative to the background's; 0 where nothing was.
    pub light: f64,
}

impl Moved {
    /// Whether shift and blur were fitted together.
    fn is_fitted(&self) -> bool {
        self.light > 0.0
    }

    pub(super) fn is_none(&self) -> bool {
        self.shift_px == (0.0, 0.0) && self.blur_px <= 0.0
    }
}

/// How the frame before differed, and how badly that explained it (not a number where nothing was left to explain).
#[derive(Debug, Clone, Copy)]
pub(super) struct Last {
    pub moved: Moved,
    cost: f64,
    /// Whether noise alone leaves as much.
    pub is_noise: bool,
}

impl Last {
    pub(super) fn none() -> Self {
        Last {
            moved: Moved::default(),
            cost: f64::NAN,
            is_noise: true,
        }
    }
}

/// Sums of the least squares of shift and blur.
struct Sums {
    normal: Matrix4<f64>,
    right: Vector4<f64>,
    squares: f64,
    n: f64,
}

impl Background {
    /// How the frame is moved and softened against the background. `last` is the result for the previous frame, with its residual.
    /// The search continues from it, and begins again only for a frame that it does not explain as well.
    pub(super) fn moved<T: Copy>(
        &self,
        softer: &Softer,
        pixels: &[T],
        light: f32,
        last: &mut Last,
    ) -> Moved
    where
        f32: From<T>,
    {
        let still = Moved {
            shift_px: self.drift_of(pixels, light),
            ..Moved::default()
        };
        let before = *last;
        *last = Last {
            moved: still,
            ..Last::none()
        };
        let light = f64::from(light);
        let Some(sharp) = self.left_by(softer, pixels, light, still) else {
            return still;
        };
        // What noise alone leaves needs no other explanation.
        if sharp.is_noise {
            return still;
        }
        (last.cost, last.is_noise) = (sharp.cost, false);
        let as_before = |cost: f64| (cost - before.cost).abs() < BETTER;
        if !before.moved.is_fitted() && as_before(sharp.cost) {
            return still;
        }
        let mut best = Last {
            moved: still,
            cost: sharp.cost - BETTER,
            is_noise: false,
        };
        // Whether no more need be looked for.
        let mut take = |found: Option<(Moved, Left)>| {
            let Some((moved, left)) = found else {
                return false;
            };
            let better = left.cost < best.cost;
            if better {
                best = Last {
                    moved,
                    cost: left.cost,
                    is_noise: left.is_noise,
                };
            }
            better && (left.is_noise || as_before(left.cost))
        };
        let near = &SOFTENED_PX[SOFTENED_PX.len() - 1..];
        let goes_on = before.moved.is_fitted()
            && take(self.softened(softer, pixels, light, before.moved, near));
        if !goes_on {
            for blur_px in STARTS_PX {
                let start = Moved {
                    blur_px,
                    ..Moved::default()
                };
                if take(self.softened(softer, pixels, light, start, &SOFTENED_PX)) {
                    break;
                }
            }
        }
        if best.moved.is_fitted() {
            *last = best;
        }
        best.moved
    }

    /// The fit of shift and blur from a start, with its residual.
    fn softened<T: Copy>(
        &self,
        softer: &Softer,
        pixels: &[T],
        light: f64,
        start: Moved,
        stages: &[f64],
    ) -> Option<(Moved, Left)>
    where
        f32: From<T>,
    {
        let mut at = (start.shift_px, start.blur_px * start.blur_px);
        let mut lit = light;
        let least = LEAST_BLUR_PX * LEAST_BLUR_PX;
        for soft_px in stages {
            let mut seen = [f32::NAN; 2 * SAMPLES];
            self.soften(pixels, *soft_px, &mut seen);
            // A mean over the Gaussian's area has that much less noise.
            let area = (4.0 * core::f64::consts::PI * soft_px * soft_px).max(1.0);
            let noise = self.noise_grey() / area.sqrt();
            let mut spread = f64::INFINITY;
            for _ in 0..PASSES {
                let own = at.1;
                let reader = Reader::new(self, softer, at.0, own + soft_px * soft_px);
                let sums = self.softened_sums(&seen, &reader, lit, spread)?;
                // Slowly, so that walls that have not been made good yet are not taken for objects.
                spread = (sums.squares / sums.n)
                    .sqrt()
                    .max(noise)
                    .max(if spread.is_finite() {
                        NARROWER * spread
                    } else {
                        0.0
                    });
                let (mut normal, mut right) = (sums.normal, sums.right);
                // A shift by more than a few pixels is not expected. Neighbours that are blurred together tell as much as one.
                let prior = ALIKE * area.sqrt() * (spread / EXPECTED_PX).powi(2);
                for (k, shift) in [at.0.0, at.0.1].into_iter().enumerate() {
                    normal[(k, k)] += prior;
                    right[k] -= prior * shift;
                }
                normal[(2, 2)] += noise * noise;
                normal[(3, 3)] += (spread / LIGHT).powi(2);
                right[3] -= (spread / LIGHT).powi(2) * (lit / light - 1.0);
                let step = normal.cholesky()?.solve(&right);
                let most = |v: f64, most: f64| v.clamp(-most, most);
                let step = (
                    most(step[0], STEP.0),
                    most(step[1], STEP.0),
                    most(step[2], STEP.1),
                    most(step[3], LIGHT),
                );
                let within = |px: f64| px.clamp(-MOST_PX, MOST_PX);
                at.0 = (within(at.0.0 + step.0), within(at.0.1 + step.1));
                lit += step.3 * light;
                let before = at.1;
                at.1 = (own + step.2).clamp(0.0, MOST_BLUR_PX * MOST_BLUR_PX);
                if f64::hypot(step.0, step.1) < SETTLED.0 && (at.1 - before).abs() < SETTLED.1 {
                    break;
                }
            }
        }
        if !(at.0.0.abs() < MOST_PX && at.0.1.abs() < MOST_PX) {
            return None;
        }
        let found = Moved {
            shift_px: at.0,
            blur_px: if at.1 <= least { 0.0 } else { at.1.sqrt() },
            light: lit,
        };
        let left = self.left_by(softer, pixels, lit, found)?;
        Some((found, left))
    }

    /// The frame at the steep pixels, blurred; not a number near the border.
    fn soften<T: Copy>(&self, pixels: &[T], soft_px: f64, seen: &mut [f32])
    where
        f32: From<T>,
    {
        let kernel = Kernel::new(0.0, soft_px);
        let steep = self.steep.iter().step_by(self.steep_stride());
        for (seen, k) in seen.iter_mut().zip(steep) {
            let k = *k as usize;
            let whole = pixels.get(k).map(|p| f32::from(*p));
            let value = if soft_px > 0.0 {
                self.weighted(pixels, k, &kernel)
            } else {
                whole
            };
            *seen = value.unwrap_or(f32::NAN);
        }
    }

    fn softened_sums(
        &self,
        seen: &[f32],
        reader: &Reader,
        light: f64,
        spread: f64,
    ) -> Option<Sums> {
        let mut sums = Sums {
            normal: Matrix4::zeros(),
            right: Vector4::zeros(),
            squares: 0.0,
            n: 0.0,
        };
        let steep = self.steep.iter().step_by(self.steep_stride());
        for (seen, k) in seen.iter().zip(steep) {
            let Some(values) = reader.at(*k as usize) else {
                continue;
            };
            let [value, x, y, by_variance] = values.map(f64::from);
            let off = f64::from(*seen) - light * value;
            if !off.is_finite() {
                continue;
            }
            // The farther a pixel is off, the sooner it belongs to an object.
            let weight = 1.0 / (1.0 + (off / (OBJECT * spread)).powi(2));
            // The shift moves against the slope; and the light is free, for its estimate suffers from the walls that have changed.
            let g = light * Vector4::new(-x, -y, by_variance, value);
            sums.normal += weight * g * g.transpose();
            sums.right += weight * off * g;
            sums.squares += weight * off * off;
            sums.n += weight;
        }
        (sums.n >= FEWEST).then_some(sums)
    }

    fn steep_stride(&self) -> usize {
        self.steep.len().div_ceil(SAMPLES).max(1)
    }

    /// A picture about a pixel by the weights of a kernel along the rows and down.
    fn weighted<T: Copy>(&self, pixels: &[T], k: usize, kernel: &Kernel) -> Option<f32>
    where
        f32: From<T>,
    {
        let height = self.mean.len() / self.width.max(1);
        let (x, y) = ((k % self.width) as isize, (k / self.width) as isize);
        let reach = kernel.reach as isize;
        if x < reach || x + reach >= self.width as isize {
            return None;
        }
        let taps = kernel.taps();
        let mut sum = 0.0_f32;
        for (j, w) in (y - reach..).zip(taps) {
            // The border continues beyond it.
            let j = j.clamp(0, height as isize - 1);
            let from = (j * self.width as isize + x - reach) as usize;
            let row = pixels.get(from..from + taps.len())?;
            let along: f32 = row.iter().zip(taps).map(|(v, p)| f32::from(*v) * p).sum();
            sum += w * along;
        }
        Some(sum)
    }

    /// What the moved and blurred background leaves of the frame.
    fn left_by<T: Copy>(
        &self,
        softer: &Softer,
        pixels: &[T],
        light: f64,
        moved: Moved,
    ) -> Option<Left>
    where
        f32: From<T>,
    {
        let reader = Reader::new(self, softer, moved.shift_px, moved.blur_px * moved.blur_px);
        let steep = self.steep.iter().step_by(self.steep_stride());
        let off = steep.filter_map(|k| {
            let k = *k as usize;
            let [value, ..] = reader.at(k)?;
            Some(f64::from(f32::from(*pixels.get(k)?)) - light * f64::from(value))
        });
        Left::of(off, self.noise_grey())
    }

    /// What a contrast leaves of the walls.
    pub(super) fn left_in(&self, contrast: &[f32]) -> Option<Left> {
        let walls = self.steep.iter().filter_map(|k| contrast.get(*k as usize));
        Left::of(walls.map(|off| f64::from(*off)), self.noise_grey())
    }

    /// The difference of a frame from the background at `light`, moved and blurred, into `contrast`; `row` has room for a row and
    /// twice the reach.
    pub(super) fn contrast_moved<T: Copy>(
        &self,
        pixels: &[T],
        light: f32,
        moved: Moved,
        (contrast, row): (&mut [f32], &mut [f32]),
    ) where
        f32: From<T>,
    {
        let width = self.width;
        let across = Kernel::new(moved.shift_px.0, moved.blur_px);
        let down = Kernel::new(moved.shift_px.1, moved.blur_px);
        let rows = contrast
            .chunks_exact_mut(width)
            .zip(pixels.chunks_exact(width));
        for (y, (out, frame)) in rows.enumerate() {
            let row = self.row_blurred(y, &down, row);
            for (c, p) in out.iter_mut().zip(frame) {
                *c = f32::from(*p);
            }
            for (n, w) in across.taps().iter().enumerate() {
                let from = MOST_REACH - across.reach + n;
                let shifted = row.get(from..from + width).unwrap_or(&[]);
                for (c, m) in out.iter_mut().zip(shifted) {
                    *c -= light * w * m;
                }
            }
        }
    }
}

/// How badly the pixels are explained, each on average, and whether noise alone leaves as much.
pub(super) struct Left {
    pub cost: f64,
    pub is_noise: bool,
}

impl Left {
    /// Of what pixels are off, grey levels.
    fn of(off: impl Iterator<Item = f64>, noise: f64) -> Option<Self> {
        let (mut cost, mut n, mut inner, mut outer) = (0.0, 0.0, 0.0, 0.0);
        for off in off {
            let z2 = (off / noise).powi(2);
            cost += z2 / (1.0 + z2 / (FAR * FAR));
            inner += f64::from(u8::from(off.abs() < CALM.0.0 * noise));
            outer += f64::from(u8::from(off.abs() < CALM.1.0 * noise));
            n += 1.0;
        }
        (n >= FEWEST).then_some(Left {
            cost: cost / n,
            is_noise: inner >= CALM.0.1 * n && outer >= CALM.1.1 * n,
        })
    }
}
