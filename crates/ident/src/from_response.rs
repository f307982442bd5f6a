//! A base model from a frequency response measured elsewhere: a table of frequency and complex gain.
//!
//! Its errors are unknown, so each point is weighted by its own size. The form is chosen as in [`crate::base`]: a fit to every
//! other point predicts the rest, and each further number must lower that error. Not for records in time: see [`crate::base`].

use crate::base::Form;
use crate::error::IdentError;
use crate::frequency_response::FrequencyPoint;
use crate::rational::{RationalFit, fit_with};
use crate::sampled::{Hold, Sampling};
use nalgebra::Complex;
use std::f64::consts::TAU;

/// One point of a measured response.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measured {
    /// Frequency, Hz.
    pub hz: f64,
    /// Output over input.
    pub response: Complex<f64>,
}

impl Measured {
    /// From a ratio of amplitudes and a phase in rad.
    pub fn polar(hz: f64, gain: f64, phase_rad: f64) -> Self {
        Self {
            hz,
            response: Complex::from_polar(gain, phase_rad),
        }
    }

    /// From real and imaginary part.
    pub fn parts(hz: f64, re: f64, im: f64) -> Self {
        Self {
            hz,
            response: Complex::new(re, im),
        }
    }

    /// Whether all its parameters have a value.
    pub fn is_known(&self) -> bool {
        self.hz.is_finite() && self.response.re.is_finite() && self.response.im.is_finite()
    }
}

/// A model of a response, with its residual.
#[derive(Debug, Clone, PartialEq)]
pub struct ResponseFit {
    /// What was fitted.
    pub form: Form,
    /// The model.
    pub model: RationalFit,
    /// RMS of measured over fitted response, minus one.
    pub relative_error: f64,
    /// The same for every second point, predicted by a fit to the others.
    pub held_out_error: f64,
    /// Largest deviation of the gain, dB.
    pub worst_db: f64,
    /// Largest deviation of the phase, deg.
    pub worst_deg: f64,
}

/// Each further number must reduce the prediction error to this part of it.
const PER_NUMBER: f64 = 0.9;

/// Relative errors below this come from the instrument and from the digits in the file.
const AS_GOOD_AS_NONE: f64 = 1e-3;

/// Assumed relative error of the points; their spread about the fit then scales it.
const NOMINAL: f64 = 1e-6;

/// Fits a response with the requested form, or with the simplest up to `most_order` that predicts every second point as well as
/// any other.
///
/// # Errors
/// [`IdentError::TooFewPoints`], [`IdentError::OutOfRange`] (a frequency or a response without a value), [`IdentError::NoFit`].
pub fn fit_response(
    measured: &[Measured],
    asked: Option<Form>,
    most_order: usize,
) -> Result<ResponseFit, IdentError> {
    if let Some(p) = measured.iter().find(|p| !(p.hz > 0.0 && p.hz.is_finite())) {
        return Err(IdentError::OutOfRange {
            key: "frequency",
            value: p.hz,
            unit: "Hz",
            expected: "frequencies above 0",
        });
    }
    if let Some(p) = (measured.iter()).find(|p| !(p.response.norm().is_normal())) {
        return Err(IdentError::OutOfRange {
            key: "gain",
            value: p.response.norm(),
            unit: "(output over input)",
            expected: "a gain that is neither 0 nor infinite",
        });
    }
    let mut points = measured.to_vec();
    points.sort_by(|a, b| a.hz.total_cmp(&b.hz));
    let longest_s = longest_delay_s(&points);
    let mut best: Option<(f64, ResponseFit)> = None;
    let mut trouble = None;
    for form in forms(asked, most_order) {
        match trial(&points, form, longest_s) {
            Ok(fit) => {
                let numbers = form.order + form.zeros.unwrap_or(0) + usize::from(form.delay);
                let cost =
                    fit.held_out_error.max(AS_GOOD_AS_NONE).ln() - PER_NUMBER.ln() * numbers as f64;
                if best.as_ref().is_none_or(|(least, _)| cost < *least) {
                    best = Some((cost, fit));
                }
            }
            Err(e) => trouble = Some(e),
        }
    }
    match (best, trouble) {
        (Some((_, fit)), _) => Ok(fit),
        (None, Some(trouble)) => Err(trouble),
        (None, None) => Err(NO_FIT),
    }
}

const NO_FIT: IdentError = IdentError::NoFit {
    what: "a model of the frequency response",
    reason: "no stable model of the form follows it",
};

/// The forms that are tried.
fn forms(asked: Option<Form>, most_order: usize) -> Vec<Form> {
    let orders = match asked {
        Some(form) => form.order..=form.order,
        None => 0..=most_order,
    };
    let mut all = Vec::new();
    for order in orders {
        let zeros: Vec<usize> = match asked.and_then(|form| form.zeros) {
            Some(zeros) => vec![zeros],
            None => (0..=order).collect(),
        };
        let either = |stated: Option<bool>| stated.map_or(vec![false, true], |one| vec![one]);
        for integrating in either(asked.map(|form| form.integrating)) {
            for delay in either(asked.map(|form| form.delay)) {
                for &zeros in &zeros {
                    let form = Form {
                        order,
                        zeros: Some(zeros),
                        delay,
                        integrating,
                    };
                    if !integrating || (order > 0 && zeros < order) {
                        all.push(form);
                    }
                }
            }
        }
    }
    all
}

/// The longest delay that the phase leaves room for, s.
fn longest_delay_s(points: &[Measured]) -> f64 {
    let mut phase = 0.0;
    for w in points.windows(2) {
        phase += (w[1].response / w[0].response).arg();
    }
    let (Some(first), Some(last)) = (points.first(), points.last()) else {
        return 0.0;
    };
    let turned = first.response.arg() + phase;
    (1.2 * turned.abs() / (TAU * last.hz)).max(1.0 / last.hz)
}

/// Fits all points, then every second one, which must predict the others.
fn trial(points: &[Measured], form: Form, longest_s: f64) -> Result<ResponseFit, IdentError> {
    let all = fitted(points, form, longest_s)?;
    let (mut sum, mut count) = (0.0, 0);
    for parity in 0..2 {
        let of = |wanted: usize| -> Vec<Measured> {
            let every = points.iter().enumerate();
            every
                .filter(|(k, _)| k % 2 == wanted)
                .map(|(_, p)| *p)
                .collect()
        };
        let half = fitted(&of(parity), form, longest_s)?;
        for p in of(1 - parity) {
            sum += off(&half, &p).norm_sqr();
            count += 1;
        }
    }
    let errors: Vec<Complex<f64>> = points.iter().map(|p| off(&all, p)).collect();
    let rms = |sum: f64, count: usize| (sum / count.max(1) as f64).sqrt();
    let most = |of: fn(&Complex<f64>) -> f64| errors.iter().map(of).fold(0.0, f64::max);
    Ok(ResponseFit {
        form,
        relative_error: rms(errors.iter().map(|e| e.norm_sqr()).sum(), errors.len()),
        held_out_error: rms(sum, count),
        worst_db: most(|e| (20.0 * (e + 1.0).norm().log10()).abs()),
        worst_deg: most(|e| (e + 1.0).arg().to_degrees().abs()),
        model: all,
    })
}

/// Measured over fitted response, minus one.
fn off(model: &RationalFit, p: &Measured) -> Complex<f64> {
    let delayed = model.response(p.hz) * Complex::from_polar(1.0, -TAU * p.hz * model.delay_s);
    p.response / delayed - 1.0
}

fn fitted(points: &[Measured], form: Form, longest_s: f64) -> Result<RationalFit, IdentError> {
    let poles = form.order - usize::from(form.integrating);
    let zeros = form.zeros.unwrap_or(0);
    let points: Vec<FrequencyPoint> = points.iter().map(|p| weighed(p, form)).collect();
    let sampling = Sampling {
        // Starts of the delay are nine half periods long.
        period_s: longest_s / 4.5,
        exposure_s: 0.0,
        hold: Hold::None,
    };
    // Without the pole at zero, the rest must not have more zeros than poles.
    if zeros > poles {
        return Err(NO_FIT);
    }
    let mut model = fit_with(&points, sampling, [poles, zeros], form.delay)?;
    let grows = model.poles.iter().any(|p| p.re >= 0.0);
    if grows || model.delay_s < 0.0 || !model.chi2.is_finite() {
        return Err(NO_FIT);
    }
    if form.integrating {
        model.order += 1;
        model.denominator.push(0.0);
        model.denominator_sd.push(0.0);
        model.poles.push(Complex::from(0.0));
    }
    Ok(model)
}

/// A point as the fit uses it: for an integrating plant, without the pole at zero.
fn weighed(p: &Measured, form: Form) -> FrequencyPoint {
    let integrator = match form.integrating {
        true => Complex::new(0.0, TAU * p.hz),
        false => Complex::from(1.0),
    };
    let response = p.response * integrator;
    let variance = response.norm_sqr() * NOMINAL * NOMINAL;
    FrequencyPoint {
        frequency_hz: p.hz,
        response,
        scatter_variance: variance,
        variance,
        variance_dof: f64::INFINITY,
        coherence: 1.0,
        input: Complex::from(1.0),
        output: response,
        block_errors: Vec::new(),
        rows: 0,
        later_s: 0.0,
        velocity_changes: 0.0,
        spread: 0.0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A response at 40 frequencies over three decades, 1 % off here and there.
    fn response(
        of: impl Fn(Complex<f64>) -> Complex<f64>,
        delay_s: f64,
        low_hz: f64,
    ) -> Vec<Measured> {
        (0..40)
            .map(|k| {
                let hz = low_hz * 1000f64.powf(f64::from(k) / 39.0);
                let s = Complex::new(0.0, TAU * hz);
                let off = 0.01 * (12.3 * f64::from(k)).sin();
                let response =
                    of(s) * Complex::from_polar(1.0 + off, 0.7 * off - TAU * hz * delay_s);
                Measured { hz, response }
            })
            .collect()
    }

    #[test]
    fn the_form_of_a_resonance_behind_a_delay_is_found() {
        // 4 Hz, damped by 0.2; 20 ms late.
        let w = TAU * 4.0;
        let points = response(|s| 3.0 * w * w / (s * s + 0.4 * w * s + w * w), 0.02, 0.05);
        let fit = fit_response(&points, None, 4).unwrap();
        assert_eq!((fit.form.order, fit.form.delay), (2, true), "{}", fit.form);
        assert!((fit.model.delay_s / 0.02 - 1.0).abs() < 0.02, "{fit:?}");
        assert!((fit.model.denominator[2].sqrt() / w - 1.0).abs() < 0.01);
        assert!(fit.relative_error < 0.02);
    }

    #[test]
    fn an_integrator_is_told_from_a_slow_lag() {
        let points = response(|s| 2.0 / (s * (0.1 * s + 1.0)), 0.0, 0.01);
        let fit = fit_response(&points, None, 3).unwrap();
        assert!(fit.form.integrating, "{}", fit.form);
        assert_eq!(fit.model.denominator.last(), Some(&0.0));
        let points = response(|s| 2.0 / (5.0 * s + 1.0), 0.0, 0.003);
        let fit = fit_response(&points, None, 3).unwrap();
        assert_eq!(
            (fit.form.order, fit.form.integrating),
            (1, false),
            "{}",
            fit.form
        );
    }

    #[test]
    fn what_is_asked_for_is_fitted_and_what_cannot_be_is_said() {
        let points = response(|s| 2.0 / (0.1 * s + 1.0), 0.0, 0.01);
        let form: Form = "order=1,zeros=1".parse().unwrap();
        assert_eq!(fit_response(&points, Some(form), 8).unwrap().form, form);
        assert!(matches!(
            fit_response(&points[..2], Some(form), 8),
            Err(IdentError::TooFewPoints { .. })
        ));
        let mut dead = points.clone();
        dead[3].response = Complex::from(0.0);
        assert!(matches!(
            fit_response(&dead, None, 2),
            Err(IdentError::OutOfRange { key: "gain", .. })
        ));
    }
}
