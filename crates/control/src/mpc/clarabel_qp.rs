//! The condensed QP by clarabel, set up once: a tick updates the vectors in place.
//!
//! Rows that no problem of this loop can reach are left out, the cost is scaled by its largest curvature, and equilibration and
//! iterative refinement are off. On a problem of this size and scale they cost time and change nothing.

use crate::active_set::{QpEnd, QpMatrices, QpVectors, Stop, VARS};
use crate::error::BuildError;
use clarabel::algebra::CscMatrix;
use clarabel::solver::{
    DefaultInfo, DefaultSettingsBuilder, DefaultSolver, IPSolver, SolverStatus, SupportedConeT,
};
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering};
use std::time::Instant;

const FAILED: BuildError = BuildError::NoConvergence {
    what: "the set-up of clarabel",
};

/// Tolerance of gap and residuals: with [`CURVATURE`] 0.1 nm of a plan of some um.
const TOLERANCE: f64 = 1e-6;

/// Largest curvature of the cost as the solver sees it. The starting point of clarabel, and the balance of residuals and gap,
/// depend on it. Constrained problems of a loop take 13 iterations at 1 and 8 at 1e5 (at most 12). From 1e7 on they take more
/// again, some of them many.
const CURVATURE: f64 = 1e5;

/// One side of a row.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Side {
    pub row: usize,
    /// The upper bound; otherwise the lower.
    pub upper: bool,
}

/// Where a solve has to end; read by the solver after each iteration.
#[derive(Debug)]
struct Limit {
    /// Nanoseconds after `epoch`; `u64::MAX`: none. clarabel's own time limit counts the time of all solves together
    /// when a solver is reused.
    deadline_ns: AtomicU64,
    /// Iterations; `u32::MAX`: none.
    iterations: AtomicU32,
    epoch: Instant,
}

impl Limit {
    fn is_met(&self, iterations: u32) -> bool {
        let deadline = self.deadline_ns.load(Ordering::Relaxed);
        iterations >= self.iterations.load(Ordering::Relaxed)
            || (deadline != u64::MAX && self.epoch.elapsed().as_nanos() >= u128::from(deadline))
    }
}

/// A solver for one pair of matrices.
pub(super) struct ClarabelQp {
    solver: DefaultSolver<f64>,
    sides: Vec<Side>,
    scale: f64,
    linear: Vec<f64>,
    bounds: Vec<f64>,
    limit: Arc<Limit>,
}

impl std::fmt::Debug for ClarabelQp {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ClarabelQp").finish_non_exhaustive()
    }
}

impl ClarabelQp {
    /// A solver for the rows of `sides`.
    pub(super) fn new(matrices: &QpMatrices, sides: Vec<Side>) -> Result<Self, BuildError> {
        let columns =
            |rows: usize, keep: &dyn Fn(usize, usize) -> bool, at: &dyn Fn(usize, usize) -> f64| {
                let (mut starts, mut indices, mut values) = (vec![0], Vec::new(), Vec::new());
                for j in 0..VARS {
                    for i in (0..rows).filter(|&i| keep(i, j)) {
                        indices.push(i);
                        values.push(at(i, j));
                    }
                    starts.push(indices.len());
                }
                CscMatrix::new(rows, VARS, starts, indices, values)
            };
        let scale = CURVATURE / matrices.hessian.diagonal().max().max(f64::MIN_POSITIVE);
        let p = columns(VARS, &|i, j| i <= j, &|i, j| {
            scale * matrices.hessian[(i, j)]
        });
        let count = sides.len();
        let signed = |i: usize, j: usize| {
            let Side { row, upper } = sides[i];
            let value = matrices.rows[(row, j)];
            if upper { value } else { -value }
        };
        let a = columns(count, &|i, j| signed(i, j) != 0.0, &signed);
        let settings = DefaultSettingsBuilder::default()
            .verbose(false)
            .presolve_enable(false)
            .equilibrate_enable(false)
            .iterative_refinement_enable(false)
            .tol_gap_abs(TOLERANCE)
            .tol_gap_rel(TOLERANCE)
            .tol_feas(TOLERANCE)
            .max_iter(60)
            .build()
            .map_err(|_| FAILED)?;
        let cones = [SupportedConeT::NonnegativeConeT(count)];
        let (linear, bounds) = (vec![0.0; VARS], vec![1.0; count]);
        let mut solver =
            DefaultSolver::new(&p, &linear, &a, &bounds, &cones, settings).map_err(|_| FAILED)?;
        if !solver.is_data_update_allowed() {
            return Err(FAILED);
        }
        let limit = Arc::new(Limit {
            deadline_ns: AtomicU64::new(u64::MAX),
            iterations: AtomicU32::new(u32::MAX),
            epoch: Instant::now(),
        });
        let told = Arc::clone(&limit);
        solver
            .set_termination_callback(move |info: &DefaultInfo<f64>| told.is_met(info.iterations));
        Ok(Self {
            solver,
            sides,
            scale,
            linear,
            bounds,
            limit,
        })
    }

    /// Solves; gives the end, the iterations and the number of active rows.
    pub(super) fn solve(&mut self, v: &QpVectors, stop: Stop) -> (QpEnd, u16, u16) {
        for (slot, value) in self.linear.iter_mut().zip(&v.linear) {
            *slot = self.scale * value;
        }
        for (slot, Side { row, upper }) in self.bounds.iter_mut().zip(&self.sides) {
            *slot = if *upper { v.high[*row] } else { -v.low[*row] };
        }
        let deadline = stop.deadline.map_or(u64::MAX, |at| {
            let after = at.saturating_duration_since(self.limit.epoch);
            u64::try_from(after.as_nanos()).unwrap_or(u64::MAX)
        });
        self.limit.deadline_ns.store(deadline, Ordering::Relaxed);
        let iterations = stop.iterations.map_or(u32::MAX, u32::from);
        self.limit.iterations.store(iterations, Ordering::Relaxed);
        if self.solver.update_q(&self.linear).is_err()
            || self.solver.update_b(&self.bounds).is_err()
        {
            return (QpEnd::GaveUp, 0, 0);
        }
        self.solver.solve();
        let solution = &self.solver.solution;
        let iterations = u16::try_from(solution.iterations).unwrap_or(u16::MAX);
        let mut w = [0.0; VARS];
        for (w, x) in w.iter_mut().zip(&solution.x) {
            *w = *x;
        }
        let end = match solution.status {
            SolverStatus::PrimalInfeasible | SolverStatus::AlmostPrimalInfeasible => {
                QpEnd::Infeasible
            }
            _ if w.iter().any(|w| !w.is_finite()) => QpEnd::GaveUp,
            SolverStatus::Solved | SolverStatus::AlmostSolved => QpEnd::Solved(w),
            _ => QpEnd::Stopped(w),
        };
        // A row counts as active where its multiplier outweighs its slack.
        let active = solution
            .z
            .iter()
            .zip(&solution.s)
            .filter(|(z, s)| z > s)
            .count();
        (end, iterations, u16::try_from(active).unwrap_or(u16::MAX))
    }
}
