//! A line that nothing commands is as large in one record as in the next: a pump or the mains does not know what is recorded.

use nalgebra::DMatrix;

use cellpos_plant::effects::Role;

use crate::fit::context::{Fit, freedom_of};

/// Part of its amplitude by which a line may differ from record to record: by so much the mains change when loads are switched
/// (EN 61000-3-3, 3.3 %); the steps of a pump are more equal.
const EQUAL: f64 = 0.033;

/// What it costs to give the waves of each line one amplitude in all records, with any phase: a sum of squares in standard deviations.
/// `inverse` is the covariance of all numbers of the fit.
pub(super) fn unequal(fit: &Fit, inverse: &DMatrix<f64>) -> f64 {
    let records = fit.innovations.len();
    let mut sum = 0.0;
    let (mut at, mut line) = (0, 0);
    for part in &fit.parts {
        let v = part.variant();
        if let Role::Line { harmonics } = v.role {
            let waves = &fit.lines[line];
            line += 1;
            for harmonic in 0..harmonics {
                let of = |(record, waves): (usize, &Vec<[f64; 2]>)| {
                    let first = at + v.params.len() + 2 * (record * harmonics + harmonic);
                    let x = waves[harmonic];
                    let size = x[0].hypot(x[1]);
                    let along = [x[0] / size, x[1] / size];
                    let variance: f64 = (0..4)
                        .map(|k| {
                            along[k / 2] * along[k % 2] * inverse[(first + k / 2, first + k % 2)]
                        })
                        .sum();
                    (size, variance)
                };
                let sizes: Vec<(f64, f64)> = waves.iter().enumerate().map(of).collect();
                sum += misfit(&sizes);
            }
        }
        at += freedom_of(v, records);
    }
    sum
}

/// Least sum of squares of sizes with variances from one common size, which is itself the same to [`EQUAL`]; no size at all is allowed.
fn misfit(sizes: &[(f64, f64)]) -> f64 {
    let known = || (sizes.iter().copied()).filter(|(size, v)| *v > 0.0 && (size * v).is_finite());
    let variance = |v: f64, common: f64| v + (EQUAL * common).powi(2);
    let sum = |common: f64| -> f64 {
        let off = |(size, v): (f64, f64)| (size - common).powi(2) / variance(v, common);
        known().map(off).sum()
    };
    let mut common = known().map(|(size, _)| size).fold(0.0, f64::max);
    let mut least = sum(0.0);
    for _ in 0..20 {
        least = least.min(sum(common));
        let weights = known().map(|(_, v)| 1.0 / variance(v, common)).sum::<f64>();
        let weighted = known()
            .map(|(size, v)| size / variance(v, common))
            .sum::<f64>();
        common = weighted / weights.max(f64::MIN_POSITIVE);
    }
    least.min(sum(common))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_size_in_all_records_costs_nothing_and_a_record_without_costs_the_line() {
        let equal = [(0.100, 1e-6), (0.104, 1e-6), (0.097, 4e-6)];
        assert!(misfit(&equal) < 3.0, "{}", misfit(&equal));
        // Ten standard deviations in two records, nothing in a third that would show it: nearly all that the line explains.
        let absent = [(0.1, 1e-4), (0.1, 1e-4), (0.0, 1e-6)];
        let cost = misfit(&absent);
        assert!((190.0..=200.0).contains(&cost), "{cost}");
        // A record that shows nothing of it costs nothing.
        let unseen = [(0.1, 1e-4), (0.1, 1e-4), (0.0, f64::INFINITY), (0.0, 1.0)];
        assert!(misfit(&unseen) < 0.1, "{}", misfit(&unseen));
    }
}
