//! The surface of a region: what lies inside the line on which the contrast is half of the body's.
//!
//! Between the pixels the contrast is taken along the grid's edges as linear, so that the line is a polygon (marching
//! squares) that moves smoothly with the pixels' values; area and moments are those of the polygon. How each pixel of the
//! outline moves it is known, and with it the variance of the middle. Allocates only when made.

use crate::blobs::{Blob, Span};

/// Pixels looked at beyond those above the threshold.
const MARGIN_PX: u32 = 2;
/// Pixels left out at the ends of a row, and rows at top and bottom, for the contrast of the body: the soft edge.
const EDGE_PX: u32 = 3;

/// Area, middle and moments of a region.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Surface {
    pub x_px: f64,
    pub y_px: f64,
    /// Of `x_px`, `y_px`, and their covariance, for pixels with noise of variance 1.
    pub unit_variances: [f64; 3],
    pub area_px: f64,
    /// Central second moments: x x, x y, y y.
    pub moments_px2: [f64; 3],
    pub body: f64,
}

/// Buffers, and the region being measured.
#[derive(Debug, Clone)]
pub(crate) struct Outliner {
    width: usize,
    height: usize,
    rows: Vec<Span>,
    /// First and last row at or above the level, for each column.
    columns: Vec<(u32, u32)>,
    /// Contrast of two rows, holes filled.
    above: Vec<f64>,
    below: Vec<f64>,
    /// By how much area each pixel of two rows adds per unit of its value.
    pull_above: Vec<f64>,
    pull_below: Vec<f64>,
}

/// Sums over the surface.
#[derive(Debug, Default)]
struct Sums {
    n: f64,
    x: f64,
    y: f64,
    xx: f64,
    xy: f64,
    yy: f64,
    /// Squares of the pixels' pulls, with 1, x, y, x x, x y, y y.
    pulls: [f64; 6],
}

impl Outliner {
    pub fn new(width: usize, height: usize) -> Self {
        let row = vec![0.0; width];
        Outliner {
            width,
            height,
            rows: Vec::with_capacity(height),
            columns: vec![(u32::MAX, 0); width],
            above: row.clone(),
            below: row.clone(),
            pull_above: row.clone(),
            pull_below: row,
        }
    }

    /// Measures a region; `None` when nothing of it is at the level.
    pub fn measure(
        &mut self,
        blob: &Blob,
        spans: impl Iterator<Item = Span>,
        contrast: impl Fn(usize, usize) -> f32,
    ) -> Option<Surface> {
        self.rows.clear();
        self.rows.extend(spans.take(self.height));
        let body = self.body(&contrast).unwrap_or(blob.body);
        let level = 0.5 * body;
        let (first, last) = (self.rows.first()?.y, self.rows.last()?.y);
        let top = first.saturating_sub(MARGIN_PX);
        let bottom = (last + MARGIN_PX).min(self.height.saturating_sub(1) as u32);
        let [left, _, right, _] = blob.bounds;
        let left = left.saturating_sub(MARGIN_PX) as usize;
        let right = ((right + MARGIN_PX) as usize).min(self.width);
        if let Some(columns) = self.columns.get_mut(left..right) {
            columns.fill((u32::MAX, 0));
        }
        for y in top..=bottom {
            let (from, to) = self.around(y);
            for x in from..to {
                if f64::from(contrast(x, y as usize)) >= level
                    && let Some(column) = self.columns.get_mut(x)
                {
                    *column = (column.0.min(y), column.1.max(y));
                }
            }
        }
        let origin = (blob.x_px, blob.y_px);
        let mut sums = Sums::default();
        for row in [&mut self.above, &mut self.pull_above] {
            row.fill(0.0);
        }
        // From above the first row to below the last: what is not looked at counts as nothing.
        for y in top..=bottom + 1 {
            self.below.fill(0.0);
            self.pull_below.fill(0.0);
            if y <= bottom {
                self.fill_row(y, level, &contrast);
            }
            let lower_y = f64::from(y) - origin.1;
            let range = (left.saturating_sub(1), right);
            self.add_squares(&mut sums, range, level, origin.0, lower_y);
            sums.take_pulls(&self.pull_above, range, origin.0, lower_y - 1.0);
            std::mem::swap(&mut self.above, &mut self.below);
            std::mem::swap(&mut self.pull_above, &mut self.pull_below);
        }
        sums.surface(origin, body)
    }

    /// Mean contrast of what is well inside.
    fn body(&self, contrast: &impl Fn(usize, usize) -> f32) -> Option<f64> {
        let count = self.rows.len();
        let (mut sum, mut n) = (0.0, 0.0);
        let inner = self
            .rows
            .iter()
            .take(count.saturating_sub(EDGE_PX as usize));
        for row in inner.skip(EDGE_PX as usize) {
            for x in row.start + EDGE_PX..row.end.saturating_sub(EDGE_PX) {
                sum += f64::from(contrast(x as usize, row.y as usize));
                n += 1.0;
            }
        }
        (n > 0.0 && sum > 0.0).then(|| sum / n)
    }

    /// Columns (from, to) of a row that are near the region: in this row or one within the margin.
    fn around(&self, y: u32) -> (usize, usize) {
        let first = self.rows.first().map_or(0, |r| r.y);
        // A region's rows follow each other without a gap.
        let before = y.saturating_sub(first + MARGIN_PX) as usize;
        let near = self
            .rows
            .iter()
            .skip(before)
            .take_while(|r| r.y <= y + MARGIN_PX);
        let (from, to) = near.fold((u32::MAX, 0), |(from, to), r| {
            (from.min(r.start), to.max(r.end))
        });
        (
            from.saturating_sub(MARGIN_PX) as usize,
            ((to + MARGIN_PX) as usize).min(self.width),
        )
    }

    /// Reads a row into `below`; a pixel with the surface on all four sides is no hole.
    fn fill_row(&mut self, y: u32, level: f64, contrast: &impl Fn(usize, usize) -> f32) {
        let (from, to) = self.around(y);
        let (mut first, mut last) = (usize::MAX, 0);
        for x in from..to {
            let value = f64::from(contrast(x, y as usize));
            if value >= level {
                (first, last) = (first.min(x), x);
            }
            if let Some(place) = self.below.get_mut(x) {
                *place = value;
            }
        }
        for x in first.saturating_add(1)..last {
            if let (Some(place), Some(&(top, bottom))) =
                (self.below.get_mut(x), self.columns.get(x))
                && top < y
                && y < bottom
            {
                *place = place.max(level);
            }
        }
    }

    /// Adds the squares between the rows `above` and `below`.
    fn add_squares(
        &mut self,
        sums: &mut Sums,
        (from, to): (usize, usize),
        level: f64,
        x0: f64,
        lower_y: f64,
    ) {
        let value = |row: &[f64], x: usize| row.get(x).copied().unwrap_or(0.0);
        // One square beyond either border: the surface of a cut cell ends there.
        for x in from..to {
            let corners = [
                value(&self.above, x),
                value(&self.above, x + 1),
                value(&self.below, x + 1),
                value(&self.below, x),
            ];
            let inside = corners.map(|v| v >= level);
            if inside == [false; 4] {
                continue;
            }
            let left_x = x as f64 - x0;
            if inside == [true; 4] {
                sums.add_square(left_x + 0.5, lower_y - 0.5);
                continue;
            }
            let pulls = square(sums, corners, inside, level, (left_x, lower_y - 1.0));
            let [a, b, c, d] = pulls;
            for (row, left, right) in [(&mut self.pull_above, a, b), (&mut self.pull_below, d, c)] {
                for (place, pull) in row.iter_mut().skip(x).zip([left, right]) {
                    *place += pull;
                }
            }
        }
    }
}

/// Corners of a square in the order in which they are walked, from its upper left one.
const CORNERS: [(f64, f64); 4] = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)];

/// Adds the part of a square inside the line; gives how much area each corner's value adds per unit.
fn square(
    sums: &mut Sums,
    corners: [f64; 4],
    inside: [bool; 4],
    level: f64,
    (x, y): (f64, f64),
) -> [f64; 4] {
    let mut polygon = [(0.0, 0.0); 8];
    let mut count = 0;
    // Of each crossed side: place, share of the way from its inner corner, slope.
    let mut crossings = [None::<((f64, f64), f64, f64)>; 4];
    let mut push = |point| {
        if let Some(place) = polygon.get_mut(count) {
            *place = point;
            count += 1;
        }
    };
    for (side, crossing) in crossings.iter_mut().enumerate() {
        let (a, b) = (side, (side + 1) % 4);
        let (from, to) = (CORNERS[a], CORNERS[b]);
        if inside[a] {
            push((x + from.0, y + from.1));
        }
        if inside[a] != inside[b] {
            let rise = corners[b] - corners[a];
            let share = (level - corners[a]) / rise;
            let point = (
                x + from.0 + share * (to.0 - from.0),
                y + from.1 + share * (to.1 - from.1),
            );
            push(point);
            let from_inner = if inside[a] { share } else { 1.0 - share };
            *crossing = Some((point, from_inner, rise.abs()));
        }
    }
    sums.add_polygon(&polygon[..count.min(8)]);
    // The line leaves through a side behind an inner corner and comes back through the next crossed side.
    let mut pulls = [0.0; 4];
    for leaving in 0..4 {
        let Some((out, _, _)) = crossings[leaving].filter(|_| inside[leaving]) else {
            continue;
        };
        let back = (1..4)
            .map(|k| (leaving + k) % 4)
            .find(|&side| crossings[side].is_some());
        let Some((entering, (into, _, _))) = back.and_then(|s| crossings[s].map(|c| (s, c))) else {
            continue;
        };
        let (dx, dy) = ((out.0 - into.0).abs(), (out.1 - into.1).abs());
        for side in [leaving, entering] {
            let Some((_, share, slope)) = crossings[side] else {
                continue;
            };
            // A crossing that moves along its side takes half of the line's extent across the side with it.
            let area = 0.5 * if side % 2 == 0 { dy } else { dx };
            let (inner, outer) = if inside[side] {
                (side, (side + 1) % 4)
            } else {
                ((side + 1) % 4, side)
            };
            pulls[inner] += area * (1.0 - share) / slope;
            pulls[outer] += area * share / slope;
        }
    }
    pulls
}

impl Sums {
    fn add_square(&mut self, x: f64, y: f64) {
        self.n += 1.0;
        self.x += x;
        self.y += y;
        self.xx += x * x + 1.0 / 12.0;
        self.xy += x * y;
        self.yy += y * y + 1.0 / 12.0;
    }

    /// By Green's theorem, for corners walked in one sense.
    fn add_polygon(&mut self, corners: &[(f64, f64)]) {
        let Some(&last) = corners.last() else {
            return;
        };
        let mut a = last;
        for &b in corners {
            let cross = a.0 * b.1 - b.0 * a.1;
            self.n += cross / 2.0;
            self.x += cross * (a.0 + b.0) / 6.0;
            self.y += cross * (a.1 + b.1) / 6.0;
            self.xx += cross * (a.0 * a.0 + a.0 * b.0 + b.0 * b.0) / 12.0;
            self.yy += cross * (a.1 * a.1 + a.1 * b.1 + b.1 * b.1) / 12.0;
            self.xy += cross * (2.0 * a.0 * a.1 + 2.0 * b.0 * b.1 + a.0 * b.1 + b.0 * a.1) / 24.0;
            a = b;
        }
    }

    fn take_pulls(&mut self, row: &[f64], (from, to): (usize, usize), x0: f64, y: f64) {
        for (k, pull) in row.iter().enumerate().take(to + 1).skip(from) {
            if *pull != 0.0 {
                let (x, square) = (k as f64 - x0, pull * pull);
                let terms = [1.0, x, y, x * x, x * y, y * y];
                for (sum, term) in self.pulls.iter_mut().zip(terms) {
                    *sum += square * term;
                }
            }
        }
    }

    fn surface(&self, (x0, y0): (f64, f64), body: f64) -> Option<Surface> {
        if self.n <= 0.0 {
            return None;
        }
        let (x, y) = (self.x / self.n, self.y / self.n);
        let [p, px, py, pxx, pxy, pyy] = self.pulls;
        // Area added at a place moves the middle towards it by its distance, over the area.
        let spread = |square: f64, first_a: f64, first_b: f64, a: f64, b: f64| {
            (square - b * first_a - a * first_b + a * b * p) / (self.n * self.n)
        };
        Some(Surface {
            x_px: x0 + x,
            y_px: y0 + y,
            unit_variances: [
                spread(pxx, px, px, x, x),
                spread(pyy, py, py, y, y),
                spread(pxy, px, py, x, y),
            ],
            area_px: self.n,
            moments_px2: [
                self.xx / self.n - x * x,
                self.xy / self.n - x * y,
                self.yy / self.n - y * y,
            ],
            body,
        })
    }
}
