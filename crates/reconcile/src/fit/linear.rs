//! Linear algebra of the fit: normal equations over masks, and projections against tangents.

use crate::dot::dot;
use crate::mask::Mask;
use nalgebra::{DMatrix, DVector};

/// Columns of one record: (index of the parameter, whitened derivative).
pub(crate) type Columns = Vec<(usize, Vec<f64>)>;

/// Whitened tangents of a fit: what further candidates are projected against.
pub(crate) struct Tangents {
    /// Per record: (index of the parameter, whitened column).
    pub columns: Vec<Columns>,
    pub inverse: DMatrix<f64>,
    pub gradient: DVector<f64>,
}

/// What a direction in the space of innovations would gain.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Gain {
    /// Fall of the sum of squares when the direction is added with its best scale, all tangents refitted.
    pub score: f64,
    /// That scale.
    pub scale: f64,
    /// Sum of squares of the direction, less the part that the tangents take over.
    pub own: f64,
}

impl Tangents {
    /// Projects a whitened direction `d` (change of the innovations) against the tangents.
    pub(crate) fn gain(&self, d: &[Vec<f64>], e: &[Vec<f64>], mask: &Mask) -> Gain {
        let n = self.gradient.len();
        let mut jd = DVector::zeros(n);
        let (mut dd, mut de) = (0.0, 0.0);
        for i in 0..d.len() {
            for r in &mask[i] {
                let di = &d[i][r.clone()];
                dd += dot(di, di);
                de += dot(di, &e[i][r.clone()]);
                for (index, c) in &self.columns[i] {
                    jd[*index] += dot(&c[r.clone()], di);
                }
            }
        }
        let w = &self.inverse * &jd;
        let dd2 = dd - jd.dot(&w);
        let de2 = de - self.gradient.dot(&w);
        if dd2 <= 1e-6 * dd || dd <= 0.0 {
            return Gain {
                score: 0.0,
                scale: 0.0,
                own: 0.0,
            };
        }
        Gain {
            score: de2 * de2 / dd2,
            scale: -de2 / dd2,
            own: dd2,
        }
    }
}

/// Sum of squares under a mask.
pub(crate) fn sum_squares(e: &[Vec<f64>], mask: &Mask) -> f64 {
    e.iter()
        .zip(mask)
        .map(|(e, ranges)| {
            ranges
                .iter()
                .map(|r| dot(&e[r.clone()], &e[r.clone()]))
                .sum::<f64>()
        })
        .sum()
}

/// Normal matrix and gradient of whitened columns against innovations.
pub(crate) fn normal_equations(
    n: usize,
    columns: &[Columns],
    e: &[Vec<f64>],
    mask: &Mask,
) -> (DMatrix<f64>, DVector<f64>) {
    let mut a = DMatrix::zeros(n, n);
    let mut g = DVector::zeros(n);
    for ((columns, e), ranges) in columns.iter().zip(e).zip(mask) {
        for r in ranges {
            for (x, (i, ci)) in columns.iter().enumerate() {
                let ci = &ci[r.clone()];
                g[*i] += dot(ci, &e[r.clone()]);
                for (j, cj) in &columns[..=x] {
                    let v = dot(ci, &cj[r.clone()]);
                    a[(*i, *j)] += v;
                    if i != j {
                        a[(*j, *i)] += v;
                    }
                }
            }
        }
    }
    (a, g)
}
