//! Grey level of the background from place to place: medians of tiles, and straight between their middles.

use crate::seed::PATCH;

/// Side of a tile, in radii of a bead: one in it leaves the median alone.
const RADII: f64 = 6.0;
/// Most tiles either way, and pixels of each that serve for its median.
const MOST: usize = 16;
const SAMPLES: usize = 160;
/// Widest frame for which it is done, px.
const WIDEST: usize = 16_384;

/// The background's level. Allocates only when made.
#[derive(Debug, Clone)]
pub(crate) struct Level {
    columns: usize,
    rows: usize,
    tile: (f32, f32),
    values: [[f32; MOST]; MOST],
    /// Level along the row last asked for.
    row: Vec<f32>,
    y: usize,
    width: usize,
}

impl Level {
    pub fn new() -> Self {
        Level {
            columns: 1,
            rows: 1,
            tile: (1.0, 1.0),
            values: [[0.0; MOST]; MOST],
            row: Vec::with_capacity(WIDEST),
            y: usize::MAX,
            width: 0,
        }
    }

    /// Takes the levels of a frame, for beads of a radius; `mean` is the level where there is but one tile.
    pub fn take<T: Copy>(
        &mut self,
        pixels: &[T],
        (width, height): (usize, usize),
        radius_px: f64,
        mean: f32,
    ) where
        f32: From<T>,
    {
        let count =
            |side: usize| ((side as f64 / (RADII * radius_px).max(8.0)) as usize).clamp(1, MOST);
        (self.columns, self.rows) = (count(width), count(height));
        if width > WIDEST {
            (self.columns, self.rows) = (1, 1);
        }
        self.tile = (
            width as f32 / self.columns as f32,
            height as f32 / self.rows as f32,
        );
        (self.y, self.width) = (usize::MAX, width);
        self.values[0][0] = mean;
        if self.columns * self.rows == 1 {
            return;
        }
        for j in 0..self.rows {
            for i in 0..self.columns {
                let edge = |k: usize, side: f32| (k as f32 * side) as usize;
                let (x0, x1) = (edge(i, self.tile.0), edge(i + 1, self.tile.0).min(width));
                let (y0, y1) = (edge(j, self.tile.1), edge(j + 1, self.tile.1).min(height));
                let (across, down) = ((x1 - x0).max(1), (y1 - y0).max(1));
                let step = (across * down / SAMPLES).max(1) | 1;
                let mut samples = [0.0_f32; SAMPLES];
                let mut n = 0;
                for k in (0..across * down).step_by(step) {
                    let at = (y0 + k / across) * width + x0 + k % across;
                    if let (Some(slot), Some(v)) = (samples.get_mut(n), pixels.get(at)) {
                        *slot = f32::from(*v);
                        n += 1;
                    }
                }
                let samples = &mut samples[..n];
                if n > 0 {
                    let (_, middle, _) = samples.select_nth_unstable_by(n / 2, f32::total_cmp);
                    self.values[j][i] = *middle;
                }
            }
        }
    }

    /// Level at a pixel; cheap for pixels of one row after another.
    #[inline(always)]
    pub fn at(&mut self, x: usize, y: usize) -> f32 {
        if self.columns * self.rows == 1 {
            return self.values[0][0];
        }
        if self.y != y {
            self.fill(y);
        }
        self.row.get(x).copied().unwrap_or(0.0)
    }

    fn fill(&mut self, y: usize) {
        self.y = y;
        self.row.clear();
        let between = |k: usize, side: f32, count: usize| {
            let place = ((k as f32 + 0.5) / side - 0.5).clamp(0.0, (count - 1) as f32);
            let low = (place as usize).min(count.saturating_sub(2));
            (low, (low + 1).min(count - 1), place - low as f32)
        };
        let (above, below, v) = between(y, self.tile.1, self.rows);
        let mut line = [0.0_f32; MOST];
        for ((value, a), b) in line
            .iter_mut()
            .zip(&self.values[above])
            .zip(&self.values[below])
        {
            *value = a + v * (b - a);
        }
        for x in 0..self.width {
            let (left, right, u) = between(x, self.tile.0, self.columns);
            let (a, b) = (line[left], line[right]);
            self.row.push(a + u * (b - a));
        }
    }

    /// Largest contrast of a patch of 3 x 3 pixels, `step` pixels apart, of the sign asked for, grey levels.
    pub fn strongest<T: Copy>(
        &mut self,
        pixels: &[T],
        (width, height): (usize, usize),
        sign: f32,
        step: usize,
    ) -> f32
    where
        f32: From<T>,
    {
        let mut best = 0.0_f32;
        if width < PATCH || height < PATCH {
            return best;
        }
        for j in (0..=height - PATCH).step_by(step) {
            let row = |k: usize| {
                pixels
                    .get((j + k) * width..(j + k + 1) * width)
                    .unwrap_or(&[])
            };
            let columns = row(0)
                .windows(PATCH)
                .zip(row(1).windows(PATCH))
                .zip(row(2).windows(PATCH));
            for (i, ((a, b), c)) in columns.enumerate().step_by(step) {
                let add = |w: &[T]| w.iter().map(|v| f32::from(*v)).sum::<f32>();
                let mean = (add(a) + add(b) + add(c)) / (PATCH * PATCH) as f32;
                best = best.max(sign * (mean - self.at(i + 1, j + 1)));
            }
        }
        best
    }
}
