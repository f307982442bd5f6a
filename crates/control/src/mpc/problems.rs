//! The problems of a loop, and how long each solver takes for them: for comparison with other solvers.

use super::law::MpcLaw;
use crate::active_set::{QpEnd, QpMatrices, QpVectors, Stop};
use crate::law::{ControlLaw, LawInput};
use crate::lqg::deviation;
use std::time::{Duration, Instant};

/// A solved problem.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TimedSolve {
    /// How long it took.
    pub took: Duration,
    /// Iterations.
    pub iterations: u16,
    /// First move: correction of the command of this tick, um; `None` where there is no solution.
    pub first_um: Option<f64>,
}

impl MpcLaw {
    /// The matrices of every problem of this law.
    pub fn matrices(&self) -> &QpMatrices {
        &self.condensed.matrices
    }

    /// The problem that [`ControlLaw::step`] would solve now.
    pub fn problem(&self, input: &LawInput) -> QpVectors {
        let reference = self.reference_plan(input);
        let deviation = deviation(&input.estimate.now, &input.on_path);
        self.vectors(input, &deviation, &reference)
    }

    /// Solves problems one after another with the law's solver, as a loop would: warm, without a deadline.
    pub fn solve_timed(&self, problems: &[QpVectors]) -> Vec<TimedSolve> {
        let mut state = self.start(0.0);
        problems
            .iter()
            .map(|problem| {
                let from = Instant::now();
                let (end, iterations, _) = self.solve(&mut state, problem, Stop::default());
                TimedSolve {
                    took: from.elapsed(),
                    iterations,
                    first_um: match end {
                        QpEnd::Solved(w) => Some(w[0]),
                        _ => None,
                    },
                }
            })
            .collect()
    }
}
