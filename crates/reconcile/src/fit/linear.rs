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

/// Corrects derivatives after a step so that they give the change of the innovations which it made (Broyden's update, in the metric of the
/// normal matrix's diagonal, in which it does not matter in what unit a number is).
pub(crate) fn correct(
    columns: &mut [Columns],
    moved: &DVector<f64>,
    normal: &DMatrix<f64>,
    [before, after]: [&[Vec<f64>]; 2],
) {
    for ((columns, before), after) in columns.iter_mut().zip(before).zip(after) {
        let weight = |j: usize| normal[(j, j)] * moved[j];
        let size: f64 = columns.iter().map(|(j, _)| weight(*j) * moved[*j]).sum();
        if size <= 0.0 {
            continue;
        }
        let mut unlike: Vec<f64> = after.iter().zip(before).map(|(a, b)| a - b).collect();
        for (j, column) in columns.iter() {
            for (e, c) in unlike.iter_mut().zip(column) {
                *e -= moved[*j] * c;
            }
        }
        for (j, column) in columns {
            let share = weight(*j) / size;
            for (c, e) in column.iter_mut().zip(&unlike) {
                *c += share * e;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn corrected_derivatives_give_the_change_that_was_seen_and_keep_what_was_not_asked() {
        let mut columns = vec![vec![(0, vec![1.0, 0.0, 2.0]), (1, vec![0.0, 3.0, 1.0])]];
        let moved = DVector::from_vec(vec![0.5, -0.25]);
        let normal = DMatrix::from_diagonal(&DVector::from_vec(vec![4.0, 100.0]));
        let before = [vec![0.1, 0.2, 0.3]];
        let after = [vec![0.9, -0.7, 1.2]];
        correct(&mut columns, &moved, &normal, [&before, &after]);
        let at = |columns: &[Columns], k: usize, by: [f64; 2]| {
            columns[0][0].1[k] * by[0] + columns[0][1].1[k] * by[1]
        };
        for k in 0..3 {
            let change = at(&columns, k, [0.5, -0.25]);
            assert!((change - (after[0][k] - before[0][k])).abs() < 1e-12);
        }
        // Across the step, in the metric, nothing was learnt: 4 * 0.5 * x + 100 * -0.25 * y = 0 for (x, y) = (12.5, 1).
        assert!((at(&columns, 0, [12.5, 1.0]) - 12.5).abs() < 1e-12);
        assert!((at(&columns, 1, [12.5, 1.0]) - 3.0).abs() < 1e-12);
    }
}
