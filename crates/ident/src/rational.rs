//! Rational models of any linear order with a delay, fitted to a frequency response.
//!
//! For records of other rigs, whose plant is not Eq. (4): `G(s) = B(s)/A(s) e^(-sL)`, from a static gain up; AICc chooses the
//! order. Sanathanan-Koerner iterations give the start, Levenberg-Marquardt on the exact sampled response the result. The band's
//! middle sets the unit of time, so that coefficients are of order one. Not for Eq. (4) itself: [`crate::order_selection`] knows
//! its parameters.

use nalgebra::{Complex, DMatrix, DVector};

use crate::error::IdentError;
use crate::frequency_response::FrequencyPoint;
use crate::least_squares::{Minimum, covariance, minimise};
use crate::sampled::{Hold, PartialFractions, Sampling};

/// A fitted rational model.
#[derive(Debug, Clone, PartialEq)]
pub struct RationalFit {
    /// Poles.
    pub order: usize,
    /// Numerator, highest power of s (rad/s) first.
    pub numerator: Vec<f64>,
    /// Denominator, monic, highest power first.
    pub denominator: Vec<f64>,
    /// Delay, s.
    pub delay_s: f64,
    /// Standard deviation of the delay, s.
    pub delay_sd_s: f64,
    /// Standard deviations of the numerator's coefficients.
    pub numerator_sd: Vec<f64>,
    /// Standard deviations of the denominator's coefficients (0 for the leading one).
    pub denominator_sd: Vec<f64>,
    /// Poles, rad/s.
    pub poles: Vec<Complex<f64>>,
    /// Weighted sum of squares.
    pub chi2: f64,
    /// Real data less parameters.
    pub dof: f64,
    /// Corrected Akaike criterion.
    pub aicc: f64,
}

impl RationalFit {
    /// `G(j 2 pi f)` without the delay.
    pub fn response(&self, frequency_hz: f64) -> Complex<f64> {
        let s = Complex::new(0.0, 2.0 * std::f64::consts::PI * frequency_hz);
        horner(&self.numerator, s) / horner(&self.denominator, s)
    }

    /// What a record sampled as `sampling` shows at `frequency_hz`.
    pub fn sampled_response(&self, frequency_hz: f64, sampling: Sampling) -> Complex<f64> {
        fractions(&self.numerator, &self.denominator).sampled_response(
            frequency_hz,
            self.delay_s,
            sampling,
        )
    }
}

fn horner(c: &[f64], s: Complex<f64>) -> Complex<f64> {
    c.iter().fold(Complex::from(0.0), |a, &c| a * s + c)
}

/// Roots of a polynomial, highest power first, as eigenvalues of its companion matrix.
pub fn roots(c: &[f64]) -> Vec<Complex<f64>> {
    let n = c.len().saturating_sub(1);
    if n == 0 {
        return Vec::new();
    }
    let companion = DMatrix::from_fn(n, n, |i, j| {
        if i == 0 {
            -c[j + 1] / c[0]
        } else if i == j + 1 {
            1.0
        } else {
            0.0
        }
    });
    companion.complex_eigenvalues().iter().copied().collect()
}

/// Partial fractions of `numerator/denominator` (monic, at least of the numerator's degree). Poles that coincide are
/// moved apart by a millionth of their size, which is far below what any record resolves.
pub fn fractions(numerator: &[f64], denominator: &[f64]) -> PartialFractions {
    let n = denominator.len() - 1;
    let direct = if numerator.len() == n + 1 {
        numerator[0] / denominator[0]
    } else {
        0.0
    };
    let mut poles = roots(denominator);
    let size = poles.iter().map(|p| p.norm()).fold(0.0, f64::max).max(1e-9);
    for i in 0..n {
        for j in 0..i {
            if (poles[i] - poles[j]).norm() < 1e-6 * size {
                poles[i] *= 1.0 + 1e-6;
                poles[i] += 1e-6 * size;
            }
        }
    }
    let terms = (0..n)
        .map(|i| {
            let p = poles[i];
            let others: Complex<f64> = (0..n).filter(|&j| j != i).map(|j| p - poles[j]).product();
            let rest = horner(numerator, p) - direct * horner(denominator, p);
            (p, rest / (denominator[0] * others))
        })
        .collect();
    PartialFractions { direct, terms }
}

/// Fits a model with `order` poles and numerator degree `zeros`.
///
/// # Errors
/// [`IdentError::TooFewPoints`], [`IdentError::NoFit`], [`IdentError::OutOfRange`] for a variance that is not positive.
pub fn fit_rational(
    points: &[FrequencyPoint],
    sampling: Sampling,
    order: usize,
    zeros: usize,
) -> Result<RationalFit, IdentError> {
    fit_with(points, sampling, [order, zeros], true)
}

/// The same, with a delay or without one.
pub(crate) fn fit_with(
    points: &[FrequencyPoint],
    sampling: Sampling,
    [order, zeros]: [usize; 2],
    delayed: bool,
) -> Result<RationalFit, IdentError> {
    let parameters = checked(points, order + zeros + 1 + usize::from(delayed))?;
    let zeros = zeros.min(order);
    let two_pi = 2.0 * std::f64::consts::PI;
    let log_mean = points.iter().map(|p| p.frequency_hz.ln()).sum::<f64>() / points.len() as f64;
    let scale = two_pi * log_mean.exp();
    // The start limits these weights to 1000 over a point's size, so that it does not depend on one line.
    let weights: Vec<f64> = points.iter().map(|p| (2.0 / p.variance).sqrt()).collect();
    let unscale = |x: &[f64]| -> (Vec<f64>, Vec<f64>, f64) {
        let numerator = x[..=zeros]
            .iter()
            .enumerate()
            .map(|(i, b)| b * scale.powi((order as i32) - (zeros - i) as i32))
            .collect();
        let mut denominator = vec![1.0];
        denominator.extend(
            x[zeros + 1..zeros + 1 + order]
                .iter()
                .enumerate()
                .map(|(i, a)| a * scale.powi(i as i32 + 1)),
        );
        let delay = x.get(zeros + 1 + order).map_or(0.0, |delay| delay / scale);
        (numerator, denominator, delay)
    };
    let fill = |x: &[f64], out: &mut [f64]| {
        let (numerator, denominator, delay_s) = unscale(x);
        let sampled = fractions(&numerator, &denominator).sampled(delay_s, sampling);
        for (i, p) in points.iter().enumerate() {
            let e = (p.response - sampled.response(p.frequency_hz)) * weights[i];
            out[2 * i] = e.re;
            out[2 * i + 1] = e.im;
        }
    };
    let starts = (0..if delayed { 10 } else { 1 }).filter_map(|i| {
        let delay_s = i as f64 * 0.5 * sampling.period_s;
        let mut x = sanathanan_koerner(points, &weights, sampling, order, zeros, scale, delay_s)?;
        x.extend(delayed.then_some(delay_s * scale));
        Some(x)
    });
    let found = best_minimum(starts, 2 * points.len(), &fill).ok_or(IdentError::NoFit {
        what: "a rational model",
        reason: "no start led to a finite residual",
    })?;
    let (numerator, denominator, delay_s) = unscale(&found.parameters);
    let dof = 2.0 * points.len() as f64 - parameters as f64;
    let spread = if dof > 0.0 {
        (found.chi2 / dof).max(1.0)
    } else {
        1.0
    };
    let sd: Vec<f64> = covariance(&found.jacobian)
        .diagonal()
        .iter()
        .map(|v| (v * spread).sqrt())
        .collect();
    let mut sd_unit = sd.clone();
    for (i, v) in sd_unit.iter_mut().enumerate().take(zeros + 1) {
        *v *= scale.powi((order as i32) - (zeros - i) as i32);
    }
    let mut denominator_sd = vec![0.0];
    denominator_sd.extend((0..order).map(|i| sd[zeros + 1 + i] * scale.powi(i as i32 + 1)));
    let n = 2.0 * points.len() as f64;
    let k = parameters as f64;
    let correction = if n - k - 1.0 > 0.0 {
        2.0 * k * (k + 1.0) / (n - k - 1.0)
    } else {
        f64::INFINITY
    };
    Ok(RationalFit {
        order,
        poles: roots(&denominator),
        numerator,
        denominator,
        delay_s,
        delay_sd_s: if delayed {
            sd[parameters - 1] / scale
        } else {
            0.0
        },
        numerator_sd: sd_unit[..=zeros].to_vec(),
        denominator_sd,
        chi2: found.chi2,
        dof,
        aicc: found.chi2 + 2.0 * k + correction,
    })
}

/// The lowest minimum that the starts lead to; starts with infinite residuals are skipped.
fn best_minimum(
    starts: impl Iterator<Item = Vec<f64>>,
    residuals: usize,
    fill: &impl Fn(&[f64], &mut [f64]),
) -> Option<Minimum> {
    let mut best: Option<Minimum> = None;
    for x in starts {
        let mut r = vec![0.0; residuals];
        fill(&x, &mut r);
        if !r.iter().all(|v| v.is_finite()) {
            continue;
        }
        let found = minimise(&x, &vec![1e-6; x.len()], residuals, fill);
        if found.chi2.is_finite() && best.as_ref().is_none_or(|b| found.chi2 < b.chi2) {
            best = Some(found);
        }
    }
    best
}

/// Refuses too few points for the parameters; returns their number.
fn checked(points: &[FrequencyPoint], parameters: usize) -> Result<usize, IdentError> {
    if 2 * points.len() < parameters || points.is_empty() {
        return Err(IdentError::TooFewPoints {
            points: points.len(),
            parameters,
            needed: parameters.div_ceil(2),
        });
    }
    if let Some(p) = points
        .iter()
        .find(|p| !(p.variance.is_finite() && p.variance > 0.0))
    {
        return Err(IdentError::OutOfRange {
            key: "variance",
            value: p.variance,
            unit: "1",
            expected: "a positive variance per point",
        });
    }
    Ok(parameters)
}

/// Coefficients (scaled time) of a rational function by iterated linear least squares; hold and delay are first removed from the
/// data approximately. `None` when the equations are singular.
fn sanathanan_koerner(
    points: &[FrequencyPoint],
    weights: &[f64],
    sampling: Sampling,
    order: usize,
    zeros: usize,
    scale: f64,
    delay_s: f64,
) -> Option<Vec<f64>> {
    let columns = zeros + 1 + order;
    let mut previous = vec![Complex::from(1.0); points.len()];
    let mut found = None;
    for _ in 0..8 {
        let mut a = DMatrix::zeros(2 * points.len(), columns);
        let mut b = DVector::zeros(2 * points.len());
        for (i, p) in points.iter().enumerate() {
            let w = 2.0 * std::f64::consts::PI * p.frequency_hz;
            let s = Complex::new(0.0, w / scale);
            let half = 0.5 * w * sampling.period_s;
            let hold = match sampling.hold {
                Hold::ZeroOrder => Complex::from_polar(half.sin() / half, -half),
                Hold::None => Complex::from(1.0),
            };
            let data = p.response / hold * Complex::from_polar(1.0, w * delay_s);
            let weight = Complex::from(weights[i].min(1e3 / p.response.norm())) / previous[i];
            let mut put = |j: usize, v: Complex<f64>| {
                a[(2 * i, j)] = (v * weight).re;
                a[(2 * i + 1, j)] = (v * weight).im;
            };
            for j in 0..=zeros {
                put(j, s.powi((zeros - j) as i32));
            }
            for j in 0..order {
                put(zeros + 1 + j, -data * s.powi((order - 1 - j) as i32));
            }
            let right = data * s.powi(order as i32) * weight;
            b[2 * i] = right.re;
            b[2 * i + 1] = right.im;
        }
        let x = a.svd(true, true).solve(&b, 1e-12).ok()?;
        for (i, p) in points.iter().enumerate() {
            let s = Complex::new(0.0, 2.0 * std::f64::consts::PI * p.frequency_hz / scale);
            let mut denominator = vec![1.0];
            denominator.extend(x.iter().skip(zeros + 1));
            previous[i] = horner(&denominator, s);
        }
        found = Some(x.as_slice().to_vec());
    }
    found.filter(|x| x.iter().all(|v| v.is_finite()))
}

/// Fits orders 0..=`most` (numerator degrees 0, one below and equal) and returns them, the chosen one first.
///
/// # Errors
/// [`IdentError::TooFewPoints`] when not even a static gain with delay can be fitted.
pub fn fit_orders(
    points: &[FrequencyPoint],
    sampling: Sampling,
    most: usize,
) -> Result<Vec<RationalFit>, IdentError> {
    let mut fits = vec![fit_rational(points, sampling, 0, 0)?];
    for order in 1..=most {
        for zeros in [0, order - 1, order]
            .into_iter()
            .skip(usize::from(order == 1))
        {
            if let Ok(fit) = fit_rational(points, sampling, order, zeros) {
                fits.push(fit);
            }
        }
    }
    fits.sort_by(|a, b| a.aicc.total_cmp(&b.aicc));
    // If the criterion hardly separates some fits, prefer the fewest parameters, then the lower order. Zeros and poles that are
    // not needed trade against the delay.
    let best = fits[0].aicc;
    let size = |f: &RationalFit| (f.order + f.numerator.len(), f.order);
    let simplest = (0..fits.len())
        .filter(|&i| fits[i].aicc <= best + 6.0)
        .min_by_key(|&i| size(&fits[i]));
    if let Some(i) = simplest {
        fits[..=i].rotate_right(1);
    }
    Ok(fits)
}

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_numeric::Random;

    fn points_of(
        truth: &PartialFractions,
        delay_s: f64,
        sampling: Sampling,
        relative: f64,
    ) -> Vec<FrequencyPoint> {
        let mut random = Random::new(8);
        (1..40)
            .map(|i| {
                let frequency_hz = 5.0 * f64::from(i);
                let exact = truth.sampled_response(frequency_hz, delay_s, sampling);
                let sd = relative * exact.norm() / 2f64.sqrt();
                FrequencyPoint {
                    frequency_hz,
                    response: exact + Complex::new(sd * random.normal(), sd * random.normal()),
                    scatter_variance: 2.0 * sd * sd,
                    variance: 2.0 * sd * sd,
                    variance_dof: 1e6,
                    coherence: 1.0,
                    input: Complex::from(1.0),
                    output: exact,
                    block_errors: Vec::new(),
                    rows: 1000,
                    later_s: 0.0,
                    velocity_changes: 0.0,
                    spread: 0.0,
                }
            })
            .collect()
    }

    #[test]
    fn a_resonance_with_delay_is_found_with_its_order_frequency_and_damping() {
        let (w, damping) = (2.0 * std::f64::consts::PI * 90.0, 0.08);
        let truth = fractions(&[3.0 * w * w], &[1.0, 2.0 * damping * w, w * w]);
        for hold in [Hold::ZeroOrder, Hold::None] {
            let sampling = Sampling {
                period_s: 1e-3,
                exposure_s: 0.0,
                hold,
            };
            let points = points_of(&truth, 0.0013, sampling, 0.003);
            let fits = fit_orders(&points, sampling, 3).unwrap();
            let best = &fits[0];
            assert_eq!(best.order, 2, "{best:?}");
            assert!((best.denominator[2].sqrt() / w - 1.0).abs() < 2e-3);
            assert!(
                (best.delay_s - 0.0013).abs() < 3.0 * best.delay_sd_s + 1e-6,
                "{best:?}"
            );
            assert!((best.response(1.0).norm() - 3.0).abs() < 0.02);
        }
    }

    #[test]
    fn one_line_supports_a_gain_and_a_lag_and_nothing_more() {
        let truth = fractions(&[2.0], &[1.0]);
        let sampling = Sampling {
            period_s: 5e-3,
            exposure_s: 0.0,
            hold: Hold::None,
        };
        let mut points = points_of(&truth, 0.003, sampling, 1e-4);
        points.truncate(1);
        let fits = fit_orders(&points, sampling, 3).unwrap();
        assert_eq!(fits.len(), 1);
        assert!(
            (fits[0].delay_s - 0.003).abs() < 1e-4 && (fits[0].numerator[0] - 2.0).abs() < 1e-2
        );
    }
}
