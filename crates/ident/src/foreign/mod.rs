//! Identification of records of any rig: input and output columns at a rate, plant unknown.
//!
//! The search finds lines in the input, then coherent gain and lag at each. It lists harmonics of the output that the input
//! lacks, because no linear model makes them. For a broadband input it averages spectra. Not for naming the cause of the
//! harmonics: that is reconciliation.

mod result;

pub use result::{Basis, Excitation, ForeignResult, ForeignSettings, Harmonic, LineResult};

use crate::error::IdentError;
use crate::feedback::{by_reference, feedback};
use crate::frequency_response::{DetectionLine, DrivenStretch, FrequencyPoint, Settings, measure};
use crate::rational::{RationalFit, fit_orders};
use crate::sampled::Sampling;
use crate::spectral::{find_lines, residual_of, welch};
use crate::tone_fit::{ToneFit, Whitening};
use cellpos_numeric::statistics::student_t_quantile;
use nalgebra::Complex;

fn rms(x: &[f64]) -> f64 {
    (x.iter().map(|v| v * v).sum::<f64>() / x.len().max(1) as f64).sqrt()
}

/// Identifies a record.
///
/// # Errors
/// [`IdentError::Lengths`], [`IdentError::OutOfRange`] (rate, constant input), [`IdentError::TooShort`],
/// [`IdentError::NoInput`].
pub fn identify(
    input: &[f64],
    output: &[f64],
    settings: &ForeignSettings,
) -> Result<ForeignResult, IdentError> {
    if input.len() != output.len() {
        return Err(IdentError::Lengths {
            input: input.len(),
            output: output.len(),
        });
    }
    if !(settings.rate_hz.is_finite() && settings.rate_hz > 0.0) {
        return Err(IdentError::OutOfRange {
            key: "rate_hz",
            value: settings.rate_hz,
            unit: "Hz",
            expected: "the rows per second, above 0",
        });
    }
    let n = input.len();
    if n < 64 {
        return Err(IdentError::TooShort {
            what: "an identification",
            rows: n,
            needed: 64,
        });
    }
    let sampling = settings.sampling();
    let period_s = sampling.period_s;
    let input_rms = rms(&residual_of(input, period_s, &[]));
    let size = input.iter().fold(0.0f64, |a, v| a.max(v.abs()));
    if input_rms.is_nan() || input_rms <= 1e-9 * size.max(f64::MIN_POSITIVE) {
        return Err(IdentError::OutOfRange {
            key: "input_rms",
            value: input_rms,
            unit: "(input unit)",
            expected: "an input that moves: this column is constant or a straight line",
        });
    }
    let found = find_lines(input, period_s, 24);
    let output_rms = rms(&residual_of(output, period_s, &[]));
    let lowest = found
        .frequency_hz
        .iter()
        .copied()
        .fold(f64::INFINITY, f64::min);
    let periods = n as f64 * period_s * lowest;
    if found.explained > 0.97 && periods >= 3.0 {
        from_lines(
            input,
            output,
            sampling,
            &found.frequency_hz,
            settings,
            output_rms,
        )
    } else {
        from_spectra(input, output, sampling, settings, output_rms)
    }
}

/// Identifies a record of a closed loop by its reference.
///
/// # Errors
/// As [`identify`].
pub fn identify_in_loop(
    reference: &[f64],
    input: &[f64],
    output: &[f64],
    settings: &ForeignSettings,
) -> Result<ForeignResult, IdentError> {
    let n = reference.len();
    if n != input.len() || n != output.len() {
        return Err(IdentError::Lengths {
            input: input.len().min(n),
            output: output.len(),
        });
    }
    if n < 512 {
        return Err(IdentError::TooShort {
            what: "an identification in a loop",
            rows: n,
            needed: 512,
        });
    }
    let sampling = settings.sampling();
    let period_s = sampling.period_s;
    let output_rms = rms(&residual_of(&bridged(output), period_s, &[]));
    let nothing = |share| ForeignResult::nothing(sampling, output_rms, share);
    let moved = rms(&residual_of(reference, period_s, &[]));
    if moved.is_nan() || moved < 1e-6 {
        return Ok(nothing(feedback(input, output).map(|found| found.share)));
    }
    let found = find_lines(reference, period_s, 24);
    let lowest = found
        .frequency_hz
        .iter()
        .copied()
        .fold(f64::INFINITY, f64::min);
    let mut result = if found.explained > 0.97 && n as f64 * period_s * lowest >= 3.0 {
        from_lines(
            input,
            &bridged(output),
            sampling,
            &found.frequency_hz,
            settings,
            output_rms,
        )?
    } else {
        const LEAST_COHERENCE: f64 = 0.5;
        let stretch = (n / 10).clamp(256, 4096);
        let mut points = by_reference(
            reference,
            input,
            &bridged(output),
            period_s,
            stretch,
            LEAST_COHERENCE,
        );
        if points.len() < 3 {
            return Ok(nothing(feedback(input, output).map(|found| found.share)));
        }
        for p in &mut points {
            p.variance = p.variance.max(p.response.norm_sqr() * 1e-8);
        }
        let models = stable(fit_orders(&points, sampling, settings.most_order)?, &points);
        ForeignResult {
            points,
            models,
            ..nothing(None)
        }
    };
    result.basis = Basis::Reference;
    Ok(result)
}

/// Finding for a record in closed loop without a reference.
pub fn nothing_to_tell(
    output: &[f64],
    settings: &ForeignSettings,
    share: Option<f64>,
) -> ForeignResult {
    let sampling = settings.sampling();
    let output_rms = rms(&residual_of(&bridged(output), sampling.period_s, &[]));
    ForeignResult::nothing(sampling, output_rms, share)
}

/// A series with its gaps bridged by straight lines: one lost frame must not cost a stretch of thousands of rows.
pub fn bridged(series: &[f64]) -> Vec<f64> {
    let known: Vec<usize> = (0..series.len())
        .filter(|&k| series[k].is_finite())
        .collect();
    let mut bridged = series.to_vec();
    for (k, value) in bridged.iter_mut().enumerate() {
        if value.is_finite() {
            continue;
        }
        let after = known.partition_point(|&i| i < k);
        let before = after.checked_sub(1).and_then(|i| known.get(i)).copied();
        *value = match (before, known.get(after).copied()) {
            (Some(a), Some(b)) => {
                series[a] + (series[b] - series[a]) * (k - a) as f64 / (b - a) as f64
            }
            (Some(only), None) | (None, Some(only)) => series[only],
            (None, None) => 0.0,
        };
    }
    bridged
}

/// Drops the models with an unstable pole: the plant is passive, so such a pole comes from noise or from the controller. A pole
/// to the right of zero by less than its error counts as an integrator.
fn stable(models: Vec<RationalFit>, points: &[FrequencyPoint]) -> Vec<RationalFit> {
    // One or two lines give gain and lag there, but no model.
    if points.len() < 3 {
        return Vec::new();
    }
    let lowest_hz = points
        .iter()
        .map(|p| p.frequency_hz)
        .fold(f64::INFINITY, f64::min);
    let hair = 0.02 * std::f64::consts::TAU * lowest_hz;
    models
        .into_iter()
        .filter_map(|mut model| {
            if model.poles.iter().all(|pole| pole.re <= 0.0) {
                return Some(model);
            }
            // A small pole is -c/b of a denominator that ends in b s + c: twice its standard deviation is that of c over b.
            let error = (model.denominator.iter().rev().nth(1))
                .zip(model.denominator_sd.last())
                .map_or(0.0, |(b, sd)| 2.0 * sd / b.abs());
            let least = if error.is_finite() {
                hair.max(error)
            } else {
                hair
            };
            if model
                .poles
                .iter()
                .any(|pole| pole.re > 0.0 && (pole.im != 0.0 || pole.re > least))
            {
                return None;
            }
            for pole in &mut model.poles {
                pole.re = pole.re.min(0.0);
            }
            let mut denominator = vec![Complex::from(1.0)];
            for pole in &model.poles {
                let mut next = vec![Complex::from(0.0); denominator.len() + 1];
                for (k, c) in denominator.iter().enumerate() {
                    next[k] += c;
                    next[k + 1] -= c * pole;
                }
                denominator = next;
            }
            model.denominator = denominator.iter().map(|c| c.re).collect();
            Some(model)
        })
        .collect()
}

fn from_lines(
    input: &[f64],
    output: &[f64],
    sampling: Sampling,
    lines_hz: &[f64],
    settings: &ForeignSettings,
    output_rms: f64,
) -> Result<ForeignResult, IdentError> {
    let period_s = sampling.period_s;
    let resolution = 1.5 / (input.len() as f64 * period_s);
    let mut wanted: Vec<(f64, usize, f64)> = Vec::new();
    for &f in lines_hz.iter().take(4) {
        for number in 2..=7usize {
            let at = f * number as f64;
            let free = |g: f64| (g - at).abs() > resolution;
            if at < 0.47 * settings.rate_hz
                && lines_hz.iter().all(|&g| free(g))
                && wanted.iter().all(|w| free(w.2))
            {
                wanted.push((f, number, at));
            }
        }
    }
    let detection_hz: Vec<f64> = wanted.iter().map(|w| w.2).collect();
    let mut all = lines_hz.to_vec();
    all.extend(&detection_hz);
    let rest = residual_of(output, period_s, &all);
    let increments: f64 = rest.windows(2).map(|w| (w[1] - w[0]).powi(2)).sum();
    let levels: f64 = rest.iter().map(|r| r * r).sum();
    // Durbin and Watson: far below 2 the residual is a random walk.
    let whitening = if levels > 0.0 && increments / levels < 0.1 {
        Whitening::Increments
    } else {
        Whitening::Levels
    };
    let segment = DrivenStretch {
        input,
        output,
        from: 0,
        to: input.len(),
        period_s,
        lines_hz,
        detection_hz: &detection_hz,
    };
    let fit = ToneFit {
        drift_degree: 2,
        whitening,
    };
    let response = measure(
        &segment,
        &Settings {
            fit,
            min_periods: 2.0,
            most_blocks: 20,
            ..Settings::default()
        },
    )?;
    let mut points = response.points.clone();
    let lines: Vec<LineResult> = points.iter().map(line_result).collect();
    let harmonics: Vec<Harmonic> = wanted
        .iter()
        .zip(&response.detection)
        .filter_map(|(w, d)| harmonic(*w, d, &points))
        .collect();
    points.sort_by(|a, b| a.frequency_hz.total_cmp(&b.frequency_hz));
    let floor = |p: &FrequencyPoint| p.response.norm_sqr() * 1e-12;
    for p in &mut points {
        p.variance = p.variance.max(floor(p));
    }
    let models = stable(fit_orders(&points, sampling, settings.most_order)?, &points);
    let linear_residual_rms = Some(rms(&residual_of(output, period_s, lines_hz)));
    Ok(ForeignResult {
        basis: Basis::Input,
        excitation: Excitation::Lines,
        lines,
        points,
        harmonics,
        models,
        output_rms,
        linear_residual_rms,
        sampling,
    })
}

fn from_spectra(
    input: &[f64],
    output: &[f64],
    sampling: Sampling,
    settings: &ForeignSettings,
    output_rms: f64,
) -> Result<ForeignResult, IdentError> {
    let stretch = (input.len() / 10).clamp(64, 4096);
    let spread = |x: &[f64]| rms(&residual_of(x, sampling.period_s, &[]));
    let change: Vec<f64> = output.windows(2).map(|w| w[1] - w[0]).collect();
    let difference = spread(&change) < 0.1 * spread(output);
    let all = welch(input, output, sampling.period_s, stretch, 0.4, difference);
    if all.len() < 3 {
        return Err(IdentError::TooShort {
            what: "a coherent frequency response (coherence above 0.4)",
            rows: input.len(),
            needed: 10 * input.len(),
        });
    }
    // Evenly in the logarithm, so that the many high bins do not drown the few low ones.
    let keep = 80usize;
    let (low, high) = (all[0].frequency_hz, all[all.len() - 1].frequency_hz);
    let mut points: Vec<FrequencyPoint> = Vec::new();
    let mut next = low;
    for p in all {
        if p.frequency_hz >= next * (1.0 - 1e-9) {
            next = p.frequency_hz * (high / low).powf(1.0 / keep as f64);
            points.push(p);
        }
    }
    for p in &mut points {
        p.variance = p.variance.max(p.response.norm_sqr() * 1e-8);
    }
    let models = stable(fit_orders(&points, sampling, settings.most_order)?, &points);
    Ok(ForeignResult {
        basis: Basis::Input,
        excitation: Excitation::Broadband,
        lines: Vec::new(),
        points,
        harmonics: Vec::new(),
        models,
        output_rms,
        linear_residual_rms: None,
        sampling,
    })
}

fn line_result(p: &FrequencyPoint) -> LineResult {
    let t = student_t_quantile(0.975, p.variance_dof.min(1e6));
    let sd = (0.5 * p.variance).sqrt();
    let phase_deg = p.phase_deg();
    LineResult {
        frequency_hz: p.frequency_hz,
        gain: p.response.norm(),
        gain_ci95: t * sd,
        phase_deg,
        phase_ci95_deg: (t * sd / p.response.norm()).to_degrees(),
        lag_ms: -phase_deg / 360.0 / p.frequency_hz * 1e3,
        coherence: p.coherence,
    }
}

fn harmonic(
    (fundamental_hz, number, _): (f64, usize, f64),
    d: &DetectionLine,
    points: &[FrequencyPoint],
) -> Option<Harmonic> {
    let p = points.iter().find(|p| p.frequency_hz == fundamental_hz)?;
    let output_ratio = d.output.norm() / p.output.norm();
    let input_ratio = d.input.norm() / p.input.norm();
    Some(Harmonic {
        fundamental_hz,
        number,
        output_ratio,
        input_ratio,
        p_value: d.p_value,
        // A linear plant passes the input's own harmonics, at most a few times better than the fundamental.
        unexplained: d.p_value < 1e-3 && output_ratio > 1e-3 && output_ratio > 5.0 * input_ratio,
    })
}
