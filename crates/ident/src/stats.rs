//! Distribution functions that tests and intervals need: normal, chi-squared, Student's t and Fisher's F.
//!
//! Only what identification uses, to about 1e-10. Not a statistics library.

/// Natural logarithm of the gamma function for `x > 0` (Lanczos, g = 7, nine terms; relative error below 1e-13).
pub fn ln_gamma(x: f64) -> f64 {
    const G: f64 = 7.0;
    const C: [f64; 9] = [
        0.999_999_999_999_809_9,
        676.520_368_121_885_1,
        -1_259.139_216_722_402_8,
        771.323_428_777_653_1,
        -176.615_029_162_140_6,
        12.507_343_278_686_905,
        -0.138_571_095_265_720_12,
        9.984_369_578_019_572e-6,
        1.505_632_735_149_311_6e-7,
    ];
    if x < 0.5 {
        let pi = std::f64::consts::PI;
        return (pi / (pi * x).sin()).ln() - ln_gamma(1.0 - x);
    }
    let x = x - 1.0;
    let t = x + G + 0.5;
    let sum = C
        .iter()
        .enumerate()
        .skip(1)
        .fold(C[0], |a, (i, c)| a + c / (x + i as f64));
    0.5 * (2.0 * std::f64::consts::PI).ln() + (x + 0.5) * t.ln() - t + sum.ln()
}

/// Regularised incomplete beta function `I_x(a, b)` (continued fraction, modified Lentz).
pub fn incomplete_beta(a: f64, b: f64, x: f64) -> f64 {
    if x <= 0.0 {
        return 0.0;
    }
    if x >= 1.0 {
        return 1.0;
    }
    if x > (a + 1.0) / (a + b + 2.0) {
        return 1.0 - incomplete_beta(b, a, 1.0 - x);
    }
    let front =
        (a * x.ln() + b * (-x).ln_1p() + ln_gamma(a + b) - ln_gamma(a) - ln_gamma(b)).exp() / a;
    let tiny = 1e-300;
    let clamp = |v: f64| if v.abs() < tiny { tiny } else { v };
    let mut c = 1.0;
    let mut d = 1.0 / clamp(1.0 - (a + b) * x / (a + 1.0));
    let mut h = d;
    for i in 1..500 {
        let m = f64::from(i);
        let even = m * (b - m) * x / ((a + 2.0 * m - 1.0) * (a + 2.0 * m));
        d = 1.0 / clamp(1.0 + even * d);
        c = clamp(1.0 + even / c);
        h *= d * c;
        let odd = -(a + m) * (a + b + m) * x / ((a + 2.0 * m) * (a + 2.0 * m + 1.0));
        d = 1.0 / clamp(1.0 + odd * d);
        c = clamp(1.0 + odd / c);
        let step = d * c;
        h *= step;
        if (step - 1.0).abs() < 1e-15 {
            break;
        }
    }
    front * h
}

/// Regularised lower incomplete gamma function `P(a, x)`.
pub fn incomplete_gamma(a: f64, x: f64) -> f64 {
    if x <= 0.0 {
        return 0.0;
    }
    let front = (a * x.ln() - x - ln_gamma(a)).exp();
    if x < a + 1.0 {
        let mut term = 1.0 / a;
        let mut sum = term;
        for n in 1..2000 {
            term *= x / (a + f64::from(n));
            sum += term;
            if term < sum * 1e-16 {
                break;
            }
        }
        return front * sum;
    }
    let tiny = 1e-300;
    let mut b = x + 1.0 - a;
    let mut c = 1.0 / tiny;
    let mut d = 1.0 / b;
    let mut h = d;
    for n in 1..2000 {
        let n = f64::from(n);
        let an = -n * (n - a);
        b += 2.0;
        d = an * d + b;
        d = 1.0 / if d.abs() < tiny { tiny } else { d };
        c = b + an / c;
        c = if c.abs() < tiny { tiny } else { c };
        let step = d * c;
        h *= step;
        if (step - 1.0).abs() < 1e-15 {
            break;
        }
    }
    1.0 - front * h
}

/// Probability that a chi-squared variable with `dof` degrees of freedom exceeds `x`.
pub fn chi2_exceeds(x: f64, dof: f64) -> f64 {
    1.0 - incomplete_gamma(dof / 2.0, x / 2.0)
}

/// Probability that a Fisher F variable with (`d1`, `d2`) degrees of freedom exceeds `f`.
pub fn f_exceeds(f: f64, d1: f64, d2: f64) -> f64 {
    if f <= 0.0 {
        return 1.0;
    }
    incomplete_beta(d2 / 2.0, d1 / 2.0, d2 / (d2 + d1 * f))
}

/// Student's t distribution function with `dof` degrees of freedom.
pub fn student_t_below(t: f64, dof: f64) -> f64 {
    let tail = 0.5 * incomplete_beta(dof / 2.0, 0.5, dof / (dof + t * t));
    if t < 0.0 { tail } else { 1.0 - tail }
}

/// The value that a rising function reaches `target` at, by bisection in [`low`, `high`].
fn invert(target: f64, mut low: f64, mut high: f64, f: impl Fn(f64) -> f64) -> f64 {
    for _ in 0..200 {
        let mid = 0.5 * (low + high);
        if f(mid) < target {
            low = mid;
        } else {
            high = mid;
        }
    }
    0.5 * (low + high)
}

/// Quantile of Student's t with `dof` degrees of freedom, for `probability` in (0, 1).
pub fn student_t_quantile(probability: f64, dof: f64) -> f64 {
    invert(probability, -1e4, 1e4, |t| student_t_below(t, dof))
}

/// Quantile of chi-squared with `dof` degrees of freedom, for `probability` in (0, 1).
pub fn chi2_quantile(probability: f64, dof: f64) -> f64 {
    invert(probability, 0.0, 20.0 * dof + 200.0, |x| {
        incomplete_gamma(dof / 2.0, x / 2.0)
    })
}

/// The `probability` quantile of a sample (linear interpolation between order statistics; `NaN` for an empty one).
pub fn quantile(sample: &[f64], probability: f64) -> f64 {
    let mut sorted: Vec<f64> = sample.iter().copied().filter(|v| v.is_finite()).collect();
    sorted.sort_by(f64::total_cmp);
    let Some(last) = sorted.len().checked_sub(1) else {
        return f64::NAN;
    };
    let at = probability.clamp(0.0, 1.0) * last as f64;
    let low = at.floor() as usize;
    let high = at.ceil() as usize;
    sorted[low] + (sorted[high] - sorted[low]) * (at - low as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_agree_with_published_tables() {
        assert!((student_t_quantile(0.975, 5.0) - 2.570_581_835_6).abs() < 1e-7);
        assert!((student_t_quantile(0.975, 1e7) - 1.959_963_98).abs() < 1e-6);
        assert!((chi2_quantile(0.95, 1.0) - 3.841_458_820_7).abs() < 1e-7);
        assert!((chi2_quantile(0.95, 18.0) - 28.869_299_430_4).abs() < 1e-6);
        assert!((f_exceeds(3.325_834_530_4, 5.0, 10.0) - 0.05).abs() < 1e-8);
        assert!((f_exceeds(4.102_821_01, 2.0, 10.0) - 0.05).abs() < 1e-6);
        assert!((ln_gamma(10.5) - 13.940_625_219_403_76).abs() < 1e-10);
    }

    #[test]
    fn sample_quantiles_interpolate_and_ignore_what_is_not_a_number() {
        let sample = [3.0, 1.0, f64::NAN, 2.0, 4.0];
        assert!((quantile(&sample, 0.5) - 2.5).abs() < 1e-12);
        assert!(quantile(&[], 0.5).is_nan());
    }
}
