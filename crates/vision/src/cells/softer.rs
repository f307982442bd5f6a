//! The background moved and blurred: exactly, for a whole frame, and quickly, at single pixels, from blurs that are kept ready.

use super::background::Background;

/// Blurs for which the background is kept ready, px; between them it is linear in their squares, as the heat equation has it to first
/// order. The last one is the most blur on top of the most softening.
const READY_PX: [f64; 6] = [0.6, 1.0, 1.5, 2.2, 3.2, 4.5];
/// Pixels beyond the place that a cubic needs.
const CUBIC_REACH: isize = 3;
/// Half of a kernel at most, px: three standard deviations, shift, and the cubic's reach.
pub(super) const MOST_REACH: usize = 20;
const TAPS: usize = 2 * MOST_REACH + 1;
/// Parts of a standard deviation at which the Gaussian is taken, and its reach in standard deviations.
const PARTS: f64 = 4.0;
const REACH: f64 = 3.0;

/// Weights of the pixels about one for the value at a place shifted by `-shift` px, blurred: interpolated by a cubic (Catmull-Rom).
#[derive(Debug, Clone, Copy)]
pub(super) struct Kernel {
    weights: [f32; TAPS],
    /// Taps from `-reach` to `reach` are not zero.
    pub(super) reach: usize,
}

impl Kernel {
    pub(super) fn new(shift_px: f64, blur_px: f64) -> Self {
        let mut weights = [0.0_f32; TAPS];
        let mut add = |at: f64, amount: f64| {
            let whole = at.floor();
            let cubic = cubic((at - whole) as f32);
            for (n, w) in (-1..).zip(cubic) {
                let tap = whole as isize + n + MOST_REACH as isize;
                if let Some(weight) = weights.get_mut(tap.max(0) as usize) {
                    *weight += amount as f32 * w;
                }
            }
        };
        if blur_px <= 0.0 {
            add(-shift_px, 1.0);
        } else {
            let steps = (REACH * PARTS) as i32;
            let gaussian = |k: i32| (-0.5 * (f64::from(k) / PARTS).powi(2)).exp();
            let sum: f64 = (-steps..=steps).map(gaussian).sum();
            for k in -steps..=steps {
                let u = f64::from(k) / PARTS;
                add(u * blur_px - shift_px, gaussian(k) / sum);
            }
        }
        let reach = (REACH * blur_px + shift_px.abs()).ceil() as usize + 2;
        Kernel {
            weights,
            reach: reach.min(MOST_REACH),
        }
    }

    /// The weights that are not zero.
    pub(super) fn taps(&self) -> &[f32] {
        let from = MOST_REACH - self.reach;
        self.weights
            .get(from..MOST_REACH + self.reach + 1)
            .unwrap_or(&[])
    }
}

/// The background blurred by each of [`READY_PX`], followed row by row as it changes.
#[derive(Debug, Clone)]
pub(super) struct Softer {
    levels: [Vec<f32>; READY_PX.len()],
    kernels: [Kernel; READY_PX.len()],
    next: usize,
}

impl Softer {
    pub(super) fn new(pixels: usize) -> Self {
        Softer {
            levels: core::array::from_fn(|_| vec![0.0; pixels]),
            kernels: READY_PX.map(|px| Kernel::new(0.0, px)),
            next: 0,
        }
    }

    /// Takes the background in: all of it once its steep pixels have been chosen for the first time, then a row of one blur at a
    /// time. `row` has room for a row and twice the reach.
    pub(super) fn follow(&mut self, background: &Background, row: &mut [f32]) {
        let rows = READY_PX.len() * background.mean.len() / background.width.max(1);
        let count = if background.steep_age == 1 { rows } else { 1 };
        for _ in 0..count {
            self.next = (self.next + 1) % rows.max(1);
            let (level, y) = (self.next % READY_PX.len(), self.next / READY_PX.len());
            let kernel = &self.kernels[level];
            let own = background.row_blurred(y, kernel, row);
            let width = background.width;
            let to = self.levels[level].get_mut(y * width..(y + 1) * width);
            for (x, v) in to.into_iter().flatten().enumerate() {
                let near = own.get(MOST_REACH + x - kernel.reach..).unwrap_or(&[]);
                *v = kernel.taps().iter().zip(near).map(|(w, v)| w * v).sum();
            }
        }
    }

    /// The two blurs about one of a variance (px^2), and the share of the second.
    fn about<'a>(&'a self, mean: &'a [f32], variance_px2: f64) -> ([&'a [f32]; 2], f64, f64) {
        let square = |k: usize| {
            if k == 0 {
                0.0
            } else {
                READY_PX[k - 1] * READY_PX[k - 1]
            }
        };
        let last = READY_PX.len() - 1;
        let k = (0..=last)
            .rev()
            .find(|k| square(*k) <= variance_px2)
            .unwrap_or(0);
        let of = |k: usize| {
            if k == 0 {
                mean
            } else {
                self.levels[k - 1].as_slice()
            }
        };
        let span = square(k + 1) - square(k);
        let share = ((variance_px2 - square(k)) / span).clamp(0.0, 1.0);
        ([of(k), of(k + 1)], share, span)
    }
}

/// Reads a blurred background at places moved alike against the pixels.
pub(super) struct Reader<'a> {
    levels: [&'a [f32]; 2],
    /// Share of the second level, and the difference of their variances, px^2.
    share: f32,
    span: f32,
    /// Whole pixels to go, and the weights of the cubic and of its slope.
    whole: (isize, isize),
    across: [[f32; 4]; 2],
    down: [[f32; 4]; 2],
    width: usize,
}

impl<'a> Reader<'a> {
    pub(super) fn new(
        background: &'a Background,
        softer: &'a Softer,
        shift_px: (f64, f64),
        variance_px2: f64,
    ) -> Self {
        let (levels, share, span) = softer.about(&background.mean, variance_px2);
        let split = |d: f64| {
            let whole = (-d).floor();
            let t = (-d - whole) as f32;
            (whole as isize, [cubic(t), cubic_slope(t)])
        };
        let ((x, across), (y, down)) = (split(shift_px.0), split(shift_px.1));
        Reader {
            levels,
            share: share as f32,
            span: span as f32,
            whole: (x, y),
            across,
            down,
            width: background.width,
        }
    }

    /// Value about a pixel, slopes to the right and down, and derivative by the variance; `None` near the border.
    pub(super) fn at(&self, k: usize) -> Option<[f32; 4]> {
        let (x, y) = (
            (k % self.width) as isize + self.whole.0,
            (k / self.width) as isize + self.whole.1,
        );
        let height = (self.levels[0].len() / self.width.max(1)) as isize;
        if x < CUBIC_REACH || x + CUBIC_REACH >= self.width as isize {
            return None;
        }
        let mut of_level = [[0.0_f32; 3]; 2];
        for (level, sums) in self.levels.iter().zip(&mut of_level) {
            for (j, (w, slope)) in (y - 1..).zip(self.down[0].iter().zip(&self.down[1])) {
                let j = j.clamp(0, height - 1);
                let from = (j * self.width as isize + x - 1) as usize;
                let (mut a, mut b) = (0.0, 0.0);
                let row = level.get(from..from + 4)?;
                for ((v, p), q) in row.iter().zip(&self.across[0]).zip(&self.across[1]) {
                    a += v * p;
                    b += v * q;
                }
                sums[0] += w * a;
                sums[1] += w * b;
                sums[2] += slope * a;
            }
        }
        let [own, softer] = of_level;
        let between = |n: usize| own[n] + self.share * (softer[n] - own[n]);
        Some([
            between(0),
            between(1),
            between(2),
            (softer[0] - own[0]) / self.span,
        ])
    }
}

/// Weights of four pixels in a row for a place between the middle two, by a cubic through them (Catmull-Rom).
fn cubic(t: f32) -> [f32; 4] {
    let (t2, t3) = (t * t, t * t * t);
    [
        0.5 * (-t3 + 2.0 * t2 - t),
        0.5 * (3.0 * t3 - 5.0 * t2 + 2.0),
        0.5 * (-3.0 * t3 + 4.0 * t2 + t),
        0.5 * (t3 - t2),
    ]
}

/// Their slopes by the place.
fn cubic_slope(t: f32) -> [f32; 4] {
    let t2 = t * t;
    [
        0.5 * (-3.0 * t2 + 4.0 * t - 1.0),
        0.5 * (9.0 * t2 - 10.0 * t),
        0.5 * (-9.0 * t2 + 8.0 * t + 1.0),
        0.5 * (3.0 * t2 - 2.0 * t),
    ]
}

impl Background {
    /// A row of the mean blurred downwards, into the middle of `row`; the border continues beyond it on either side.
    pub(super) fn row_blurred<'r>(&self, y: usize, down: &Kernel, row: &'r mut [f32]) -> &'r [f32] {
        let (width, height) = (self.width, self.mean.len() / self.width.max(1));
        row.fill(0.0);
        let (left, rest) = row.split_at_mut(MOST_REACH);
        let (own, right) = rest.split_at_mut(width);
        for (j, w) in (y as isize - down.reach as isize..).zip(down.taps()) {
            let from = j.clamp(0, height as isize - 1) as usize * width;
            let means = self.mean.get(from..from + width).unwrap_or(&[]);
            for (sum, m) in own.iter_mut().zip(means) {
                *sum += w * m;
            }
        }
        left.fill(own.first().copied().unwrap_or(0.0));
        right.fill(own.last().copied().unwrap_or(0.0));
        row
    }
}
