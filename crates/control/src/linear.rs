//! Linear equivalents of the control laws, for frequency responses and noise variances.
//!
//! Every law is, without limits, `u = C_r(z) r - C(z) y`; only the feedback part `C` decides margins and noise.

use crate::pi::Pi;
use nalgebra::{Complex, DMatrix, DVector, RowDVector};

/// The feedback part of a control law: input bead position y (um), output PZT displacement (um).
#[derive(Debug, Clone, PartialEq)]
pub enum LinearLaw {
    /// PI with or without lead, as stepped by the loop.
    Pi {
        /// Gains.
        pi: Pi,
        /// Sample time, s.
        sample_time_s: f64,
    },
    /// `x' = A x + B y`, `u = -(C x + D y)`.
    StateSpace {
        /// n x n.
        a: DMatrix<f64>,
        /// n x 1.
        b: DVector<f64>,
        /// 1 x n.
        c: RowDVector<f64>,
        /// Direct part.
        d: f64,
    },
}

impl LinearLaw {
    /// `C(z)`.
    pub fn at(&self, z: Complex<f64>) -> Complex<f64> {
        match self {
            Self::Pi { pi, sample_time_s } => {
                let lead = pi.lead.map_or(Complex::new(1.0, 0.0), |lead| {
                    let (b0, b1, a1) = lead.coefficients(*sample_time_s);
                    let w = z.inv();
                    (w * b1 + b0) / (w * a1 + 1.0)
                });
                lead * pi.kp + (z + 1.0) / (z - 1.0) * (0.5 * pi.ki_per_s * sample_time_s)
            }
            Self::StateSpace { a, b, c, d } => {
                let n = a.nrows();
                let system = DMatrix::from_fn(n, n, |i, j| {
                    let diagonal = if i == j { z } else { Complex::new(0.0, 0.0) };
                    diagonal - a[(i, j)]
                });
                let b = b.map(|v| Complex::new(v, 0.0));
                system
                    .lu()
                    .solve(&b)
                    .map_or(Complex::new(f64::INFINITY, 0.0), |x| {
                        c.iter()
                            .zip(x.iter())
                            .map(|(c, x)| x * *c)
                            .sum::<Complex<f64>>()
                            + *d
                    })
            }
        }
    }

    /// `(A, B, C, D)` of the state-space form, with `u = -(C x + D y)`.
    pub fn matrices(&self) -> (DMatrix<f64>, DVector<f64>, RowDVector<f64>, f64) {
        match self {
            Self::StateSpace { a, b, c, d } => (a.clone(), b.clone(), c.clone(), *d),
            Self::Pi { pi, sample_time_s } => {
                let integral = pi.ki_per_s * sample_time_s;
                // Without integral gain the integrator is not part of the loop, and must not count as its pole at 1.
                let keep = if integral == 0.0 { 0.0 } else { 1.0 };
                match pi.lead {
                    None => (
                        DMatrix::from_element(1, 1, keep),
                        DVector::from_element(1, integral),
                        RowDVector::from_element(1, 1.0),
                        pi.kp + 0.5 * integral,
                    ),
                    Some(lead) => {
                        let (b0, b1, a1) = lead.coefficients(*sample_time_s);
                        (
                            DMatrix::from_row_slice(2, 2, &[keep, 0.0, 0.0, -a1]),
                            DVector::from_vec(vec![integral, b1 - a1 * b0]),
                            RowDVector::from_vec(vec![1.0, pi.kp]),
                            pi.kp * b0 + 0.5 * integral,
                        )
                    }
                }
            }
        }
    }
}
