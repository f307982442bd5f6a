//! What a foreign record was excited with, and a frequency response from records without a known excitation.
//!
//! [`find_lines`] looks for sines in an input; [`welch`] estimates a response from averaged spectra (H1) where the
//! input is broadband. H1 is biased in closed loop, where the input carries the output's noise: records with a known
//! excitation go through [`crate::frequency_response`].

use nalgebra::Complex;
use realfft::RealFftPlanner;

use crate::frequency_response::FrequencyPoint;
use crate::tone_fit::{ToneFit, Whitening, fit_block};

/// The sines that an input consists of.
#[derive(Debug, Clone, PartialEq)]
pub struct Lines {
    /// Frequencies, Hz, strongest first.
    pub frequency_hz: Vec<f64>,
    /// Peak amplitudes, in the input's unit.
    pub amplitude: Vec<f64>,
    /// Share of the input's variance (offset and ramp aside) that the lines explain, 0 to 1.
    pub explained: f64,
}

const LEVELS: ToneFit = ToneFit {
    drift_degree: 1,
    whitening: Whitening::Levels,
};

/// Finds at most `most` sines in `signal` by taking off the strongest again and again; stops when 99.9 % of the
/// variance is explained or a further line would add less than 0.05 %.
pub fn find_lines(signal: &[f64], period_s: f64, most: usize) -> Lines {
    let n = signal.len();
    let Some(base) = fit_block(signal, 0, n, period_s, &[], LEVELS) else {
        return Lines {
            frequency_hz: Vec::new(),
            amplitude: Vec::new(),
            explained: 0.0,
        };
    };
    let total = base.residual_variance;
    let bin = 1.0 / (n as f64 * period_s);
    let mut lines: Vec<f64> = Vec::new();
    let mut left = total;
    while lines.len() < most && total > 0.0 && left > 1e-3 * total {
        let residual = residual_of(signal, period_s, &lines);
        let Some(peak) = strongest(&residual, period_s) else {
            break;
        };
        let cost = |f: f64| {
            let mut trial = lines.clone();
            trial.push(f);
            fit_block(signal, 0, n, period_s, &trial, LEVELS)
                .map_or(f64::INFINITY, |b| b.residual_variance)
        };
        let refined = golden(peak - bin, peak + bin, &cost);
        let after = cost(refined);
        if left - after < 5e-4 * total {
            break;
        }
        lines.push(refined);
        left = after;
    }
    let amplitude: Vec<f64> = fit_block(signal, 0, n, period_s, &lines, LEVELS)
        .map(|b| b.phasors.iter().map(|p| p.norm()).collect())
        .unwrap_or_default();
    let mut order: Vec<usize> = (0..amplitude.len()).collect();
    order.sort_by(|&a, &b| amplitude[b].total_cmp(&amplitude[a]));
    Lines {
        frequency_hz: order.iter().map(|&i| lines[i]).collect(),
        amplitude: order.iter().map(|&i| amplitude[i]).collect(),
        explained: if total > 0.0 { 1.0 - left / total } else { 0.0 },
    }
}

/// `signal` less its sines, offset and ramp; `NaN` rows become 0.
pub fn residual_of(signal: &[f64], period_s: f64, lines: &[f64]) -> Vec<f64> {
    let n = signal.len();
    let phasors = fit_block(signal, 0, n, period_s, lines, LEVELS)
        .map(|b| b.phasors)
        .unwrap_or_default();
    let two_pi = 2.0 * std::f64::consts::PI;
    let rest: Vec<f64> = signal
        .iter()
        .enumerate()
        .map(|(k, x)| {
            let t = k as f64 * period_s;
            let tones: f64 = phasors
                .iter()
                .zip(lines)
                .map(|(p, f)| (p * Complex::from_polar(1.0, two_pi * f * t)).re)
                .sum();
            x - tones
        })
        .collect();
    detrended(&rest)
}

fn detrended(signal: &[f64]) -> Vec<f64> {
    let n = signal.len() as f64;
    let (mut count, mut s1, mut sx, mut sxx, mut sxy) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for (k, y) in signal.iter().enumerate().filter(|(_, y)| y.is_finite()) {
        let x = k as f64 - 0.5 * n;
        count += 1.0;
        s1 += y;
        sx += x;
        sxx += x * x;
        sxy += x * y;
    }
    if count < 2.0 {
        return vec![0.0; signal.len()];
    }
    let slope = (count * sxy - sx * s1) / (count * sxx - sx * sx);
    let offset = (s1 - slope * sx) / count;
    let line = |k: usize| offset + slope * (k as f64 - 0.5 * n);
    signal
        .iter()
        .enumerate()
        .map(|(k, y)| if y.is_finite() { y - line(k) } else { 0.0 })
        .collect()
}

fn hann(n: usize) -> Vec<f64> {
    (0..n)
        .map(|k| 0.5 - 0.5 * (2.0 * std::f64::consts::PI * (k as f64 + 0.5) / n as f64).cos())
        .collect()
}

fn windowed_spectrum(signal: &[f64]) -> Vec<Complex<f64>> {
    let plan = RealFftPlanner::<f64>::new().plan_fft_forward(signal.len());
    let mut input: Vec<f64> = signal
        .iter()
        .zip(hann(signal.len()))
        .map(|(x, w)| x * w)
        .collect();
    let mut output = plan.make_output_vec();
    match plan.process(&mut input, &mut output) {
        Ok(()) => output.iter().map(|c| Complex::new(c.re, c.im)).collect(),
        // Only wrong lengths are errors, and the plan made the buffers.
        Err(_) => Vec::new(),
    }
}

fn strongest(residual: &[f64], period_s: f64) -> Option<f64> {
    if residual.len() < 16 {
        return None;
    }
    let spectrum = windowed_spectrum(residual);
    let best = (1..spectrum.len().saturating_sub(1))
        .max_by(|&a, &b| spectrum[a].norm_sqr().total_cmp(&spectrum[b].norm_sqr()))?;
    Some(best as f64 / (residual.len() as f64 * period_s))
}

fn golden(low: f64, high: f64, cost: &impl Fn(f64) -> f64) -> f64 {
    let ratio = 0.618_033_988_749_894_8;
    let (mut a, mut b) = (low, high);
    let (mut c, mut d) = (b - ratio * (b - a), a + ratio * (b - a));
    let (mut at_c, mut at_d) = (cost(c), cost(d));
    for _ in 0..40 {
        if at_c < at_d {
            (b, d, at_d) = (d, c, at_c);
            c = b - ratio * (b - a);
            at_c = cost(c);
        } else {
            (a, c, at_c) = (c, d, at_d);
            d = a + ratio * (b - a);
            at_d = cost(d);
        }
        if b - a < 1e-7 * (high - low) {
            break;
        }
    }
    0.5 * (a + b)
}

/// Response by averaged spectra (H1, Hann windows overlapping by half, each stretch detrended), `stretch` rows each.
/// Points whose coherence is below `least_coherence` are left out. Increments of both signals are used when
/// `difference` is set (an integrating plant), which leaves their ratio as it is.
pub fn welch(
    input: &[f64],
    output: &[f64],
    period_s: f64,
    stretch: usize,
    least_coherence: f64,
    difference: bool,
) -> Vec<FrequencyPoint> {
    let stretch = stretch.max(16).min(input.len());
    let prepared = |x: &[f64]| -> Vec<f64> {
        if difference {
            x.windows(2).map(|w| w[1] - w[0]).collect()
        } else {
            x.to_vec()
        }
    };
    let (u, y) = (prepared(input), prepared(output));
    let bins = stretch / 2 + 1;
    let (mut uu, mut yy, mut yu) = (
        vec![0.0; bins],
        vec![0.0; bins],
        vec![Complex::from(0.0); bins],
    );
    let mut count = 0.0;
    let mut start = 0;
    while start + stretch <= u.len() {
        let (a, b) = (&u[start..start + stretch], &y[start..start + stretch]);
        start += (stretch / 2).max(1);
        if a.iter().chain(b).any(|v| !v.is_finite()) {
            continue;
        }
        let (fu, fy) = (
            windowed_spectrum(&detrended(a)),
            windowed_spectrum(&detrended(b)),
        );
        for i in 0..bins.min(fu.len()) {
            uu[i] += fu[i].norm_sqr();
            yy[i] += fy[i].norm_sqr();
            yu[i] += fy[i] * fu[i].conj();
        }
        count += 1.0;
    }
    // Half-overlapping Hann windows are worth about 0.53 (1 + n)/n independent stretches each, for long records.
    let independent: f64 = (0.53 * count + 0.5f64).max(1.0);
    let gain_floor = uu.iter().copied().fold(0.0, f64::max) * 1e-9;
    (2..bins.saturating_sub(1))
        .filter_map(|i| {
            if uu[i] <= gain_floor || yy[i] <= 0.0 {
                return None;
            }
            let response = yu[i] / uu[i];
            let coherence = (yu[i].norm_sqr() / (uu[i] * yy[i])).min(1.0 - 1e-12);
            let variance = response.norm_sqr() * (1.0 - coherence) / (coherence * independent);
            let scale = (2.0 * 8.0 / 3.0 / count).sqrt() / stretch as f64 * 2f64.sqrt();
            (coherence >= least_coherence).then(|| FrequencyPoint {
                frequency_hz: i as f64 / (stretch as f64 * period_s),
                response,
                scatter_variance: variance,
                variance,
                variance_dof: 2.0 * independent,
                coherence,
                input: Complex::from(uu[i].sqrt() * scale),
                output: Complex::from(yy[i].sqrt() * scale),
                block_errors: Vec::new(),
                rows: input.len(),
                later_s: 0.0,
            })
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_numeric::Random;

    #[test]
    fn the_lines_of_a_sum_of_sines_are_found_with_their_amplitudes() {
        let signal: Vec<f64> = (0..4000)
            .map(|k| {
                let t = k as f64 / 200.0;
                1.8 + 1.8 * (2.0 * std::f64::consts::PI * 1.037 * t).sin()
                    + 0.3 * (2.0 * std::f64::consts::PI * 13.4 * t).cos()
            })
            .collect();
        let lines = find_lines(&signal, 1.0 / 200.0, 8);
        assert_eq!(lines.frequency_hz.len(), 2, "{lines:?}");
        assert!(
            (lines.frequency_hz[0] - 1.037).abs() < 1e-5 && (lines.amplitude[0] - 1.8).abs() < 1e-4
        );
        assert!(
            (lines.frequency_hz[1] - 13.4).abs() < 1e-4 && (lines.amplitude[1] - 0.3).abs() < 1e-4
        );
        assert!(lines.explained > 0.999);
    }

    #[test]
    fn averaged_spectra_of_a_first_order_lag_follow_its_closed_form() {
        let mut random = Random::new(2);
        let pole: f64 = 0.8;
        let mut x = 0.0;
        let (mut u, mut y) = (Vec::new(), Vec::new());
        for _ in 0..40_000 {
            let input = random.normal();
            u.push(input);
            y.push(x + 0.05 * random.normal());
            x = pole * x + (1.0 - pole) * input;
        }
        let points = welch(&u, &y, 1e-3, 512, 0.5, false);
        assert!(points.len() > 150);
        let mut outside = 0;
        for p in &points {
            let z = Complex::from_polar(1.0, 2.0 * std::f64::consts::PI * p.frequency_hz * 1e-3);
            let exact = (1.0 - pole) / (z - pole);
            outside += usize::from((p.response - exact).norm_sqr() > 4.0 * p.variance + 1e-5);
        }
        assert!(outside * 20 < points.len(), "{outside} of {}", points.len());
    }
}
