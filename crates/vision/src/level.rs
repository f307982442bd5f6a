//! Grey level of the background from place to place: medians of tiles, and straight between their middles.

use crate::blobs::WIDEST;

/// Side of a tile, in radii of a bead: one in it leaves the median alone.
const RADII: f64 = 6.0;
/// Most tiles either way, and pixels of each that serve for its median.
const MOST: usize = 16;
const SAMPLES: usize = 160;

/// The background's level. Allocates only when made.
#[derive(Debug, Clone)]
pub(crate) struct Level {
    columns: usize,
    rows: usize,
    tile: (f32, f32),
    values: [[f32; MOST]; MOST],
    /// Level along the middles of the row of tiles at or above the row last asked for, and how much it rises to the next one.
    upper: Vec<f32>,
    rise: Vec<f32>,
    upper_tile: usize,
    /// Level along the row last asked for.
    row: Vec<f32>,
    y: usize,
    width: usize,
}

impl Level {
    pub(crate) fn new() -> Self {
        Level {
            columns: 1,
            rows: 1,
            tile: (1.0, 1.0),
            values: [[0.0; MOST]; MOST],
            upper: Vec::with_capacity(WIDEST),
            rise: Vec::with_capacity(WIDEST),
            upper_tile: usize::MAX,
            row: Vec::with_capacity(WIDEST),
            y: usize::MAX,
            width: 0,
        }
    }

    /// Takes the levels of a frame, for beads of a radius; `mean` is the level where there is but one tile.
    pub(crate) fn take<T: Copy>(
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
        (self.y, self.upper_tile, self.width) = (usize::MAX, usize::MAX, width);
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
                let (whole_rows, rest) = (step / across, step % across);
                let (mut x, mut y) = (0, 0);
                for slot in &mut samples {
                    let Some(v) = pixels.get((y0 + y) * width + x0 + x).filter(|_| y < down) else {
                        break;
                    };
                    *slot = f32::from(*v);
                    n += 1;
                    // The next of the tile's pixels, counted row by row, that is `step` further.
                    (x, y) = (x + rest, y + whole_rows);
                    if x >= across {
                        (x, y) = (x - across, y + 1);
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

    /// Level along a row.
    pub(crate) fn row(&mut self, y: usize) -> &[f32] {
        let one = self.columns * self.rows == 1;
        if self.y != y && !(one && self.row.len() == self.width) {
            self.fill(y);
        }
        self.y = y;
        &self.row
    }

    fn fill(&mut self, y: usize) {
        let last = (self.rows - 1) as f32;
        let place = ((y as f32 + 0.5) / self.tile.1 - 0.5).clamp(0.0, last);
        let upper = (place as usize).min(self.rows.saturating_sub(2));
        if self.upper_tile != upper {
            self.upper_tile = upper;
            let [first, second] = [upper, (upper + 1).min(self.rows - 1)].map(|j| self.values[j]);
            self.along(&first, |level| level.upper.as_mut());
            let rises = std::array::from_fn(|i| second[i] - first[i]);
            self.along(&rises, |level| level.rise.as_mut());
        }
        let share = place - upper as f32;
        self.row.clear();
        let parts = self.upper.iter().zip(&self.rise);
        self.row
            .extend(parts.map(|(level, rise)| level + share * rise));
    }

    /// Fills a line of pixels from values in the middles of tiles: straight from one middle to the next, level before the first and
    /// after the last.
    fn along(&mut self, values: &[f32; MOST], line: impl Fn(&mut Self) -> &mut Vec<f32>) {
        let (tile_px, columns, width) = (self.tile.0, self.columns, self.width);
        let line = line(self);
        line.resize(width, 0.0);
        let middle = |k: usize| (k as f32 + 0.5) * tile_px - 0.5;
        let mut done = 0;
        for k in 0..=columns {
            let end = if k < columns {
                (middle(k).ceil().max(0.0) as usize).min(width)
            } else {
                width
            };
            let (left, right) = (k.saturating_sub(1), k.min(columns - 1));
            let slope = (values[right] - values[left]) / tile_px;
            let start = values[left] - slope * middle(left);
            if let Some(part) = line.get_mut(done..end) {
                let start = start + slope * done as f32;
                for (n, value) in (0_i32..).zip(part) {
                    *value = start + slope * n as f32;
                }
            }
            done = done.max(end);
        }
    }
}
