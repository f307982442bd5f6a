//! Where something is: patches of 4 x 4 pixels whose RMS contrast stands out, joined.
//!
//! The square of the contrast counts, whatever its sign: a dark rim, a bright halo and a body hardly different from the background
//! are one region. A gap of one patch is closed. The outermost patches are left out, so that lines along the border of a frame (a
//! header written into the picture, a wall) do not join objects near them.

use super::background::Bounds;
use crate::blobs::{Blob, Blobs};
use crate::outline::Start;

/// A region of this many patches is an object from this share of that on: dust is small.
const FAINT: (f64, f64) = (6.0, 0.7);
/// Side of a patch, px.
pub(super) const PATCH: usize = 4;
/// Share of its RMS contrast that a region's core has at least.
const CORE: f64 = 0.4;
/// A region this many times as long as wide may be several objects in a row.
const LONG: f64 = 1.4;
/// Share of what is on either side that is left of the body between two objects.
const GAP: f32 = 0.3;
/// Most objects in a row that are kept apart.
const MAX_PARTS: usize = 4;
/// Places along a region at which its body is summed, a patch long each.
const BINS: usize = 512;
/// Runs kept per row of patches.
const RUNS_PER_ROW: usize = 16;

/// Buffers.
#[derive(Debug, Clone)]
pub(super) struct Regions {
    columns: usize,
    rows: usize,
    /// Mean square contrast of each patch.
    patches: Vec<f32>,
    /// Sums of what is darker and of what is brighter than the background in each patch.
    signs: Vec<[f32; 2]>,
    /// Sums over the rows of a row of patches: of squares, of values and of their absolutes in each column.
    sums: [Vec<f32>; 3],
    /// The patches with gaps closed and without the outermost.
    closed: Vec<f32>,
    blobs: Blobs,
    pub bounds: Vec<Bounds>,
}

impl Regions {
    pub(super) fn new(width: usize, height: usize, max_regions: usize) -> Self {
        // The last patch of a row and of a column takes the remaining pixels.
        let (columns, rows) = ((width / PATCH).max(1), (height / PATCH).max(1));
        // A region shaped like a comb takes a label for each tooth.
        let room = 16 * max_regions;
        Regions {
            columns,
            rows,
            patches: vec![0.0; columns * rows],
            signs: vec![[0.0; 2]; columns * rows],
            sums: [0; 3].map(|_| vec![0.0; width]),
            closed: vec![0.0; columns * rows],
            blobs: Blobs::with_spans(room.max(columns / 2 + 1), room, RUNS_PER_ROW * rows),
            bounds: Vec::with_capacity(room),
        }
    }

    /// Joins the patches of a frame's contrast above `threshold` (grey levels RMS). Keeps the bounds of those that are objects,
    /// with the mean square `seed`.
    pub(super) fn find(&mut self, contrast: &[f32], width: usize, threshold: f32, seed: f64) {
        self.sum_patches(contrast, width);
        self.close();
        let (closed, columns) = (&self.closed, self.columns);
        let row = |y: usize, to: &mut [f32]| {
            if let Some(from) = closed.get(y * columns..(y + 1) * columns) {
                to.copy_from_slice(from);
            }
        };
        self.blobs
            .label((columns, self.rows), threshold * threshold, 1.0, row);
        self.bounds.clear();
        let strong = self
            .blobs
            .found()
            .iter()
            .filter(|blob| is_object(blob, seed));
        for blob in strong.take(self.bounds.capacity()) {
            self.bounds.push(blob.bounds.map(|b| b as usize * PATCH));
        }
    }

    /// Mean squares and signs of the patches.
    fn sum_patches(&mut self, contrast: &[f32], width: usize) {
        let height = contrast.len() / width.max(1);
        let last = self.rows - 1;
        for row in 0..self.rows {
            let end = if row == last {
                height
            } else {
                (row + 1) * PATCH
            };
            let [squares, plain, absolute] = &mut self.sums;
            for sums in [&mut *squares, plain, absolute] {
                sums.fill(0.0);
            }
            let band = contrast
                .get(row * PATCH * width..end * width)
                .unwrap_or(&[]);
            for values in band.chunks_exact(width) {
                let sums = squares
                    .iter_mut()
                    .zip(plain.iter_mut())
                    .zip(absolute.iter_mut());
                for (((square, plain), absolute), v) in sums.zip(values) {
                    *square += v * v;
                    *plain += v;
                    *absolute += v.abs();
                }
            }
            let at = row * self.columns;
            let (Some(patches), Some(signs)) = (
                self.patches.get_mut(at..at + self.columns),
                self.signs.get_mut(at..at + self.columns),
            ) else {
                continue;
            };
            let rows = end - row * PATCH;
            let over = 1.0 / (rows * PATCH) as f32;
            let (fours, left) = squares.as_chunks::<PATCH>();
            patches.fill(0.0);
            for (patch, [a, b, c, d]) in patches.iter_mut().zip(fours) {
                *patch = (a + b + (c + d)) * over;
            }
            if !left.is_empty()
                && let Some(patch) = patches.last_mut()
            {
                let all = *patch / over + left.iter().sum::<f32>();
                *patch = all / (rows * (width - PATCH * (self.columns - 1))) as f32;
            }
            let (plain, absolute) = (
                plain.as_chunks::<PATCH>().0,
                absolute.as_chunks::<PATCH>().0,
            );
            for ((signs, [a, b, c, d]), [e, f, g, h]) in signs.iter_mut().zip(plain).zip(absolute) {
                let (plain, absolute) = (a + b + (c + d), e + f + (g + h));
                *signs = [absolute - plain, absolute + plain];
            }
        }
    }

    /// Closes gaps of one patch, and leaves the outermost patches out.
    fn close(&mut self) {
        let (columns, rows) = (self.columns, self.rows);
        self.closed.fill(0.0);
        if columns < 3 || rows < 3 {
            return;
        }
        let row = |y: usize| {
            self.patches
                .get(y * columns..(y + 1) * columns)
                .unwrap_or(&[])
        };
        let most = |a: f32, b: f32| if a > b { a } else { b };
        let least = |a: f32, b: f32| if a < b { a } else { b };
        for y in 1..rows - 1 {
            let (above, own, below) = (row(y - 1), row(y), row(y + 1));
            let Some(closed) = self.closed.get_mut(y * columns..(y + 1) * columns) else {
                continue;
            };
            for (x, closed) in closed.iter_mut().enumerate().take(columns - 1).skip(1) {
                let (Some([a, b, c]), Some([d, e, f]), Some([g, h, i])) = (
                    above.get(x - 1..x + 2),
                    own.get(x - 1..x + 2),
                    below.get(x - 1..x + 2),
                ) else {
                    continue;
                };
                let mut value = *e;
                // Neighbours among the outermost do not count.
                let (upper, lower) = (y > 1, y + 2 < rows);
                let (left, right) = (x > 1, x + 2 < columns);
                if left && right {
                    value = most(value, least(*d, *f));
                }
                if upper && lower {
                    value = most(value, least(*b, *h));
                }
                if left && right && upper && lower {
                    value = most(value, most(least(*a, *i), least(*c, *g)));
                }
                *closed = value;
            }
        }
    }

    /// Regions, the largest sum of squared contrast first.
    pub(super) fn found(&self) -> &[Blob] {
        self.blobs.found()
    }

    /// Whether the frame held more than there was room for.
    pub(super) fn is_cluttered(&self) -> bool {
        self.blobs.dropped_runs() > 0
    }

    /// Cuts a long region where, along it, hardly anything of its body is left between two objects whose halos meet.
    pub(super) fn parts(&self, blob: &Blob) -> Parts {
        let mut parts = Parts::whole();
        let Some(start) = self.start(blob, &parts.get(0)) else {
            return parts;
        };
        if start.long_px < LONG * start.short_px {
            return parts;
        }
        let (sin, cos) = start.angle_rad.sin_cos();
        parts.along = [cos, sin, start.x_px * cos + start.y_px * sin];
        let mut body = [[0.0_f32; 2]; BINS];
        let bin = |u: f64| ((u / PATCH as f64 + 0.5 * BINS as f64) as usize).min(BINS - 1);
        for span in self.blobs.spans(blob) {
            for x in span.start..span.end {
                let k = span.y as usize * self.columns + x as usize;
                let u = parts.place(middle(x), middle(span.y));
                if let (Some([dark, bright]), Some(sums)) =
                    (self.signs.get(k), body.get_mut(bin(u)))
                {
                    sums[0] += dark;
                    sums[1] += bright;
                }
            }
        }
        let total = body
            .iter()
            .fold([0.0, 0.0], |t, b| [t[0] + b[0], t[1] + b[1]]);
        let sign = usize::from(total[1] > total[0]);
        let at = |k: usize| body.get(k).map_or(0.0, |b| b[sign]);
        let smooth: [f32; BINS] =
            std::array::from_fn(|k| 0.25 * at(k.wrapping_sub(1)) + 0.5 * at(k) + 0.25 * at(k + 1));
        // The largest from each place on.
        let mut behind = smooth;
        for k in (0..BINS - 1).rev() {
            behind[k] = behind[k].max(behind[k + 1]);
        }
        let (mut before, mut from) = (0.0_f32, 0);
        for k in 1..BINS - 1 {
            let here = smooth[k];
            before = before.max(here);
            let lowest = here <= smooth[k - 1] && here < smooth[k + 1];
            if lowest && here < GAP * before.min(behind[k]) && k > from {
                parts.cut((k as f64 + 0.5 - 0.5 * BINS as f64) * PATCH as f64);
                (before, from) = (0.0, k);
            }
        }
        parts
    }

    /// The ellipse with the same second moments as the part of a region that exceeds a share of its RMS contrast, holes filled:
    /// faint fringes do not count.
    pub(super) fn start(&self, blob: &Blob, part: &Part) -> Option<Start> {
        let (mut n, mut sx, mut sy, mut sxx, mut sxy, mut syy) = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0);
        let strong = (CORE * CORE * blob.contrast_sum / blob.area_px) as f32;
        for span in self.blobs.spans(blob) {
            let at = span.y as usize * self.columns;
            let counts = |x: &u32| {
                let value = self.patches.get(at + *x as usize);
                value.is_some_and(|v| *v >= strong) && part.holds(middle(*x), middle(span.y))
            };
            let (Some(first), Some(last)) = (
                (span.start..span.end).find(counts),
                (span.start..span.end).rev().find(counts),
            ) else {
                continue;
            };
            let (a, b, y) = (
                f64::from(first),
                f64::from(last) + 1.0,
                f64::from(span.y) + 0.5,
            );
            let (count, mean) = (b - a, 0.5 * (a + b));
            n += count;
            sx += count * mean;
            sy += count * y;
            // A continuous stretch.
            sxx += count * (mean * mean + count * count / 12.0);
            sxy += count * mean * y;
            syy += count * (y * y + 1.0 / 12.0);
        }
        if n <= 0.0 {
            return None;
        }
        let (mx, my) = (sx / n, sy / n);
        let (xx, xy, yy) = (sxx / n - mx * mx, sxy / n - mx * my, syy / n - my * my);
        let (mean, half) = (0.5 * (xx + yy), 0.5 * f64::hypot(xx - yy, 2.0 * xy));
        let patch = PATCH as f64;
        Some(Start {
            x_px: patch * mx - 0.5,
            y_px: patch * my - 0.5,
            long_px: patch * 2.0 * (mean + half).sqrt(),
            short_px: patch * 2.0 * (mean - half).max(0.0).sqrt(),
            angle_rad: 0.5 * (2.0 * xy).atan2(xx - yy),
        })
    }

    /// Columns and rows (first and last, px) that may hold the object: those of its region and the outermost patches next to it,
    /// unless a line of quite another contrast is there.
    pub(super) fn room(&self, blob: &Blob, (width, height): (usize, usize)) -> [f32; 4] {
        let [left, top, right, bottom] = blob.bounds.map(|b| b as usize);
        let most = 2.0 * blob.peak as f32;
        let calm = |x: usize, y: usize| {
            self.patches
                .get(y * self.columns + x)
                .is_none_or(|v| *v <= most)
        };
        let (last_x, last_y) = (self.columns - 1, self.rows - 1);
        let px = |patch: usize| (patch * PATCH) as f32;
        [
            if left > 1 || (top..bottom).all(|y| calm(0, y)) {
                px(left.saturating_sub(1))
            } else {
                px(left)
            },
            if top > 1 || (left..right).all(|x| calm(x, 0)) {
                px(top.saturating_sub(1))
            } else {
                px(top)
            },
            if right < last_x || (top..bottom).all(|y| calm(last_x, y)) {
                if right + 1 > last_x {
                    width as f32 - 1.0
                } else {
                    px(right + 1) - 1.0
                }
            } else {
                px(right) - 1.0
            },
            if bottom < last_y || (left..right).all(|x| calm(x, last_y)) {
                if bottom + 1 > last_y {
                    height as f32 - 1.0
                } else {
                    px(bottom + 1) - 1.0
                }
            } else {
                px(bottom) - 1.0
            },
        ]
    }

    /// Area of the region's strong patches (mean square above `strong`) for which `outside` holds, px.
    pub(super) fn area_where(
        &self,
        blob: &Blob,
        strong: f32,
        outside: impl Fn(f64, f64) -> bool,
    ) -> f64 {
        let mut patches = 0.0;
        for span in self.blobs.spans(blob) {
            for x in span.start..span.end {
                let value = self
                    .patches
                    .get(span.y as usize * self.columns + x as usize);
                if value.is_some_and(|v| *v > strong) && outside(middle(x), middle(span.y)) {
                    patches += 1.0;
                }
            }
        }
        patches * (PATCH * PATCH) as f64
    }
}

/// Middle of a patch, px.
fn middle(patch: u32) -> f64 {
    PATCH as f64 * (f64::from(patch) + 0.5) - 0.5
}

/// A region in pieces along its length.
#[derive(Debug, Clone, Copy)]
pub(super) struct Parts {
    /// Direction, and its product with the region's middle.
    along: [f64; 3],
    cuts: [f64; MAX_PARTS - 1],
    count: usize,
}

/// One piece: from and to, px along the region.
#[derive(Debug, Clone, Copy)]
pub(super) struct Part {
    along: [f64; 3],
    from: f64,
    to: f64,
}

impl Parts {
    fn whole() -> Self {
        Parts {
            along: [0.0; 3],
            cuts: [f64::INFINITY; MAX_PARTS - 1],
            count: 1,
        }
    }

    fn place(&self, x: f64, y: f64) -> f64 {
        x * self.along[0] + y * self.along[1] - self.along[2]
    }

    fn cut(&mut self, at: f64) {
        if let Some(place) = self.cuts.get_mut(self.count - 1) {
            *place = at;
            self.count += 1;
        }
    }

    /// How many there are.
    pub(super) fn len(&self) -> usize {
        self.count
    }

    pub(super) fn get(&self, part: usize) -> Part {
        let cut = |k: usize| self.cuts.get(k).copied().unwrap_or(f64::INFINITY);
        Part {
            along: self.along,
            from: if part == 0 {
                f64::NEG_INFINITY
            } else {
                cut(part - 1)
            },
            to: cut(part),
        }
    }
}

impl Part {
    /// Whether a point belongs to it.
    pub(super) fn holds(&self, x: f64, y: f64) -> bool {
        let u = x * self.along[0] + y * self.along[1] - self.along[2];
        u >= self.from && u < self.to
    }
}

/// Whether a region is more than a fluctuation; `strong` is the mean square contrast that a patch of an object has.
pub(super) fn is_object(blob: &Blob, strong: f64) -> bool {
    blob.peak >= strong || blob.area_px >= FAINT.0 && blob.peak >= FAINT.1 * FAINT.1 * strong
}
