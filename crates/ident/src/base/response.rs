//! The responses that a fit combines: each power of s over the denominator, driven by a record's input, and the response to each start.

use crate::analogue::{between, means};
use crate::sampled::Hold;
use nalgebra::DMatrix;

/// Steps between two rows if the input is sampled and not held.
const FINE: usize = 4;

/// An input on the grid on which it is constant from step to step.
#[derive(Debug, Clone)]
pub struct Grid {
    /// Value in each step, the input's unit.
    pub held: Vec<f64>,
    /// Value at the end of each step, which a direct path shows.
    end: Vec<f64>,
    /// Steps between two rows.
    pub steps: usize,
}

impl Grid {
    /// The grid of an input, one value a row. A held input is its own grid. In the steps of an analogue one stands its mean, or, if the
    /// plant has a direct path, its value at the end.
    pub fn new(input: &[f64], hold: Hold, direct: bool) -> Self {
        if hold == Hold::ZeroOrder {
            return Self {
                held: input.to_vec(),
                end: input.to_vec(),
                steps: 1,
            };
        }
        let end = between(input, FINE);
        let mut held = end.clone();
        if !direct {
            means(&mut held);
        }
        Self {
            held,
            end,
            steps: FINE,
        }
    }

    /// The grid from a row on, `rows` long.
    pub(super) fn part(&self, from: usize, rows: usize) -> Self {
        let range = from * self.steps..(from + rows) * self.steps;
        Self {
            held: self.held[range.clone()].to_vec(),
            end: self.end[range].to_vec(),
            steps: self.steps,
        }
    }

    fn rows(&self) -> usize {
        self.held.len() / self.steps
    }
}

/// Responses at the rows: `s^i / A(s)` for i below the order, then the input itself as a direct path shows it.
pub(super) fn driven(denominator: &[f64], delay: f64, grid: &Grid) -> Vec<Vec<f64>> {
    let n = denominator.len() - 1;
    let h = 1.0 / grid.steps as f64;
    let late = delay.max(0.0) * grid.steps as f64;
    let whole = late.floor();
    let part = late - whole;
    let whole = whole as usize;
    let (full, before) = steps(denominator, h, part);
    let rows = grid.rows();
    let mut out = vec![Vec::with_capacity(rows); n + 1];
    let first = grid.held.first().copied().unwrap_or(0.0);
    let late_by =
        |values: &[f64], j: usize, shift: usize| j.checked_sub(shift).map_or(first, |i| values[i]);
    let (mut z, mut next) = (vec![0.0; n], vec![0.0; n]);
    for j in 0..rows * grid.steps {
        if j % grid.steps == 0 {
            for (column, z) in out.iter_mut().zip(&z) {
                column.push(*z);
            }
            out[n].push(match grid.steps {
                1 => late_by(&grid.end, j, whole + 1),
                _ => smooth(&grid.end, (j as f64 - 1.0 - late).max(0.0)),
            });
        }
        let (v1, v2) = (
            late_by(&grid.held, j, whole + 1),
            late_by(&grid.held, j, whole),
        );
        for (i, next) in next.iter_mut().enumerate() {
            *next = full
                .free
                .row(i)
                .iter()
                .zip(&z)
                .map(|(a, z)| a * z)
                .sum::<f64>()
                + before[i] * v1
                + full.driven[i] * v2;
        }
        std::mem::swap(&mut z, &mut next);
    }
    out
}

/// A smooth signal at a place on its grid: the cubic through the values on both sides whose slopes there are those of their neighbours.
fn smooth(values: &[f64], at: f64) -> f64 {
    let last = values.len().saturating_sub(1);
    let (i, f) = (at as usize, at.fract());
    let v = |k: usize| values.get(k.min(last)).copied().unwrap_or(0.0);
    let (a, b, c, d) = (v(i.saturating_sub(1)), v(i), v(i + 1), v(i + 2));
    let (up, down) = (0.5 * (c - a), 0.5 * (d - b));
    let bend = f * (1.0 - f) * ((1.0 - f) * (up - c + b) - f * (down - c + b));
    b + f * (c - b) + bend
}

/// Responses at the rows if one state starts at 1, for each state.
pub(super) fn free(denominator: &[f64], rows: usize) -> Vec<Vec<f64>> {
    let n = denominator.len() - 1;
    let a = transition(denominator, 1.0).free;
    let mut at = DMatrix::<f64>::identity(n, n);
    let mut out = vec![Vec::with_capacity(rows); n];
    for _ in 0..rows {
        for (i, column) in out.iter_mut().enumerate() {
            column.push(at[(0, i)]);
        }
        at = &at * &a;
    }
    out
}

struct Step {
    free: DMatrix<f64>,
    driven: Vec<f64>,
}

/// One step of length `h` whose input changes at the fraction `part` of the step: responses to the later and to the earlier value.
fn steps(denominator: &[f64], h: f64, part: f64) -> (Step, Vec<f64>) {
    let early = transition(denominator, part * h);
    let late = transition(denominator, (1.0 - part) * h);
    let n = denominator.len() - 1;
    let before = (0..n)
        .map(|i| (0..n).map(|j| late.free[(i, j)] * early.driven[j]).sum())
        .collect();
    let free = &late.free * &early.free;
    (
        Step {
            free,
            driven: late.driven,
        },
        before,
    )
}

/// The companion form of `1/A(s)` over a time, and its response to a held one.
fn transition(denominator: &[f64], h: f64) -> Step {
    let n = denominator.len() - 1;
    let mut a = DMatrix::zeros(n + 1, n + 1);
    for i in 1..n {
        a[(i - 1, i)] = h;
    }
    for j in 0..n {
        a[(n - 1, j)] = -denominator[n - j] * h;
    }
    if n > 0 {
        a[(n - 1, n)] = h;
    }
    let e = a.exp();
    Step {
        free: e.view((0, 0), (n, n)).into_owned(),
        driven: (0..n).map(|i| e[(i, n)]).collect(),
    }
}
