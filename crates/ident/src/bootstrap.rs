//! Replicates of a fit: its parameters for other draws of the same noise.

use crate::order_selection::{CandidateFits, OrderSelection};
use cellpos_numeric::Random;
use nalgebra::Complex;

/// Parameter vectors of the chosen order fitted to resampled blocks, each with a new draw of the weak bounds on the feedthrough.
///
/// A weak bound pulls the fit, so where it acts the fit errs by less than the covariance says. How much less depends on where
/// this fit ended, and replicates around that point would repeat the accident. Each replicate therefore draws the bound as a
/// datum, like the lines (randomise, then optimise): the spread is that of the covariance, and the shape that of the full fit,
/// not of its linear part.
pub fn bootstrap(
    problem: &OrderSelection<'_>,
    fit: &CandidateFits,
    replicates: usize,
    seed: u64,
) -> Vec<Vec<f64>> {
    let mut random = Random::new(seed);
    let best = fit.best();
    (0..replicates)
        .filter_map(|_| {
            let data: Vec<Complex<f64>> = problem
                .points()
                .iter()
                .map(|p| {
                    let n = p.block_errors.len();
                    if n < 2 {
                        return p.response;
                    }
                    let sum: Complex<f64> = (0..n).map(|_| p.block_errors[random.below(n)]).sum();
                    // The variance of resampled means is too small by (n-1)/n. The noise model sets the size; a misfit of the
                    // order widens it as it widens the covariance.
                    let size = (p.variance / p.scatter_variance.max(f64::MIN_POSITIVE) * n as f64
                        / (n as f64 - 1.0)
                        * fit.scale)
                        .sqrt();
                    let strays = match problem.stray_s() {
                        0.0 => 0.0,
                        sd_s => std::f64::consts::TAU * p.frequency_hz * sd_s * random.normal(),
                    };
                    p.response * Complex::new(1.0, -strays) + sum / n as f64 * size
                })
                .collect();
            let moved = [(); 2].map(|()| fit.scale.sqrt() * random.normal());
            let found = problem.clone().with_bounds_moved(moved).fit_from(
                &data,
                best.order,
                &best.parameters,
                None,
            );
            found.chi2.is_finite().then_some(found.parameters)
        })
        .collect()
}
