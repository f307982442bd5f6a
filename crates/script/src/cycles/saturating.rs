//! A law that saturates, as an alternative to the straight line: a cell tires mostly in its first cycles.

use super::minimum::minimum;
use cellpos_numeric::statistics::Z95;
use nalgebra::{Matrix3, Vector3};

/// `end + (start - end) exp(-(cycle - first) / cycles)` through a quantity of the cycles.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Saturating {
    /// Value of the law at the first cycle.
    pub start: f64,
    /// Half width of its 95 % interval.
    pub start_ci95: f64,
    /// Value that it tends to.
    pub end: f64,
    /// Half width of its 95 % interval.
    pub end_ci95: f64,
    /// Cycles in which the distance from the end falls to 1/e.
    pub cycles: f64,
    /// Half width of its 95 % interval.
    pub cycles_ci95: f64,
    /// RMS of the residuals.
    pub residual: f64,
    /// Whether it describes the cycles better than the straight line does, its further parameter taken into account.
    pub better_than_line: bool,
}

/// The law through `(cycle, value)` points, against a line whose residuals have the sum of squares `line`. None if the points do not
/// determine its end: too few, or its constant is outside.
pub(super) fn fit(points: &[(f64, f64)], line: f64) -> Option<Saturating> {
    /// Fewest points of a law with three parameters that is not chance.
    const FEWEST: usize = 12;
    let (first, last) = (points.first()?.0, points.last()?.0);
    let span = last - first;
    if points.len() < FEWEST || span <= 0.0 {
        return None;
    }
    let cost = |log: f64| solve(points, first, log.exp()).map_or(f64::INFINITY, |(_, _, sum)| sum);
    let (low, high) = ((0.5f64).ln(), span.ln());
    let cycles = minimum(low, high, 40, cost)?.exp();
    let (start, end, sum) = solve(points, first, cycles)?;
    let n = points.len() as f64;
    let variance = sum / (n - 3.0);
    // Gauss-Newton covariance in start, end and the constant.
    let mut normal = Matrix3::zeros();
    for (x, _) in points {
        let e = (-(x - first) / cycles).exp();
        let row = Vector3::new(
            e,
            1.0 - e,
            (start - end) * e * (x - first) / (cycles * cycles),
        );
        normal += row * row.transpose();
    }
    let covariance = normal.try_inverse()? * variance;
    let ci95 = |k: usize| Z95 * covariance[(k, k)].max(0.0).sqrt();
    // A law whose constant or height the cycles do not determine does not count.
    let told = ci95(2) < 0.5 * cycles && (start - end).abs() > 2.0 * ci95(0).hypot(ci95(1));
    if !told {
        return None;
    }
    // Difference of the Bayesian information criterion: three parameters against two.
    let gain = n * (line / sum.max(f64::MIN_POSITIVE)).ln() - n.ln();
    Some(Saturating {
        start,
        start_ci95: ci95(0),
        end,
        end_ci95: ci95(1),
        cycles,
        cycles_ci95: ci95(2),
        residual: (sum / n).sqrt(),
        better_than_line: gain > 6.0,
    })
}

/// Start, end and sum of squared residuals for a constant.
fn solve(points: &[(f64, f64)], first: f64, cycles: f64) -> Option<(f64, f64, f64)> {
    let n = points.len() as f64;
    let (mut se, mut sy, mut see, mut sey) = (0.0, 0.0, 0.0, 0.0);
    for (x, y) in points {
        let e = (-(x - first) / cycles).exp();
        se += e;
        sy += y;
        see += e * e;
        sey += e * y;
    }
    let spread = see - se * se / n;
    if spread <= 1e-9 * see {
        return None;
    }
    let height = (sey - se * sy / n) / spread;
    let end = (sy - height * se) / n;
    let sum = points
        .iter()
        .map(|(x, y)| (y - end - height * (-(x - first) / cycles).exp()).powi(2))
        .sum();
    Some((end + height, end, sum))
}
