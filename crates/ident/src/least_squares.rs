//! Non-linear least squares with a numerical Jacobian, and the covariance that it implies.
//!
//! A thin layer over the MINPACK-style Levenberg-Marquardt of the `levenberg-marquardt` crate. Residuals are expected
//! to be divided by their standard deviations, so that the sum of squares is a chi-squared and the covariance is the
//! inverse of `J^T J`. Not for problems with constraints: choose parameters that need none (logarithms).

use levenberg_marquardt::{LeastSquaresProblem, LevenbergMarquardt, TerminationReason};
use nalgebra::{DMatrix, DVector, Dyn, Owned};

/// A minimum of a sum of squares.
#[derive(Debug, Clone, PartialEq)]
pub struct Minimum {
    /// Parameters at the minimum.
    pub parameters: Vec<f64>,
    /// Sum of squared residuals there.
    pub chi2: f64,
    /// Jacobian of the residuals there.
    pub jacobian: DMatrix<f64>,
    /// Whether the iteration met a convergence test.
    pub converged: bool,
}

struct Problem<'a, F: Fn(&[f64], &mut [f64])> {
    residuals: &'a F,
    rows: usize,
    x: DVector<f64>,
    steps: &'a [f64],
}

impl<F: Fn(&[f64], &mut [f64])> Problem<'_, F> {
    fn evaluate(&self, x: &[f64]) -> DVector<f64> {
        let mut out = DVector::zeros(self.rows);
        (self.residuals)(x, out.as_mut_slice());
        out
    }

    /// Central differences. If the residuals jump within a step (a delay that crosses a whole sample moves the
    /// feedthrough to the next row), it takes the difference on the smooth side.
    fn differences(&self) -> DMatrix<f64> {
        let mut j = DMatrix::zeros(self.rows, self.x.len());
        let here = self.evaluate(self.x.as_slice());
        let mut x = self.x.clone();
        for (i, step) in self.steps.iter().enumerate() {
            let centre = x[i];
            x[i] = centre + step;
            let forward = (self.evaluate(x.as_slice()) - &here) / *step;
            x[i] = centre - step;
            let backward = (&here - self.evaluate(x.as_slice())) / *step;
            x[i] = centre;
            let (f, b) = (forward.norm(), backward.norm());
            let column = if f > 3.0 * b {
                backward
            } else if b > 3.0 * f {
                forward
            } else {
                (forward + backward) * 0.5
            };
            j.set_column(i, &column);
        }
        j
    }
}

impl<F: Fn(&[f64], &mut [f64])> LeastSquaresProblem<f64, Dyn, Dyn> for Problem<'_, F> {
    type ParameterStorage = Owned<f64, Dyn>;
    type ResidualStorage = Owned<f64, Dyn>;
    type JacobianStorage = Owned<f64, Dyn, Dyn>;

    fn set_params(&mut self, x: &DVector<f64>) {
        self.x.copy_from(x);
    }

    fn params(&self) -> DVector<f64> {
        self.x.clone()
    }

    fn residuals(&self) -> Option<DVector<f64>> {
        // A point without a value counts as worse than any other, so the solver shortens the step.
        let worst = 1e100;
        Some(
            self.evaluate(self.x.as_slice())
                .map(|v| if v.is_finite() { v } else { worst }),
        )
    }

    fn jacobian(&self) -> Option<DMatrix<f64>> {
        let j = self.differences();
        j.iter().all(|v| v.is_finite()).then_some(j)
    }
}

/// Minimises the sum of squares of `rows` residuals from `start`; `steps` are the finite differences per parameter.
pub fn minimise<F: Fn(&[f64], &mut [f64])>(
    start: &[f64],
    steps: &[f64],
    rows: usize,
    residuals: F,
) -> Minimum {
    let problem = Problem {
        residuals: &residuals,
        rows,
        x: DVector::from_column_slice(start),
        steps,
    };
    let (problem, report) = LevenbergMarquardt::new()
        .with_ftol(1e-12)
        .with_xtol(1e-10)
        .with_gtol(1e-12)
        .with_patience(60)
        .minimize(problem);
    // A stop for lack of precision is at a minimum too; only too many evaluations and failed ones are not.
    let converged = match report.termination {
        TerminationReason::Converged { .. }
        | TerminationReason::ResidualsZero
        | TerminationReason::Orthogonal
        | TerminationReason::NoImprovementPossible(_) => true,
        TerminationReason::User(_)
        | TerminationReason::Numerical(_)
        | TerminationReason::NoParameters
        | TerminationReason::NoResiduals
        | TerminationReason::WrongDimensions(_)
        | TerminationReason::LostPatience => false,
    };
    let jacobian = problem.differences();
    let residual = problem.evaluate(problem.x.as_slice());
    Minimum {
        parameters: problem.x.as_slice().to_vec(),
        chi2: residual.norm_squared(),
        jacobian,
        converged,
    }
}

/// Inverse of `J^T J`, computed with scaled columns. Parameters in a direction that the data do not determine (relative
/// singular value below 1e-9) get an infinite variance.
pub fn covariance(jacobian: &DMatrix<f64>) -> DMatrix<f64> {
    let n = jacobian.ncols();
    let scales: Vec<f64> = (0..n).map(|i| jacobian.column(i).norm()).collect();
    let scaled = DMatrix::from_fn(n, n, |i, j| {
        let product = scales[i] * scales[j];
        if product > 0.0 {
            jacobian.column(i).dot(&jacobian.column(j)) / product
        } else {
            f64::from(u8::from(i == j))
        }
    });
    let eigen = scaled.symmetric_eigen();
    let mut out = DMatrix::zeros(n, n);
    for (value, vector) in eigen
        .eigenvalues
        .iter()
        .zip(eigen.eigenvectors.column_iter())
    {
        let seen = *value > 1e-14;
        for i in 0..n {
            for j in 0..n {
                let share = vector[i] * vector[j];
                if seen {
                    out[(i, j)] += share / value / (scales[i] * scales[j]).max(f64::MIN_POSITIVE);
                } else if i == j && share > 1e-4 {
                    out[(i, j)] = f64::INFINITY;
                }
            }
        }
    }
    for i in 0..n {
        if scales[i] == 0.0 {
            out[(i, i)] = f64::INFINITY;
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_straight_line_gets_the_textbook_covariance() {
        let t: Vec<f64> = (0..20).map(f64::from).collect();
        let found = minimise(&[0.0, 0.0], &[1e-4, 1e-4], 20, |x, r| {
            for (k, t) in t.iter().enumerate() {
                r[k] = (1.0 + 0.5 * t - x[0] - x[1] * t) / 0.1;
            }
        });
        assert!(found.converged && found.chi2 < 1e-12);
        let c = covariance(&found.jacobian);
        let n = 20.0;
        let sum: f64 = t.iter().sum();
        let squares: f64 = t.iter().map(|t| t * t).sum();
        let slope_variance = 0.01 * n / (n * squares - sum * sum);
        assert!((c[(1, 1)] / slope_variance - 1.0).abs() < 1e-6);
    }

    #[test]
    fn a_direction_that_the_data_do_not_see_has_infinite_variance() {
        let found = minimise(&[1.0, 1.0], &[1e-4, 1e-4], 5, |x, r| {
            for (k, r) in r.iter_mut().enumerate() {
                *r = (x[0] + x[1] - 3.0) * (k as f64 + 1.0);
            }
        });
        let c = covariance(&found.jacobian);
        assert!(c[(0, 0)].is_infinite() && c[(1, 1)].is_infinite());
    }
}
