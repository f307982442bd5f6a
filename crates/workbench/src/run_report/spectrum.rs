//! Spectrum of the error.

use cellpos_numeric::fft::{self, RealToComplex};
use std::f64::consts::TAU;
use std::sync::Arc;

/// Rows of a stretch, and of one of a short run.
const STRETCH: usize = 4096;
const SHORT: usize = 512;

/// An amplitude density.
#[derive(Debug)]
pub(super) struct Spectrum {
    pub hz: Vec<f64>,
    pub nm_per_rthz: Vec<f64>,
}

/// Averaged spectrum of a stream of values (Hann windows overlapping by half, each stretch minus its mean). A missing value
/// counts as the mean; a stretch with more than a twentieth missing is left out.
#[derive(Debug, Default)]
pub(super) struct Welch {
    /// What is behind the last whole stretch, and half of that.
    values_um: Vec<f64>,
    long: Option<Stretches>,
}

impl Welch {
    /// The next value; NaN if it is missing.
    pub(super) fn add(&mut self, value_um: f64) {
        self.values_um.push(value_um);
        if self.values_um.len() == STRETCH {
            let long = self.long.get_or_insert_with(|| Stretches::of(STRETCH));
            long.add(&self.values_um);
            self.values_um.drain(..STRETCH / 2);
        }
    }

    /// The spectrum; None without a whole stretch. A run too short for one has shorter ones.
    pub(super) fn spectrum(&self, period_s: f64) -> Option<Spectrum> {
        if let Some(long) = &self.long {
            return long.spectrum(period_s);
        }
        let mut short = Stretches::of(SHORT);
        let mut start = 0;
        while let Some(part) = self.values_um.get(start..start + SHORT) {
            short.add(part);
            start += SHORT / 2;
        }
        short.spectrum(period_s)
    }
}

/// Sum of the power of stretches of one length.
struct Stretches {
    fft: Arc<dyn RealToComplex<f64>>,
    window: Vec<f64>,
    sum: Vec<f64>,
    count: f64,
}

impl std::fmt::Debug for Stretches {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} stretches of {} rows", self.count, self.window.len())
    }
}

impl Stretches {
    fn of(rows: usize) -> Self {
        Self {
            fft: fft::plan(rows),
            window: (0..rows)
                .map(|k| 0.5 - 0.5 * (TAU * k as f64 / rows as f64).cos())
                .collect(),
            sum: vec![0.0; rows / 2 + 1],
            count: 0.0,
        }
    }

    fn add(&mut self, part: &[f64]) {
        let seen = part.iter().filter(|um| um.is_finite());
        let n = seen.clone().count();
        if n * 20 < part.len() * 19 {
            return;
        }
        let mean = seen.sum::<f64>() / n as f64;
        let mut input: Vec<f64> = part
            .iter()
            .zip(&self.window)
            .map(|(um, w)| if um.is_finite() { (um - mean) * w } else { 0.0 })
            .collect();
        let mut out = self.fft.make_output_vec();
        if self.fft.process(&mut input, &mut out).is_err() {
            return;
        }
        for (sum, bin) in self.sum.iter_mut().zip(&out) {
            *sum += bin.norm_sqr();
        }
        self.count += 1.0;
    }

    fn spectrum(&self, period_s: f64) -> Option<Spectrum> {
        if self.count == 0.0 {
            return None;
        }
        let rows = self.window.len();
        let power: f64 = self.window.iter().map(|w| w * w).sum();
        // The mean was taken away, and the window smears it into the first bin.
        let bins = 2..rows / 2;
        Some(Spectrum {
            hz: bins
                .clone()
                .map(|k| k as f64 / (rows as f64 * period_s))
                .collect(),
            nm_per_rthz: bins
                .map(|k| (2.0 * self.sum[k] * period_s / (power * self.count)).sqrt() * 1e3)
                .collect(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn welch(values_um: &[f64], period_s: f64) -> Option<Spectrum> {
        let mut welch = Welch::default();
        values_um.iter().for_each(|um| welch.add(*um));
        welch.spectrum(period_s)
    }

    #[test]
    fn the_spectrum_of_white_noise_is_flat_and_holds_its_variance() {
        let mut random = cellpos_numeric::Random::new(7);
        let mut values: Vec<f64> = (0..60_000).map(|_| random.uniform() - 0.5).collect();
        for k in (0..values.len()).step_by(97) {
            values[k] = f64::NAN;
        }
        let spectrum = welch(&values, 1e-3).unwrap();
        // Variance 1/12 um^2 over 500 Hz.
        let expected = (1.0 / 12.0 / 500.0f64).sqrt() * 1e3;
        let mean = spectrum.nm_per_rthz.iter().map(|d| d * d).sum::<f64>()
            / spectrum.nm_per_rthz.len() as f64;
        assert!(
            (mean.sqrt() / expected - 1.0).abs() < 0.02,
            "{mean} {expected}"
        );
        assert!(welch(&values[..100], 1e-3).is_none());
    }
}
