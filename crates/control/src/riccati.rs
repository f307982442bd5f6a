//! Discrete algebraic Riccati equation by structured doubling.
//!
//! `X = A' X A - A' X B (R + B' X B)^-1 B' X A + Q`, written with `G = B R^-1 B'`. Each step doubles the horizon, so
//! about ten steps reach machine precision for any stabilisable and detectable problem (Chu, Fan, Lin, Wang, 2004).

use crate::error::BuildError;
use nalgebra::{DMatrix, DVector};

/// Solves `X = A' X (I + G X)^-1 A + Q` for the stabilising X.
///
/// # Errors
/// [`BuildError::NoConvergence`] when the problem is not stabilisable and detectable.
pub fn solve_dare(
    a: &DMatrix<f64>,
    g: &DMatrix<f64>,
    q: &DMatrix<f64>,
) -> Result<DMatrix<f64>, BuildError> {
    const FAILED: BuildError = BuildError::NoConvergence {
        what: "the Riccati equation",
    };
    let n = a.nrows();
    let identity = DMatrix::<f64>::identity(n, n);
    let (mut a, mut g, mut h) = (a.clone(), g.clone(), q.clone());
    for _ in 0..60 {
        let w = (&identity + &g * &h).lu();
        let wa = w.solve(&a).ok_or(FAILED)?;
        let wg = w.solve(&g).ok_or(FAILED)?;
        let h_next = &h + a.transpose() * &h * &wa;
        let g_next = &g + &a * wg * a.transpose();
        let a_next = &a * wa;
        let change = (&h_next - &h).norm();
        h = (&h_next + h_next.transpose()) * 0.5;
        g = (&g_next + g_next.transpose()) * 0.5;
        a = a_next;
        if !h.norm().is_finite() {
            return Err(FAILED);
        }
        if change <= 1e-14 * h.norm() {
            return Ok(h);
        }
    }
    Err(FAILED)
}

/// LQ feedback `u = -F x` for `x' = A x + B u` and the cost `sum x' Q x + r u^2`. Returns `(F, X)`.
///
/// # Errors
/// [`BuildError::NoConvergence`].
pub fn lq_feedback(
    a: &DMatrix<f64>,
    b: &DVector<f64>,
    q: &DMatrix<f64>,
    r: f64,
) -> Result<(DVector<f64>, DMatrix<f64>), BuildError> {
    let x = solve_dare(a, &(b * b.transpose() / r), q)?;
    let xb = &x * b;
    let f = (a.transpose() * &xb) / (r + b.dot(&xb));
    Ok((f, x))
}

/// Steady-state Kalman gain `K` (of the filtered estimate) for `x' = A x + w`, `y = c x + v`.
///
/// # Errors
/// [`BuildError::NoConvergence`].
pub fn kalman_gain(
    a: &DMatrix<f64>,
    c: &DVector<f64>,
    q: &DMatrix<f64>,
    r: f64,
) -> Result<DVector<f64>, BuildError> {
    let prior = solve_dare(&a.transpose(), &(c * c.transpose() / r), q)?;
    let pc = &prior * c;
    Ok(&pc / (r + c.dot(&pc)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_scalar_random_walk_has_the_closed_form_gain() {
        let (q, r): (f64, f64) = (6.6e-4, 4e-4);
        let one = DMatrix::from_element(1, 1, 1.0);
        let gain = kalman_gain(&one, &DVector::from_element(1, 1.0), &(&one * q), r).unwrap();
        let posterior = crate::design::kalman_posterior_um2(q, r);
        assert!((gain[0] - posterior / r).abs() < 1e-12);
    }

    #[test]
    fn the_solution_satisfies_the_riccati_equation_and_stabilises() {
        let a = DMatrix::from_row_slice(3, 3, &[1.0, 0.3, 0.0, 0.0, 1.0, 0.2, 0.1, 0.0, 0.9]);
        let b = DVector::from_vec(vec![0.1, 0.0, 0.4]);
        let q = DMatrix::from_diagonal(&DVector::from_vec(vec![1.0, 0.0, 0.1]));
        let r = 0.3;
        let (f, x) = lq_feedback(&a, &b, &q, r).unwrap();
        let residual = a.transpose() * &x * &a + &q
            - (a.transpose() * &x * &b) * (b.transpose() * &x * &a) / (r + b.dot(&(&x * &b)))
            - &x;
        assert!(residual.norm() < 1e-9 * x.norm(), "{}", residual.norm());
        let closed = &a - &b * f.transpose();
        assert!(closed.complex_eigenvalues().iter().all(|v| v.norm() < 1.0));
    }

    #[test]
    fn a_problem_that_cannot_be_stabilised_is_refused() {
        let a = DMatrix::from_diagonal(&DVector::from_vec(vec![2.0, 0.5]));
        let b = DVector::from_vec(vec![0.0, 1.0]);
        let q = DMatrix::identity(2, 2);
        assert!(lq_feedback(&a, &b, &q, 1.0).is_err());
    }
}
