//! How likely a gain of that size is by chance.

use crate::thresholds::THRESHOLDS;

/// Upper tail of chi-square with `freedom` degrees of freedom, times the number of trials of the search, at most 1.
pub(crate) fn p_value(gain: f64, freedom: usize) -> f64 {
    (THRESHOLDS.trials * upper_tail(gain.max(0.0), freedom as f64)).clamp(1e-300, 1.0)
}

/// `Q(k/2, x/2)`, by the finite series for whole and half degrees.
fn upper_tail(x: f64, k: f64) -> f64 {
    if x <= 0.0 {
        return 1.0;
    }
    let half = 0.5 * x;
    // ln of the leading term x^(a-1) e^-x / Gamma(a), going up from a = 1 or 1/2 in steps of one.
    let odd = (k as usize) % 2 == 1;
    let (mut a, mut sum) = if odd {
        (0.5, erfc(half.sqrt()))
    } else {
        (1.0, (-half).exp())
    };
    let mut term = if odd {
        (-half).exp() * half.sqrt() / (0.5 * std::f64::consts::PI.sqrt())
    } else {
        half * (-half).exp()
    };
    while a + 1.0 <= 0.5 * k + 1e-9 {
        sum += term;
        a += 1.0;
        term *= half / a;
    }
    sum.clamp(0.0, 1.0)
}

/// Complementary error function, relative error below 1.2e-7 (Numerical Recipes' Chebyshev fit).
fn erfc(x: f64) -> f64 {
    let t = 1.0 / (1.0 + 0.5 * x);
    t * (-x * x - 1.265_512_23
        + t * (1.000_023_68
            + t * (0.374_091_96
                + t * (0.096_784_18
                    + t * (-0.186_288_06
                        + t * (0.278_868_07
                            + t * (-1.135_203_98
                                + t * (1.488_515_87 + t * (-0.822_152_23 + t * 0.170_872_77)))))))))
        .exp()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tails_match_tabulated_quantiles_of_chi_square() {
        for (x, k, p) in [
            (3.841, 1.0, 0.05),
            (5.991, 2.0, 0.05),
            (7.815, 3.0, 0.05),
            (18.307, 10.0, 0.05),
            (19.675, 11.0, 0.05),
            (10.828, 1.0, 0.001),
        ] {
            assert!(
                (upper_tail(x, k) / p - 1.0).abs() < 2e-3,
                "{x} {k}: {}",
                upper_tail(x, k)
            );
        }
    }
}
