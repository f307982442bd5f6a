//! Finds the excitation of a foreign record, and measures a frequency response without a known excitation.
//!
//! [`find_lines`] looks for sines in an input; [`welch`] estimates a response from averaged spectra (H1) for a broadband input.
//! H1 is biased in closed loop, because the input carries the output's noise. For records with a known excitation use
//! [`crate::frequency_response`].

use cellpos_numeric::{fft, golden_section};
use nalgebra::Complex;

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

/// Finds at most `most` sines in `signal` by repeatedly removing the strongest. It stops when 99.9 % of the variance is
/// explained, or when a further line would add less than 0.05 %.
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
        let refined = golden_section(peak - bin, peak + bin, 1e-7, cost);
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

/// `signal` minus its sines, offset and ramp; `NaN` rows become 0.
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
    let mut input: Vec<f64> = signal
        .iter()
        .zip(hann(signal.len()))
        .map(|(x, w)| x * w)
        .collect();
    fft::forward(&mut input)
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

/// Response by averaged spectra (H1, Hann windows overlapping by half, each stretch detrended), `stretch` rows each. Points whose
/// coherence is below `least_coherence` are left out. If `difference` is set (an integrating plant), increments of both signals
/// are used; their ratio is the same.
pub fn welch(
    input: &[f64],
    output: &[f64],
    period_s: f64,
    stretch: usize,
    least_coherence: f64,
    difference: bool,
) -> Vec<FrequencyPoint> {
    let prepared = |x: &[f64]| -> Vec<f64> {
        if difference {
            x.windows(2).map(|w| w[1] - w[0]).collect()
        } else {
            x.to_vec()
        }
    };
    let (u, y) = (prepared(input), prepared(output));
    by_reference(&u, &u, &y, period_s, stretch, least_coherence)
}

/// Sums of spectra over stretches, of one bin or of bins that see one line: `r` the instrument, `u` the input, `y` the output.
#[derive(Debug, Clone, Copy)]
struct Sums {
    rr: f64,
    uu: f64,
    yy: f64,
    ur: Complex<f64>,
    yr: Complex<f64>,
    yu: Complex<f64>,
    /// As `ur`, with the input one row later: the phase between the two is the frequency of the power in the bin.
    later: Complex<f64>,
}

impl Sums {
    const ZERO: Self = Self {
        rr: 0.0,
        uu: 0.0,
        yy: 0.0,
        ur: Complex::new(0.0, 0.0),
        yr: Complex::new(0.0, 0.0),
        yu: Complex::new(0.0, 0.0),
        later: Complex::new(0.0, 0.0),
    };

    fn plus(mut self, other: &Self) -> Self {
        self.rr += other.rr;
        self.uu += other.uu;
        self.yy += other.yy;
        self.ur += other.ur;
        self.yr += other.yr;
        self.yu += other.yu;
        self.later += other.later;
        self
    }

    /// Frequency of the power that input and instrument share, rad per row. A window spreads a line over some bins, and each bin
    /// shows the response at the line, not at its own frequency.
    fn turn(&self) -> f64 {
        (self.later * self.ur.conj()).arg()
    }
}

/// Response from input to output by averaged spectra as in [`welch`], with a noise-free instrument (the input itself if it is
/// free of noise). Each point has the frequency of the power that its bins hold; bins that see one line are one point.
pub fn by_reference(
    instrument: &[f64],
    input: &[f64],
    output: &[f64],
    period_s: f64,
    stretch: usize,
    least_coherence: f64,
) -> Vec<FrequencyPoint> {
    let rows = input.len();
    let stretch = stretch.max(16).min(rows.saturating_sub(1));
    let (bins, count) = summed(instrument, input, output, stretch);
    // In long records each of n half-overlapping Hann windows counts as about 0.53 (1 + n)/n independent stretches.
    let independent: f64 = (0.53 * count + 0.5f64).max(1.0);
    let floor = bins.iter().map(|b| b.rr).fold(0.0, f64::max) * 1e-9;
    let width = std::f64::consts::TAU / stretch as f64;
    let inside = bins.len().saturating_sub(1);
    let mut seen: Vec<(f64, Sums)> = (bins.iter().take(inside).skip(2))
        .filter(|b| b.rr > floor && b.uu > 0.0 && b.yy > 0.0)
        .map(|b| (b.turn(), *b))
        .filter(|(turn, _)| *turn > 1.5 * width)
        .collect();
    // The noise bandwidth of the window is 1.5 bins. A bin nearer than that to a stronger one shares its noise and joins its
    // point.
    seen.sort_by(|a, b| b.1.rr.total_cmp(&a.1.rr));
    let mut lines: Vec<(f64, Sums)> = Vec::new();
    for (turn, bin) in seen {
        let near = lines.iter_mut().find(|l| (turn - l.0).abs() < 1.5 * width);
        match near {
            Some((_, line)) => *line = line.plus(&bin),
            None => lines.push((turn, bin)),
        }
    }
    lines.sort_by(|a, b| a.0.total_cmp(&b.0));
    let amplitude = (2.0 * 8.0 / 3.0 / count).sqrt() / stretch as f64 * 2f64.sqrt();
    let point = |s: Sums| {
        let of = |power: f64, cross: Complex<f64>| cross.norm_sqr() / (s.rr * power);
        let coherence = of(s.yy, s.yr).min(of(s.uu, s.ur)).min(1.0 - 1e-12);
        let response = s.yr / s.ur;
        // The part of the output that the input does not cause; in a loop, the noise that the input answers.
        let left = s.yy - 2.0 * (response.conj() * s.yu).re + response.norm_sqr() * s.uu;
        let variance = left.max(0.0) * s.rr / (s.ur.norm_sqr() * independent);
        (coherence >= least_coherence).then(|| FrequencyPoint {
            frequency_hz: s.turn() / (std::f64::consts::TAU * period_s),
            response,
            scatter_variance: variance,
            variance,
            variance_dof: 2.0 * independent,
            coherence,
            input: Complex::from(s.uu.sqrt() * amplitude),
            output: Complex::from(s.yy.sqrt() * amplitude),
            block_errors: Vec::new(),
            rows,
            later_s: 0.0,
            velocity_changes: 0.0,
            spread: 0.0,
        })
    };
    lines.into_iter().filter_map(|(_, s)| point(s)).collect()
}

/// The sums of every bin over the stretches without a gap, and the number of such stretches.
fn summed(r: &[f64], u: &[f64], y: &[f64], stretch: usize) -> (Vec<Sums>, f64) {
    let mut bins = vec![Sums::ZERO; stretch / 2 + 1];
    let mut count = 0.0;
    let mut start = 0;
    while start + stretch < u.len() {
        let of = |x: &[f64]| detrended(&x[start..=start + stretch]);
        let gap = [r, u, y]
            .iter()
            .any(|x| x[start..=start + stretch].iter().any(|v| !v.is_finite()));
        if !gap {
            let input = of(u);
            let now = |x: &[f64]| windowed_spectrum(&x[..stretch]);
            let (fr, fu, fy) = (now(&of(r)), now(&input), now(&of(y)));
            let later = windowed_spectrum(&input[1..]);
            for (i, bin) in bins.iter_mut().enumerate().take(fr.len()) {
                *bin = bin.plus(&Sums {
                    rr: fr[i].norm_sqr(),
                    uu: fu[i].norm_sqr(),
                    yy: fy[i].norm_sqr(),
                    ur: fu[i] * fr[i].conj(),
                    yr: fy[i] * fr[i].conj(),
                    yu: fy[i] * fu[i].conj(),
                    later: later[i] * fr[i].conj(),
                });
            }
            count += 1.0;
        }
        start += (stretch / 2).max(1);
    }
    (bins, count)
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
        assert!(points.len() > 90);
        let mut outside = 0;
        for p in &points {
            let z = Complex::from_polar(1.0, 2.0 * std::f64::consts::PI * p.frequency_hz * 1e-3);
            let exact = (1.0 - pole) / (z - pole);
            outside += usize::from((p.response - exact).norm_sqr() > 4.0 * p.variance + 1e-5);
        }
        assert!(outside * 20 < points.len(), "{outside} of {}", points.len());
    }

    #[test]
    fn bins_that_a_line_leaks_into_show_the_line_once_and_at_its_own_frequency() {
        // Sines one after the other, as a script plays them, through an integrator of 400/s; none is on a bin.
        let lines_hz = [3.3, 11.7, 47.1, 101.3];
        let (mut u, mut y) = (Vec::new(), Vec::new());
        let mut x = 0.0;
        for k in 0..24_000 {
            let line = lines_hz[k / 6000];
            let input = (std::f64::consts::TAU * line * k as f64 * 1e-3).sin();
            u.push(input);
            y.push(x);
            x += 0.4 * input;
        }
        let points = welch(&u, &y, 1e-3, 1400, 0.9, false);
        for line in lines_hz {
            let width = 1e3 / 1400.0;
            let near: Vec<&FrequencyPoint> = (points.iter())
                .filter(|p| (p.frequency_hz - line).abs() < width)
                .collect();
            assert_eq!(near.len(), 1, "{line} Hz: {near:?}");
            let p = near[0];
            assert!((p.frequency_hz - line).abs() < 0.02, "{line} Hz: {p:?}");
            let z = Complex::from_polar(1.0, std::f64::consts::TAU * line * 1e-3);
            let off = (p.response * (z - 1.0) / 0.4 - 1.0).norm();
            assert!(off < 0.02, "{line} Hz: {off}");
        }
    }
}
