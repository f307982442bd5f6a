//! Distributions for tests and intervals (chi-squared, Student's t, Fisher's F), and quantiles of samples.
//!
//! The distribution functions come from `statrs`. This module gives them the arguments that this project needs, and quantiles for
//! any real number of degrees of freedom.

use statrs::function::beta::beta_reg;
use statrs::function::gamma::gamma_ur;

/// Standard deviations from the middle of a normal distribution to the ends of its 95 % interval.
pub const Z95: f64 = 1.96;

/// Probability that a chi-squared variable with `dof` degrees of freedom exceeds `x`.
pub fn chi2_exceeds(x: f64, dof: f64) -> f64 {
    if x <= 0.0 {
        return 1.0;
    }
    gamma_ur(dof / 2.0, x / 2.0)
}

/// Probability that a Fisher F variable with (`d1`, `d2`) degrees of freedom exceeds `f`.
pub fn f_exceeds(f: f64, d1: f64, d2: f64) -> f64 {
    if f <= 0.0 {
        return 1.0;
    }
    beta_reg(d2 / 2.0, d1 / 2.0, d2 / (d2 + d1 * f))
}

/// Student's t distribution function with `dof` degrees of freedom.
pub fn student_t_below(t: f64, dof: f64) -> f64 {
    let tail = 0.5 * beta_reg(dof / 2.0, 0.5, dof / (dof + t * t));
    if t < 0.0 { tail } else { 1.0 - tail }
}

/// Quantile of Student's t with `dof` degrees of freedom, for `probability` in (0, 1).
pub fn student_t_quantile(probability: f64, dof: f64) -> f64 {
    invert(probability, -1e4, 1e4, |t| student_t_below(t, dof))
}

/// The value at which a rising function reaches `target`, by bisection between `low` and `high`.
pub fn invert(target: f64, mut low: f64, mut high: f64, f: impl Fn(f64) -> f64) -> f64 {
    // Two hundred halvings end at neighbouring numbers, and most searches do before.
    for _ in 0..200 {
        let mid = 0.5 * (low + high);
        if mid == low || mid == high {
            break;
        }
        if f(mid) < target {
            low = mid;
        } else {
            high = mid;
        }
    }
    0.5 * (low + high)
}

/// The `probability` quantile of the finite numbers of a sample, interpolated linearly between order statistics; NaN without any.
pub fn quantile(sample: &[f64], probability: f64) -> f64 {
    quantiles(sample, [probability])[0]
}

/// Several quantiles of a sample, sorted once: see [`quantile`].
pub fn quantiles<const N: usize>(sample: &[f64], probabilities: [f64; N]) -> [f64; N] {
    let mut sorted: Vec<f64> = sample.iter().copied().filter(|v| v.is_finite()).collect();
    sorted.sort_by(f64::total_cmp);
    let Some(last) = sorted.len().checked_sub(1) else {
        return [f64::NAN; N];
    };
    probabilities.map(|probability| {
        let at = probability.clamp(0.0, 1.0) * last as f64;
        let (low, high) = (at.floor() as usize, at.ceil() as usize);
        sorted[low] + (sorted[high] - sorted[low]) * (at - low as f64)
    })
}

/// The median of the finite numbers of a sample; NaN without any.
pub fn median(sample: &[f64]) -> f64 {
    quantile(sample, 0.5)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_agree_with_published_tables() {
        assert!((student_t_quantile(0.975, 5.0) - 2.570_581_835_6).abs() < 1e-7);
        assert!((student_t_quantile(0.975, 1e7) - 1.959_963_98).abs() < 1e-6);
        assert!((chi2_exceeds(3.841_458_820_7, 1.0) - 0.05).abs() < 1e-9);
        assert!((chi2_exceeds(28.869_299_430_4, 18.0) - 0.05).abs() < 1e-9);
        assert!((f_exceeds(3.325_834_530_4, 5.0, 10.0) - 0.05).abs() < 1e-8);
        assert!((f_exceeds(4.102_821_01, 2.0, 10.0) - 0.05).abs() < 1e-6);
    }

    #[test]
    fn tails_agree_with_published_tables_far_out_and_at_the_ends() {
        for (x, dof, p) in [
            (3.841, 1.0, 0.05),
            (7.815, 3.0, 0.05),
            (19.675, 11.0, 0.05),
            (10.828, 1.0, 0.001),
            (91.952, 60.0, 0.005),
        ] {
            let tail = chi2_exceeds(x, dof);
            assert!((tail / p - 1.0).abs() < 2e-3, "{x} {dof}: {tail}");
        }
        assert_eq!(chi2_exceeds(0.0, 3.0), 1.0);
        assert!(chi2_exceeds(1e4, 3.0) < 1e-300);
        assert_eq!(f_exceeds(0.0, 2.0, 2.0), 1.0);
        assert!((student_t_below(0.0, 3.0) - 0.5).abs() < 1e-12);
    }

    #[test]
    fn sample_quantiles_interpolate_and_ignore_numbers_that_are_not_finite() {
        let sample = [3.0, 1.0, f64::NAN, 2.0, 4.0];
        assert!((median(&sample) - 2.5).abs() < 1e-12);
        assert_eq!(quantiles(&sample, [0.0, 1.0]), [1.0, 4.0]);
        assert!(median(&[]).is_nan());
    }
}
