//! Measured over simulated response, by a method that is right in open and in closed loop.
//!
//! In a loop the command answers the noise that has moved the bead. So the spectrum of the position over that of the command is in
//! part that of noise over its answer (Ljung, System Identification, 2nd ed., 13.4). Here the joint input-output method is used.
//! The noise is the part that neither the past nor the simulated motion explains: a causal regression, which feedback does not
//! bias because a frame shows only earlier commands. The part of the simulated motion that answers this noise is removed. The rest
//! was driven by reference and excitation: it is the instrument. Without a loop nothing is removed, and the ratio is the usual
//! one.

use crate::dot::dot;
use crate::fit::context::{Context, Fit};
use cellpos_numeric::fft::{self, Complex};
use nalgebra::{DMatrix, DVector};

/// Ratio of the measured to the simulated motion in a band.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct BandRatio {
    /// Middle of the band \[Hz\].
    pub hz: f64,
    /// Gain of measured over simulated \[dB\].
    pub gain_db: f64,
    /// Phase of measured over simulated \[deg\].
    pub phase_deg: f64,
    /// Standard error of the ratio, in parts.
    pub error: f64,
    /// Share of the motion in the band that was driven from outside the loop and not by noise. It is near 1 if the band was
    /// excited beyond the noise. It is near 0 if only noise moved the bead, and in a loop the command that answers it.
    pub coherence: f64,
}

impl BandRatio {
    /// Coherence from which on a ratio says something of the plant.
    pub const SUPPORTED: f64 = 0.9;

    /// Whether the band was excited enough for its ratio to be one of the plant.
    pub fn is_supported(&self) -> bool {
        self.coherence >= Self::SUPPORTED
    }
}

/// Single lags of a regression.
const LAGS: usize = 16;
/// Time constants behind them, samples: a loop answers within a second.
const SLOW: [f64; 6] = [16.0, 32.0, 64.0, 128.0, 256.0, 512.0];

/// What the past of a series can explain causally: its lags from `first` on, and slow averages behind them.
fn past(x: &[f64], first: usize) -> Vec<Vec<f64>> {
    let shifted = |lag: usize| -> Vec<f64> {
        let lag = lag.min(x.len());
        let mut column = vec![0.0; lag];
        column.extend_from_slice(&x[..x.len() - lag]);
        column
    };
    let mut columns: Vec<Vec<f64>> = (first..first + LAGS).map(shifted).collect();
    let behind = shifted(first + LAGS);
    for samples in SLOW {
        let keep = (-1.0 / samples).exp();
        let mut state = 0.0;
        let average = |x: &f64| {
            state = keep * state + (1.0 - keep) * x;
            state
        };
        columns.push(behind.iter().map(average).collect());
    }
    columns
}

/// What a least-squares fit of the columns leaves of a series; the series itself where the columns say nothing.
fn without(x: &[f64], columns: &[Vec<f64>]) -> Vec<f64> {
    let n = columns.len();
    let mut normal = DMatrix::from_fn(n, n, |i, j| {
        if i < j {
            0.0
        } else {
            dot(&columns[i], &columns[j])
        }
    });
    normal.fill_upper_triangle_with_lower_triangle();
    // Lags of one sine are copies of one another: a share of the power that no figure here shows.
    let ridge = 1e-8 * (0..n).map(|i| normal[(i, i)]).fold(0.0, f64::max);
    (0..n).for_each(|i| normal[(i, i)] += ridge);
    let right = DVector::from_fn(n, |i, _| dot(&columns[i], x));
    let mut left = x.to_vec();
    if let Some(factors) = normal.cholesky() {
        let shares = factors.solve(&right);
        for (column, share) in columns.iter().zip(shares.iter()) {
            left.iter_mut()
                .zip(column)
                .for_each(|(left, value)| *left -= share * value);
        }
    }
    left
}

/// The part of the simulated motion that does not answer the noise. Both series are whitened, of equal length.
fn driven(simulated: &[f64], innovations: &[f64]) -> Vec<f64> {
    let mut explained = past(simulated, 0);
    explained.extend(past(innovations, 1));
    let noise = without(innovations, &explained);
    without(simulated, &past(&noise, 1))
}

/// Spectrum of a series, from 0 Hz on.
pub(super) fn transform(x: &[f64]) -> Vec<Complex<f64>> {
    fft::forward(&mut x.to_vec())
}

/// Sums of a band.
#[derive(Debug, Clone, Copy, Default)]
struct Band {
    /// Instrument with the innovations.
    innovation: Complex<f64>,
    /// Instrument with the simulated motion.
    simulated: Complex<f64>,
    /// Power of the instrument.
    power: f64,
    bins: f64,
}

impl Band {
    /// The ratio; None where the instrument has next to no power.
    fn ratio(&self, hz: f64) -> Option<BandRatio> {
        // Power of the simulated motion that was driven from outside; the noise is white, with a power of one in each bin.
        let driven = self.simulated.norm_sqr() / self.power;
        if driven.is_nan() || driven <= 50.0 {
            return None;
        }
        let ratio = Complex::new(1.0, 0.0) + self.innovation / self.simulated;
        Some(BandRatio {
            hz,
            gain_db: 20.0 * ratio.norm().log10(),
            phase_deg: ratio.arg().to_degrees(),
            error: (1.0 / driven).sqrt(),
            coherence: driven / (driven + self.bins),
        })
    }
}

/// Middles of the bands, a third of an octave wide \[Hz\].
fn centres(sample_s: f64) -> Vec<f64> {
    (0..30)
        .map(|i| 0.5 * 2f64.powf(f64::from(i) / 3.0))
        .filter(|f| *f < 0.45 / sample_s)
        .collect()
}

/// Adds a record, with an instrument, to the bands.
fn add(
    bands: &mut [Band],
    centres: &[f64],
    sample_s: f64,
    [instrument, simulated, innovations]: [&[f64]; 3],
) {
    let n = simulated.len();
    // A sine of micrometres would leak into its neighbours far above the noise, and pass for their excitation.
    let windowed = |x: &[f64]| {
        let hann = |k: usize| 1.0 - (std::f64::consts::TAU * k as f64 / n as f64).cos();
        let mut x: Vec<f64> = x
            .iter()
            .enumerate()
            .map(|(k, x)| x * hann(k) * (2.0f64 / 3.0).sqrt())
            .collect();
        fft::forward(&mut x)
    };
    let (z, s, e) = (
        windowed(instrument),
        windowed(simulated),
        windowed(innovations),
    );
    for k in 1..s.len() {
        let hz = k as f64 / (n as f64 * sample_s);
        let near = |c: &f64| (hz / c).log2().abs() <= 1.0 / 6.0;
        let Some(band) = centres.iter().position(near).and_then(|b| bands.get_mut(b)) else {
            continue;
        };
        band.innovation += e[k] * z[k].conj() / n as f64;
        band.simulated += s[k] * z[k].conj() / n as f64;
        band.power += z[k].norm_sqr() / n as f64;
        band.bins += 1.0;
    }
}

/// Complex ratio of measured to simulated, on whitened series, in bands a third of an octave wide, all records together.
pub(super) fn ratios(ctx: &Context<'_>, fit: &Fit) -> Vec<BandRatio> {
    let sample_s = ctx.problem.base.sample_s;
    let sim = ctx.simulated(&fit.parts, fit.offset_um, &ctx.problem.all());
    let centres = centres(sample_s);
    let mut bands = vec![Band::default(); centres.len()];
    for (i, r) in ctx.problem.records.iter().enumerate() {
        if r.rest {
            continue;
        }
        let s = r.whitened(&sim[i]);
        let e = &fit.innovations[i];
        add(&mut bands, &centres, sample_s, [&driven(&s, e), &s, e]);
    }
    let of = |(band, hz): (&Band, &f64)| band.ratio(*hz);
    bands.iter().zip(&centres).filter_map(of).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// White noise of unit variance, the same each time.
    fn noise(n: usize, seed: u64) -> Vec<f64> {
        let mut random = cellpos_numeric::Random::new(seed);
        (0..n).map(|_| random.normal()).collect()
    }

    /// A loop: the model's motion answers what was measured, and `drive` times white noise is added between 5 and 60 Hz, as
    /// low-pass filtered steps. The plant moves by `gain` where the model moves by 1.
    fn closed_loop(n: usize, gain: f64, drive: f64, seed: u64) -> (Vec<f64>, Vec<f64>) {
        let (v, w) = (noise(n, seed), noise(n, seed + 1));
        let (mut s, mut e) = (vec![0.0; n], vec![0.0; n]);
        let (mut external, mut answer) = (0.0, 0.0);
        for k in 0..n {
            external = 0.85 * external + drive * w[k];
            if k > 0 {
                // The whitened position of the previous step: three samples.
                answer = 0.7 * answer - 0.35 * (gain * s[k - 1] + v[k - 1]);
            }
            s[k] = external + answer;
            e[k] = (gain - 1.0) * s[k] + v[k];
        }
        (s, e)
    }

    fn bands(instrument: &[f64], s: &[f64], e: &[f64]) -> Vec<BandRatio> {
        let centres = centres(1e-3);
        let mut bands = vec![Band::default(); centres.len()];
        add(&mut bands, &centres, 1e-3, [instrument, s, e]);
        let of = |(band, hz): (&Band, &f64)| band.ratio(*hz);
        bands.iter().zip(&centres).filter_map(of).collect()
    }

    /// Departures of the ratios from a gain in standard errors, of the bands from 4 Hz on.
    fn departures(ratios: &[BandRatio], gain: f64) -> Vec<f64> {
        let of = |r: &BandRatio| {
            let ratio = Complex::from_polar(10f64.powf(r.gain_db / 20.0), r.phase_deg.to_radians());
            (ratio - gain).norm() / r.error
        };
        ratios.iter().filter(|r| r.hz > 4.0).map(of).collect()
    }

    #[test]
    fn a_plant_in_a_loop_is_found_within_its_interval_where_the_plain_ratio_is_biased() {
        let (s, e) = closed_loop(120_000, 1.25, 0.8, 11);
        let joint = bands(&driven(&s, &e), &s, &e);
        let plain = bands(&s, &s, &e);
        let supported: Vec<BandRatio> = joint
            .iter()
            .filter(|r| r.coherence > 0.5)
            .cloned()
            .collect();
        assert!(supported.len() >= 10, "{joint:?}");
        // The error is of a complex number: both its parts.
        let worst = departures(&supported, 1.25).into_iter().fold(0.0, f64::max);
        assert!(worst < 4.5, "{worst}: {supported:?}");
        let biased = departures(&plain, 1.25).into_iter().fold(0.0, f64::max);
        assert!(
            biased > 10.0,
            "{biased}: the loop of this test biases nothing"
        );
    }

    #[test]
    fn a_loop_that_nothing_excites_supports_no_ratio() {
        for seed in (5..25).step_by(2) {
            let (s, e) = closed_loop(60_000, 1.25, 0.0, seed);
            let ratios = bands(&driven(&s, &e), &s, &e);
            let supported = ratios.iter().find(|ratio| ratio.is_supported());
            assert!(supported.is_none(), "seed {seed}: {supported:?}");
            let mean =
                ratios.iter().map(|ratio| ratio.coherence).sum::<f64>() / ratios.len() as f64;
            assert!(mean < 0.2, "seed {seed}: {mean}");
        }
    }

    #[test]
    fn without_a_loop_the_excitation_is_its_own_instrument() {
        let (v, s) = (noise(30_000, 3), noise(30_000, 4));
        let s: Vec<f64> = s.iter().map(|s| 5.0 * s).collect();
        let e: Vec<f64> = v.iter().zip(&s).map(|(v, s)| v - 0.1 * s).collect();
        let z = driven(&s, &e);
        let apart: Vec<f64> = z.iter().zip(&s).map(|(z, s)| z - s).collect();
        assert!(dot(&apart, &apart) < 0.01 * dot(&s, &s));
        let ratios = bands(&z, &s, &e);
        assert!(
            ratios
                .iter()
                .filter(|r| r.hz > 4.0)
                .all(BandRatio::is_supported)
        );
        let worst = departures(&ratios, 0.9).into_iter().fold(0.0, f64::max);
        assert!(worst < 4.5, "{worst}");
    }
}
