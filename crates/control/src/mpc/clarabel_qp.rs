//! The condensed QP by clarabel, set up once: a tick updates the vectors in place.

use crate::active_set::{QpEnd, QpMatrices, QpVectors, ROWS, VARS};
use crate::error::BuildError;
use clarabel::algebra::CscMatrix;
use clarabel::solver::{
    DefaultSettingsBuilder, DefaultSolver, IPSolver, SolverStatus, SupportedConeT,
};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

const FAILED: BuildError = BuildError::NoConvergence {
    what: "the set-up of clarabel",
};

/// A solver for one pair of matrices.
pub(crate) struct ClarabelQp {
    solver: DefaultSolver<f64>,
    linear: Vec<f64>,
    bounds: Vec<f64>,
    /// Deadline in nanoseconds after `epoch`; `u64::MAX`: none. clarabel's own time limit counts the time of all
    /// solves together when a solver is reused.
    deadline_ns: Arc<AtomicU64>,
    epoch: Instant,
}

impl std::fmt::Debug for ClarabelQp {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ClarabelQp").finish_non_exhaustive()
    }
}

impl ClarabelQp {
    pub(crate) fn new(matrices: &QpMatrices) -> Result<Self, BuildError> {
        let columns =
            |rows: usize, keep: &dyn Fn(usize, usize) -> bool, at: &dyn Fn(usize, usize) -> f64| {
                let (mut starts, mut indices, mut values) = (vec![0], Vec::new(), Vec::new());
                for j in 0..VARS {
                    for i in 0..rows {
                        if keep(i, j) {
                            indices.push(i);
                            values.push(at(i, j));
                        }
                    }
                    starts.push(indices.len());
                }
                CscMatrix::new(rows, VARS, starts, indices, values)
            };
        let p = columns(VARS, &|i, j| i <= j, &|i, j| matrices.hessian[(i, j)]);
        let row = |i: usize, j: usize| {
            let (sign, i) = if i < ROWS { (1.0, i) } else { (-1.0, i - ROWS) };
            sign * matrices.rows[(i, j)]
        };
        let a = columns(2 * ROWS, &|i, j| row(i, j) != 0.0, &row);
        let settings = DefaultSettingsBuilder::default()
            .verbose(false)
            .presolve_enable(false)
            .max_iter(60)
            .build()
            .map_err(|_| FAILED)?;
        let cones = [SupportedConeT::NonnegativeConeT(2 * ROWS)];
        let (linear, bounds) = (vec![0.0; VARS], vec![1.0; 2 * ROWS]);
        let mut solver =
            DefaultSolver::new(&p, &linear, &a, &bounds, &cones, settings).map_err(|_| FAILED)?;
        if !solver.is_data_update_allowed() {
            return Err(FAILED);
        }
        let deadline_ns = Arc::new(AtomicU64::new(u64::MAX));
        let epoch = Instant::now();
        let limit = Arc::clone(&deadline_ns);
        solver.set_termination_callback(move |_: &clarabel::solver::DefaultInfo<f64>| {
            let limit = limit.load(Ordering::Relaxed);
            limit != u64::MAX && epoch.elapsed().as_nanos() >= u128::from(limit)
        });
        Ok(Self {
            solver,
            linear,
            bounds,
            deadline_ns,
            epoch,
        })
    }

    /// Solves; gives the end, the iterations and the number of active rows.
    pub(crate) fn solve(&mut self, v: &QpVectors, deadline: Option<Instant>) -> (QpEnd, u16, u16) {
        self.linear.copy_from_slice(&v.linear);
        for row in 0..ROWS {
            self.bounds[row] = v.high[row];
            self.bounds[ROWS + row] = -v.low[row];
        }
        let limit = deadline.map_or(u64::MAX, |at| {
            u64::try_from(at.saturating_duration_since(self.epoch).as_nanos()).unwrap_or(u64::MAX)
        });
        self.deadline_ns.store(limit, Ordering::Relaxed);
        if self.solver.update_q(&self.linear).is_err()
            || self.solver.update_b(&self.bounds).is_err()
        {
            return (QpEnd::GaveUp, 0, 0);
        }
        self.solver.solve();
        let solution = &self.solver.solution;
        let iterations = u16::try_from(solution.iterations).unwrap_or(u16::MAX);
        let end = match solution.status {
            SolverStatus::Solved | SolverStatus::AlmostSolved
                if solution.x.iter().all(|x| x.is_finite()) =>
            {
                let mut w = [0.0; VARS];
                for (w, x) in w.iter_mut().zip(&solution.x) {
                    *w = *x;
                }
                QpEnd::Solved(w)
            }
            SolverStatus::PrimalInfeasible | SolverStatus::AlmostPrimalInfeasible => {
                QpEnd::Infeasible
            }
            _ => QpEnd::GaveUp,
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
