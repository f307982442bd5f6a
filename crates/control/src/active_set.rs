//! Dual active-set solver (Goldfarb and Idnani, 1983) for the condensed QP of MPC, warm-started, without allocation.
//!
//! `min 1/2 w' H w + f' w` under `low <= a_i w <= high`. In the coordinates `z = L' w`, `H = L L'`, it is the
//! projection of `z_0 = -L^-1 f` on a polyhedron whose normals and their scalar products are known beforehand. The
//! working set of the previous tick is tried first; rows that depend on it (a slew row between two range rows) enter
//! through the dual step alone, so that dependence is no special case. Infeasibility is a result, not an error.
// Triangular solves read as their formulas with indices, and as a riddle with iterators.
#![allow(clippy::needless_range_loop)]

use nalgebra::DMatrix;
use std::time::Instant;

/// Variables: move blocks.
pub const VARS: usize = 12;
/// Two-sided rows: range, slew and field of view of each block.
pub const ROWS: usize = 36;
/// Bounds beyond this count as absent, um.
pub(crate) const ABSENT: f64 = 1e5;

const FEASIBLE: f64 = 1e-9;
const DEPENDENT: f64 = 1e-10;

/// A QP whose matrices do not change.
#[derive(Debug, Clone)]
pub struct QpMatrices {
    /// `H`, upper and lower.
    pub hessian: DMatrix<f64>,
    /// Rows `a_i`.
    pub rows: DMatrix<f64>,
    /// `L^-1`.
    inverse_factor: [[f64; VARS]; VARS],
    /// `L^-1 a_i`.
    normals: [[f64; VARS]; ROWS],
    /// Scalar products of the normals.
    gram: Box<[[f64; ROWS]; ROWS]>,
}

/// What changes from tick to tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct QpVectors {
    /// Linear term.
    pub linear: [f64; VARS],
    /// Lower bounds of the rows.
    pub low: [f64; ROWS],
    /// Upper bounds of the rows.
    pub high: [f64; ROWS],
}

/// Rows that hold with equality, with their side (+1 lower, -1 upper).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WorkingSet {
    rows: [usize; VARS],
    sides: [f64; VARS],
    multipliers: [f64; VARS],
    len: usize,
}

impl Default for WorkingSet {
    fn default() -> Self {
        Self {
            rows: [0; VARS],
            sides: [0.0; VARS],
            multipliers: [0.0; VARS],
            len: 0,
        }
    }
}

impl WorkingSet {
    /// Number of active rows.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether no row is active.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    fn remove(&mut self, at: usize) {
        for i in at..self.len.saturating_sub(1) {
            self.rows[i] = self.rows[i + 1];
            self.sides[i] = self.sides[i + 1];
            self.multipliers[i] = self.multipliers[i + 1];
        }
        self.len = self.len.saturating_sub(1);
    }

    fn push(&mut self, row: usize, side: f64, multiplier: f64) {
        if self.len < VARS {
            self.rows[self.len] = row;
            self.sides[self.len] = side;
            self.multipliers[self.len] = multiplier;
            self.len += 1;
        }
    }
}

/// How a solution ended.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum QpEnd {
    /// Optimal: the variables.
    Solved([f64; VARS]),
    /// No point keeps the bounds.
    Infeasible,
    /// Stopped before the end: where the solver was. The point need not keep the bounds.
    Stopped([f64; VARS]),
    /// Nothing usable.
    GaveUp,
}

/// When a solver has to stop.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Stop {
    /// At this time.
    pub deadline: Option<Instant>,
    /// After so many iterations: a recorded end again.
    pub iterations: Option<u16>,
}

impl Stop {
    fn is_met(&self, iterations: u16) -> bool {
        self.iterations.is_some_and(|most| iterations >= most)
            || self.deadline.is_some_and(|at| Instant::now() >= at)
    }
}

impl QpMatrices {
    /// Factors `H` and prepares the rows. `None` if `H` is not positive definite.
    ///
    /// # Panics
    /// If the shapes are not [`VARS`] and [`ROWS`].
    pub fn new(hessian: DMatrix<f64>, rows: DMatrix<f64>) -> Option<Self> {
        assert_eq!(
            (hessian.shape(), rows.shape()),
            ((VARS, VARS), (ROWS, VARS))
        );
        let factor = hessian.clone().cholesky()?.l();
        let inverse = factor.try_inverse()?;
        let transformed = &rows * inverse.transpose();
        let products = &transformed * transformed.transpose();
        let mut gram = Box::new([[0.0; ROWS]; ROWS]);
        for i in 0..ROWS {
            for j in 0..ROWS {
                gram[i][j] = products[(i, j)];
            }
        }
        Some(Self {
            inverse_factor: std::array::from_fn(|i| std::array::from_fn(|j| inverse[(i, j)])),
            normals: std::array::from_fn(|i| std::array::from_fn(|j| transformed[(i, j)])),
            gram,
            hessian,
            rows,
        })
    }

    /// The variables without constraints are `-H^-1 f`; this is that matrix product for a matrix of linear terms.
    pub fn unconstrained(&self, linear: &DMatrix<f64>) -> Option<DMatrix<f64>> {
        self.hessian.clone().cholesky().map(|c| -c.solve(linear))
    }

    fn along(&self, row: usize, z: &[f64; VARS]) -> f64 {
        self.normals[row].iter().zip(z).map(|(n, z)| n * z).sum()
    }

    /// Solves `G x = b` on the working set by Cholesky; false if the rows are dependent.
    fn solve_gram(&self, set: &WorkingSet, b: &mut [f64; VARS]) -> bool {
        let mut l = [[0.0; VARS]; VARS];
        for i in 0..set.len {
            for j in 0..=i {
                let mut sum = set.sides[i] * set.sides[j] * self.gram[set.rows[i]][set.rows[j]];
                for k in 0..j {
                    sum -= l[i][k] * l[j][k];
                }
                if i == j {
                    let scale = self.gram[set.rows[i]][set.rows[i]];
                    if sum <= DEPENDENT * scale {
                        return false;
                    }
                    l[i][i] = sum.sqrt();
                } else {
                    l[i][j] = sum / l[j][j];
                }
            }
        }
        for i in 0..set.len {
            let mut sum = b[i];
            for k in 0..i {
                sum -= l[i][k] * b[k];
            }
            b[i] = sum / l[i][i];
        }
        for i in (0..set.len).rev() {
            let mut sum = b[i];
            for k in i + 1..set.len {
                sum -= l[k][i] * b[k];
            }
            b[i] = sum / l[i][i];
        }
        true
    }

    /// The point with the working set's rows at their bounds; drops rows until no multiplier is negative.
    fn warm(&self, v: &QpVectors, set: &mut WorkingSet, z0: &[f64; VARS]) -> [f64; VARS] {
        let absent = |i: usize, set: &WorkingSet| {
            let (row, side) = (set.rows[i], set.sides[i]);
            let bound = if side > 0.0 { v.low[row] } else { v.high[row] };
            bound.abs() >= ABSENT
        };
        while let Some(i) = (0..set.len).find(|&i| absent(i, set)) {
            set.remove(i);
        }
        while set.len > 0 {
            let mut lambda = [0.0; VARS];
            for i in 0..set.len {
                let (row, side) = (set.rows[i], set.sides[i]);
                let bound = if side > 0.0 { v.low[row] } else { v.high[row] };
                lambda[i] = side * (bound - self.along(row, z0));
            }
            if !self.solve_gram(set, &mut lambda) {
                set.len -= 1;
                continue;
            }
            let worst = (0..set.len)
                .min_by(|&i, &j| lambda[i].total_cmp(&lambda[j]))
                .unwrap_or(0);
            if lambda[worst] < 0.0 {
                set.remove(worst);
                continue;
            }
            set.multipliers = lambda;
            break;
        }
        let mut z = *z0;
        for i in 0..set.len {
            for (z, n) in z.iter_mut().zip(&self.normals[set.rows[i]]) {
                *z += set.multipliers[i] * set.sides[i] * n;
            }
        }
        z
    }

    /// The row that `z` violates most (in units of its normal), its side and by how much.
    fn most_violated(&self, v: &QpVectors, z: &[f64; VARS]) -> Option<(usize, f64, f64)> {
        let mut worst: Option<(usize, f64, f64)> = None;
        let mut largest = 0.0;
        for row in 0..ROWS {
            let at = self.along(row, z);
            for (side, by, bound) in [
                (1.0, v.low[row] - at, v.low[row]),
                (-1.0, at - v.high[row], v.high[row]),
            ] {
                let scaled = by / self.gram[row][row].sqrt().max(1e-300);
                if bound.abs() < ABSENT && by > FEASIBLE * (1.0 + bound.abs()) && scaled > largest {
                    largest = scaled;
                    worst = Some((row, side, by));
                }
            }
        }
        worst
    }

    /// Solves, starting from a working set (that of the previous tick, or empty) and leaving the final one in it.
    /// Gives the end and the number of iterations.
    pub fn solve(&self, v: &QpVectors, set: &mut WorkingSet, stop: Stop) -> (QpEnd, u16) {
        const MOST: u16 = 200;
        let mut z = self.warm(v, set, &self.unconstrained_point(v));
        let mut iterations = 0;
        while let Some((row, side, _)) = self.most_violated(v, &z) {
            let mut multiplier = 0.0;
            loop {
                if iterations >= MOST || stop.is_met(iterations) {
                    *set = WorkingSet::default();
                    return (QpEnd::Stopped(self.variables(&z)), iterations);
                }
                iterations += 1;
                let bound = if side > 0.0 { v.low[row] } else { v.high[row] };
                let by = side * (bound - self.along(row, &z));
                let mut r = [0.0; VARS];
                for i in 0..set.len {
                    r[i] = side * set.sides[i] * self.gram[row][set.rows[i]];
                }
                if !self.solve_gram(set, &mut r) {
                    *set = WorkingSet::default();
                    return (QpEnd::GaveUp, iterations);
                }
                // Primal direction: the new normal less its part in the span of the working set.
                let mut direction: [f64; VARS] =
                    std::array::from_fn(|k| side * self.normals[row][k]);
                for i in 0..set.len {
                    for (d, n) in direction.iter_mut().zip(&self.normals[set.rows[i]]) {
                        *d -= r[i] * set.sides[i] * n;
                    }
                }
                let length2: f64 = direction.iter().map(|d| d * d).sum();
                let dependent = set.len >= VARS || length2 <= DEPENDENT * self.gram[row][row];
                let full = if dependent {
                    f64::INFINITY
                } else {
                    by / length2
                };
                let mut partial = f64::INFINITY;
                let mut blocking = None;
                for i in 0..set.len {
                    if r[i] > 1e-14 && set.multipliers[i] / r[i] < partial {
                        partial = set.multipliers[i] / r[i];
                        blocking = Some(i);
                    }
                }
                let step = full.min(partial);
                if step.is_infinite() {
                    return (QpEnd::Infeasible, iterations);
                }
                for i in 0..set.len {
                    set.multipliers[i] -= step * r[i];
                }
                multiplier += step;
                if !dependent {
                    for (z, d) in z.iter_mut().zip(&direction) {
                        *z += step * d;
                    }
                }
                if full <= partial {
                    set.push(row, side, multiplier);
                    break;
                }
                if let Some(i) = blocking {
                    set.remove(i);
                }
            }
        }
        (QpEnd::Solved(self.variables(&z)), iterations)
    }

    /// `z_0 = -L^-1 f`: the optimum without rows, in the transformed coordinates.
    fn unconstrained_point(&self, v: &QpVectors) -> [f64; VARS] {
        std::array::from_fn(|i| {
            let row = &self.inverse_factor[i];
            -row.iter().zip(&v.linear).map(|(l, f)| l * f).sum::<f64>()
        })
    }

    /// `w = L'^-1 z`.
    fn variables(&self, z: &[f64; VARS]) -> [f64; VARS] {
        let mut w = [0.0; VARS];
        for (row, z) in self.inverse_factor.iter().zip(z) {
            for (w, l) in w.iter_mut().zip(row) {
                *w += l * z;
            }
        }
        w
    }

    /// The optimum without rows, and whether it keeps them all: then it is the solution, and there is nothing to solve.
    pub fn without_rows(&self, v: &QpVectors) -> ([f64; VARS], bool) {
        let z = self.unconstrained_point(v);
        (self.variables(&z), self.most_violated(v, &z).is_none())
    }
}
