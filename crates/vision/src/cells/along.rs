//! Changes of whole rows. A wall continues along the channel, a cell does not: a change that most of a row shares is the wall,
//! moved, out of focus or in another light.
//!
//! A straight line along the row covers a channel that has turned. It is drawn through two pieces of the row and must explain more
//! of the others than no change does. Those two do not count, because any two pieces have a line.

use super::background::Background;
use super::drift::MOST_PX;

/// Pieces of a row.
const PIECES: usize = 8;
/// Most pixels of a piece whose median is taken: the median of 16 has a third of a pixel's noise.
const SAMPLES: usize = 16;

/// What the pieces of a row differ by, in grey levels.
type Row = [f32; PIECES];

/// Value in the middle of a row, and slope from piece to piece.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Line {
    middle: f32,
    slope: f32,
}

/// Middle of the pieces.
const MIDDLE: f32 = 0.5 * (PIECES - 1) as f32;

impl Line {
    fn at(&self, piece: f32) -> f32 {
        self.middle + self.slope * (piece - MIDDLE)
    }

    fn through(row: &Row, (a, b): (usize, usize)) -> Self {
        let slope = (row[b] - row[a]) / (b as f32 - a as f32);
        Line {
            middle: row[a] + slope * (MIDDLE - a as f32),
            slope,
        }
    }

    /// Least squares of the pieces that are nearer than `most` to this line.
    fn refined(self, row: &Row, most: f32) -> Self {
        let (mut n, mut sx, mut sy, mut sxx, mut sxy) = (0.0, 0.0, 0.0, 0.0, 0.0);
        for (k, v) in row.iter().enumerate() {
            if (v - self.at(k as f32)).abs() < most {
                let x = k as f32 - MIDDLE;
                n += 1.0;
                sx += x;
                sy += v;
                sxx += x * x;
                sxy += x * v;
            }
        }
        let determinant: f32 = n * sxx - sx * sx;
        if determinant <= 0.0 {
            return self;
        }
        let slope = (n * sxy - sx * sy) / determinant;
        Line {
            middle: (sy - slope * sx) / n,
            slope,
        }
    }
}

/// The change of a whole row, if a line within `range` explains more of it than no change. A piece that differs by `most` is
/// unexplained.
fn line_of(row: &Row, most: f32, range: f32) -> Option<Line> {
    let unexplained = most * most;
    let cost = |of: &dyn Fn(usize) -> f32| -> f32 {
        let piece = |(k, v): (usize, &f32)| (v - of(k)).powi(2).min(unexplained);
        row.iter().enumerate().map(piece).sum()
    };
    let own = 2.0 * unexplained;
    let mut least = cost(&|_| 0.0);
    let mut best = None;
    // No line leaves less than its own two pieces.
    if least <= own {
        return None;
    }
    for a in 0..PIECES {
        for b in a + 1..PIECES {
            let line = Line::through(row, (a, b));
            let ends = line.middle.abs() + line.slope.abs() * MIDDLE;
            let left = own + cost(&|k| line.at(k as f32));
            if ends <= range && left < least {
                (least, best) = (left, Some(line));
            }
        }
    }
    best.map(|line| line.refined(row, most))
}

/// Medians of the pieces of a row.
fn medians(row: &[f32], length: usize) -> Row {
    let step = length.div_ceil(SAMPLES);
    let mut medians = [0.0; PIECES];
    for (median, piece) in medians.iter_mut().zip(row.chunks_exact(length)) {
        let mut values = [0.0_f32; SAMPLES];
        let mut count = 0;
        for (to, v) in values.iter_mut().zip(piece.iter().step_by(step)) {
            *to = *v;
            count += 1;
        }
        if let Some(values) = values.get_mut(..count) {
            let (_, middle, _) = values.select_nth_unstable_by(count / 2, f32::total_cmp);
            *median = *middle;
        }
    }
    medians
}

impl Background {
    /// Largest difference of the background's levels in the rows that a shift brings to row `y`: a wall that moves or blurs takes
    /// only levels near it.
    fn range_about(&self, y: usize) -> f32 {
        let (reach, levels) = (MOST_PX.ceil() as usize, &self.row_levels);
        let near = levels.get(y.saturating_sub(reach)..(y + reach + 1).min(levels.len()));
        let (low, high) = near
            .unwrap_or(&[])
            .iter()
            .fold((f32::INFINITY, f32::NEG_INFINITY), |(low, high), v| {
                (low.min(*v), high.max(*v))
            });
        (high - low).max(0.0)
    }

    /// Removes the changes of whole rows from a contrast. A piece of a row that differs by less than `most` (grey levels) does not
    /// stand out.
    pub(super) fn take_off_rows(&self, contrast: &mut [f32], most: f32) {
        let length = self.width / PIECES;
        if length < 2 {
            return;
        }
        let over = 1.0 / length as f32;
        for (y, row) in contrast.chunks_exact_mut(self.width).enumerate() {
            let range = self.range_about(y);
            if range <= most {
                continue;
            }
            if let Some(line) = line_of(&medians(row, length), most, range) {
                for (x, c) in row.iter_mut().enumerate() {
                    *c -= line.at((x as f32 + 0.5) * over - 0.5);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wall_that_turned_is_taken_off_and_a_cell_over_half_of_the_row_is_not() {
        let wall = |k: f32| 6.0 - 0.4 * k;
        let row: Row = core::array::from_fn(|k| wall(k as f32));
        let mut with_cell = row;
        with_cell[2] = -20.0;
        with_cell[3] = -25.0;
        for row in [row, with_cell] {
            let line = line_of(&row, 2.5, 30.0).unwrap();
            assert!((line.at(0.0) - 6.0).abs() < 1e-4 && (line.slope + 0.4).abs() < 1e-5);
        }
        let cell = [0.0, 0.3, -20.0, -20.5, -20.2, -20.1, 0.2, -0.1];
        assert_eq!(line_of(&cell, 2.5, 30.0), None);
        assert_eq!(line_of(&[0.5; PIECES], 2.5, 30.0), None);
    }
}
