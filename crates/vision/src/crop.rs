//! The window around a bead, copied out of the frame into a buffer of fixed size.

use crate::config::MAX_WINDOW_PX;
use crate::frame::{Frame, Pixels};

/// Pixels that are computed on together.
pub(crate) const LANES: usize = 4;
/// Row length of the buffer: the largest window rounded up to whole lanes.
pub(crate) const STRIDE: usize = MAX_WINDOW_PX.next_multiple_of(LANES);

/// Most pixels of a window that are left out of a fit.
const MOST_HOLES: usize = 32;

/// Degrees of freedom of the noise variance for each difference of neighbours. Neighbouring differences have a pixel in common: the mean of
/// their squares has the relative variance 2 * 1.5 / n.
const FREEDOM: f64 = 0.67;
/// Variance of rounding to whole numbers.
const ROUNDING_VARIANCE: f64 = 1.0 / 12.0;

/// One row of a window.
pub(crate) type Row = [f32; STRIDE];

/// A window of the frame, clipped at the frame's border, as grey levels above `pedestal`.
#[derive(Debug, Clone)]
pub(crate) struct Crop {
    pub rows: Box<[Row; MAX_WINDOW_PX]>,
    /// 1 in the columns of the window, 0 in those that fill up the lanes.
    pub mask: Row,
    pub x0: usize,
    pub y0: usize,
    pub width: usize,
    pub height: usize,
    /// Row and column of the pixels that count for nothing.
    holes: [(usize, usize); MOST_HOLES],
    holes_used: usize,
    /// Grey level taken off every pixel, so that single precision loses nothing.
    pub pedestal: f32,
    /// Step of the grey levels.
    step: f32,
}

impl Crop {
    pub(crate) fn new() -> Self {
        let rows = Box::new([[0.0; STRIDE]; MAX_WINDOW_PX]);
        Crop {
            rows,
            mask: [0.0; STRIDE],
            x0: 0,
            y0: 0,
            width: 0,
            height: 0,
            holes: [(0, 0); MOST_HOLES],
            holes_used: 0,
            pedestal: 0.0,
            step: 1.0,
        }
    }

    /// Copies the window of side `side` centred on the pixel nearest to (`x_px`, `y_px`). False when less than 5 x 5
    /// pixels of it lie within the frame, or the frame holds fewer pixels than it claims.
    pub(crate) fn take(&mut self, frame: &Frame, x_px: f64, y_px: f64, side: usize) -> bool {
        let half = (side.min(MAX_WINDOW_PX) / 2) as f64;
        let first = |c: f64| (c.round() - half).max(0.0) as usize;
        let end = |c: f64, len: usize| ((c.round() + half + 1.0).max(0.0) as usize).min(len);
        let (x0, x1) = (first(x_px), end(x_px, frame.width));
        let (y0, y1) = (first(y_px), end(y_px, frame.height));
        if !(x_px.is_finite() && y_px.is_finite()) || x1 < x0 + 5 || y1 < y0 + 5 {
            return false;
        }
        (self.x0, self.y0, self.width, self.height) = (x0, y0, x1 - x0, y1 - y0);
        self.holes_used = 0;
        for (i, m) in self.mask.iter_mut().enumerate() {
            *m = f32::from(u8::from(i < self.width));
        }
        let copied = match frame.pixels {
            Pixels::Mono8(p) => self.copy(p, frame.width),
            Pixels::Mono16(p) => self.copy(p, frame.width),
        };
        if copied {
            self.take_off_pedestal();
            // After a slope of the light is taken off, the levels have no steps.
            self.step = self.grey_step();
        }
        copied
    }

    /// Leaves a pixel out of the fits in this window, with `value` in its place for what does not ask. False where there is
    /// no more room.
    pub(crate) fn leave_out(&mut self, (row, column): (usize, usize), value: f32) -> bool {
        let slot = self.holes.get_mut(self.holes_used);
        let pixel = self.rows.get_mut(row).and_then(|r| r.get_mut(column));
        let (Some(slot), Some(pixel)) = (slot, pixel) else {
            return false;
        };
        (*slot, *pixel) = ((row, column), value);
        self.holes_used += 1;
        true
    }

    /// Pixels of a row, rounded up to whole lanes.
    pub(crate) fn lanes_end(&self) -> usize {
        self.width.next_multiple_of(LANES).min(STRIDE)
    }

    /// Columns of a row that are left out.
    pub(crate) fn left_out(&self, row: usize) -> impl Iterator<Item = usize> {
        let holes = self.holes.iter().take(self.holes_used);
        holes.filter(move |hole| hole.0 == row).map(|hole| hole.1)
    }

    /// Whether any pixel is left out.
    pub(crate) fn has_holes(&self) -> bool {
        self.holes_used > 0
    }

    fn copy<T: Copy>(&mut self, pixels: &[T], frame_width: usize) -> bool
    where
        f32: From<T>,
    {
        for (j, row) in self.rows.iter_mut().enumerate().take(self.height) {
            let start = (self.y0 + j) * frame_width + self.x0;
            let Some(source) = pixels.get(start..start + self.width) else {
                return false;
            };
            for (to, from) in row.iter_mut().zip(source) {
                *to = f32::from(*from);
            }
        }
        true
    }

    /// Takes off light that rises by so much a pixel along the row and along the column, and is 0 at a place of the window.
    pub(crate) fn take_off_slope(&mut self, (x, y): (f32, f32), (along, down): (f32, f32)) {
        let width = self.width;
        for (j, row) in self.rows.iter_mut().enumerate().take(self.height) {
            let start = down * (j as f32 - y) - along * x;
            for (i, v) in row.iter_mut().enumerate().take(width) {
                *v -= start + along * i as f32;
            }
        }
    }

    fn take_off_pedestal(&mut self) {
        let (mut sum, mut count) = (0.0, 0.0_f32);
        self.border(|v, _, _| {
            sum += v;
            count += 1.0;
        });
        self.pedestal = sum / count.max(1.0);
        let (width, pedestal) = (self.width, self.pedestal);
        for row in self.rows.iter_mut().take(self.height) {
            for v in row.iter_mut().take(width) {
                *v -= pedestal;
            }
        }
    }

    /// Visits the pixels along the window's border: value, row and column, and whether the one before was its neighbour.
    fn border(&self, mut visit: impl FnMut(f32, (usize, usize), bool)) {
        let (last_row, last_column) = (self.height.saturating_sub(1), self.width.saturating_sub(1));
        for j in [0, last_row] {
            for (i, v) in self.rows[j.min(MAX_WINDOW_PX - 1)]
                .iter()
                .enumerate()
                .take(self.width)
            {
                visit(*v, (j, i), i > 0);
            }
        }
        for i in [0, last_column] {
            for (j, row) in self.rows.iter().enumerate().take(last_row).skip(1) {
                visit(row[i.min(STRIDE - 1)], (j, i), j > 1);
            }
        }
    }

    /// Noise variance of a pixel, grey levels squared, and its degrees of freedom, from differences of neighbours along the border after
    /// a model is taken off. Differences are blind to uneven light; those above four times the mean (another bead's edge) are left
    /// out, but none of one step of the grey levels. The rounding to such steps is the least noise.
    pub(crate) fn noise_variance(&self, model: impl Fn(usize, usize) -> f32) -> (f64, f64) {
        let (mut differences, mut all) = ([0.0_f32; 4 * MAX_WINDOW_PX], 0);
        let mut previous = 0.0;
        self.border(|v, (j, i), neighbour| {
            let v = v - model(j, i);
            if neighbour && let Some(d) = differences.get_mut(all) {
                *d = (v - previous).abs();
                all += 1;
            }
            previous = v;
        });
        let (mut limit, mut variance, mut used) = (f32::INFINITY, 0.0, 0.0);
        for _ in 0..2 {
            let (mut sum, mut squares, mut count) = (0.0, 0.0, 0.0_f32);
            for d in differences.iter().take(all).filter(|d| **d < limit) {
                sum += d;
                squares += d * d;
                count += 1.0;
            }
            limit = (4.0 * sum / count.max(1.0)).max(1.5 * self.step);
            (variance, used) = (0.5 * squares / count.max(1.0), count);
        }
        let rounding = ROUNDING_VARIANCE * f64::from(self.step * self.step);
        (f64::from(variance).max(rounding), FREEDOM * f64::from(used))
    }

    /// Least difference of neighbours along the border and across the middle, 1 or more: the step of the grey levels where they have
    /// fewer bits than their numbers.
    fn grey_step(&self) -> f32 {
        let mut step = f32::INFINITY;
        let mut previous = 0.0_f32;
        let mut look = |v: f32, neighbour: bool| {
            let d = (v - previous).abs();
            previous = v;
            if neighbour && d > 0.5 && d < step {
                step = d;
            }
        };
        self.border(|v, _, neighbour| look(v, neighbour));
        let middle = self.rows.get(self.height / 2).into_iter().flatten();
        for (i, v) in middle.take(self.width).enumerate() {
            look(*v, i > 0);
        }
        for (j, row) in self.rows.iter().take(self.height).enumerate() {
            look(row[(self.width / 2).min(STRIDE - 1)], j > 0);
        }
        if step.is_finite() { step } else { 1.0 }
    }

    /// Centroid of the pixels on the bead's side of half the largest contrast, within `reach_px` of the brightest, in
    /// frame coordinates. `sign` is -1 for a dark core.
    pub(crate) fn centroid(&self, sign: f32, reach_px: f64) -> Option<(f64, f64)> {
        // A sum of three pixels in a row, so that one hot pixel does not lead astray.
        let (mut best, mut at) = (0.0_f32, None);
        for (j, row) in self.rows.iter().enumerate().take(self.height) {
            for (i, w) in row
                .windows(3)
                .enumerate()
                .take(self.width.saturating_sub(2))
            {
                let sum = sign * w.iter().sum::<f32>();
                if sum > best {
                    (best, at) = (sum, Some((i + 1, j)));
                }
            }
        }
        let (i0, j0) = at?;
        let threshold = best / 6.0;
        let (mut sx, mut sy, mut s) = (0.0_f64, 0.0_f64, 0.0_f64);
        for (j, row) in self.rows.iter().enumerate().take(self.height) {
            for (i, v) in row.iter().enumerate().take(self.width) {
                let above = sign * v - threshold;
                let near = f64::hypot(i as f64 - i0 as f64, j as f64 - j0 as f64) <= 2.0 * reach_px;
                if above > 0.0 && near {
                    let above = f64::from(above);
                    sx += above * i as f64;
                    sy += above * j as f64;
                    s += above;
                }
            }
        }
        (s > 0.0).then(|| (self.x0 as f64 + sx / s, self.y0 as f64 + sy / s))
    }
}
