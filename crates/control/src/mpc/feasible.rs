//! A solver that was stopped leaves no plan yet: its point is brought within the limits, and the best available point is followed.

use crate::active_set::{ABSENT, QpMatrices, QpVectors, ROWS, VARS};

/// Weight of a point's distance outside the field of view, over the largest curvature of the cost.
const VIEW_WEIGHT: f64 = 1e4;

/// The point nearest to `w`, block by block, whose commands keep range and slew.
fn within_limits(v: &QpVectors, w: &[f64; VARS]) -> [f64; VARS] {
    let mut before = 0.0;
    std::array::from_fn(|b| {
        let ranged = w[b].min(v.high[b]).max(v.low[b]);
        before = ranged
            .min(before + v.high[VARS + b])
            .max(before + v.low[VARS + b]);
        before
    })
}

/// Cost of a point, and how far it leaves the field of view as a penalty.
fn cost(m: &QpMatrices, v: &QpVectors, w: &[f64; VARS]) -> f64 {
    let mut sum = 0.0;
    for (i, x) in w.iter().enumerate() {
        let along: f64 = w
            .iter()
            .enumerate()
            .map(|(j, y)| m.hessian[(i, j)] * y)
            .sum();
        sum += x * (0.5 * along + v.linear[i]);
    }
    let mut outside: f64 = 0.0;
    for row in 2 * VARS..ROWS {
        if v.low[row].abs() >= ABSENT && v.high[row].abs() >= ABSENT {
            continue;
        }
        let at: f64 = w
            .iter()
            .enumerate()
            .map(|(j, x)| m.rows[(row, j)] * x)
            .sum();
        outside = outside.max(at - v.high[row]).max(v.low[row] - at);
    }
    sum + VIEW_WEIGHT * m.hessian[(0, 0)].abs() * outside
}

/// The cheapest of some points once they are brought within range and slew; points that are not finite do not count.
pub(super) fn best(
    m: &QpMatrices,
    v: &QpVectors,
    points: impl IntoIterator<Item = [f64; VARS]>,
) -> Option<[f64; VARS]> {
    points
        .into_iter()
        .map(|w| within_limits(v, &w))
        .map(|w| (cost(m, v, &w), w))
        .filter(|(cost, _)| cost.is_finite())
        .min_by(|(a, _), (b, _)| a.total_cmp(b))
        .map(|(_, w)| w)
}
