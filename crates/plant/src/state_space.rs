//! State space in real modal form. For analysis and estimators; the loop uses [`crate::DiscretePlant`].

use crate::modal::{Zpk, residues, separate};
use crate::transfer::TransferFunction;
use nalgebra::{Complex, DMatrix, DVector, RowDVector};

/// `x' = A x + B u`, `y = C x + D u`, u in um of displacement from the working point, y in um of bead position.
///
/// Built from a transfer function it is in real modal form: one row per real pole, a 2 x 2 block per complex pair.
/// States are scaled so that B and C share the residue evenly, which keeps Eq. (6), with poles 4.6 decades apart,
/// well conditioned (a companion form is not).
#[derive(Debug, Clone, PartialEq)]
pub struct StateSpace {
    /// n x n \[1/s\].
    pub a: DMatrix<f64>,
    /// n x 1.
    pub b: DVector<f64>,
    /// 1 x n.
    pub c: RowDVector<f64>,
    /// Feedthrough, um/um.
    pub d: f64,
}

impl StateSpace {
    /// The real modal form of a transfer function. Coinciding poles are moved apart by 3e-5 of their size.
    pub fn from_transfer_function(g: &TransferFunction) -> Self {
        let mut zpk = Zpk::of(g);
        separate(&mut zpk.poles);
        let (d, r) = residues(&zpk);
        let n = zpk.poles.len();
        let mut a = DMatrix::zeros(n, n);
        let mut b = DVector::zeros(n);
        let mut c = RowDVector::zeros(n);
        let mut row = 0;
        for (p, r) in zpk.poles.iter().zip(&r) {
            if p.im < 0.0 || row >= n {
                continue;
            }
            let scale = r.norm().sqrt().max(f64::MIN_POSITIVE);
            // If rounding has split a pair, one pole is left over; a single row has no room for its imaginary part.
            if p.im == 0.0 || row + 1 == n {
                a[(row, row)] = p.re;
                b[row] = scale;
                c[row] = r.re / scale;
                row += 1;
            } else {
                // z' = p z + u, y = 2 Re(r z), with z = x1 + i x2.
                a[(row, row)] = p.re;
                a[(row, row + 1)] = -p.im;
                a[(row + 1, row)] = p.im;
                a[(row + 1, row + 1)] = p.re;
                b[row] = scale;
                c[row] = 2.0 * r.re / scale;
                c[row + 1] = -2.0 * r.im / scale;
                row += 2;
            }
        }
        Self { a, b, c, d }
    }

    /// Number of states.
    pub fn order(&self) -> usize {
        self.b.len()
    }

    /// The value at a complex frequency s \[rad/s\], `C (sI - A)^-1 B + D`; `None` at a pole.
    pub fn at(&self, s: Complex<f64>) -> Option<Complex<f64>> {
        let n = self.order();
        if n == 0 {
            return Some(Complex::new(self.d, 0.0));
        }
        let system = DMatrix::from_fn(n, n, |i, j| {
            let diagonal = if i == j { s } else { Complex::new(0.0, 0.0) };
            diagonal - self.a[(i, j)]
        });
        let x = system.lu().solve(&self.b.map(|v| Complex::new(v, 0.0)))?;
        Some(
            self.c
                .iter()
                .zip(x.iter())
                .map(|(c, x)| x * *c)
                .sum::<Complex<f64>>()
                + self.d,
        )
    }
}
