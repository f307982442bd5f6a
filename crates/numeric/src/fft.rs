//! The Fourier transform of a real signal. The algorithms are compiled here alone: each crate that plans by itself compiles all of them.

use realfft::RealFftPlanner;
use std::sync::Arc;

pub use realfft::RealToComplex;
pub use realfft::num_complex::Complex;

/// The plan of a forward transform of `rows` values, for many signals of one length.
pub fn plan(rows: usize) -> Arc<dyn RealToComplex<f64>> {
    RealFftPlanner::new().plan_fft_forward(rows)
}

/// The spectrum of a signal: bins 0 to `n / 2`, not scaled. Overwrites the signal. Empty for an empty signal.
pub fn forward(signal: &mut [f64]) -> Vec<Complex<f64>> {
    if signal.is_empty() {
        return Vec::new();
    }
    let plan = plan(signal.len());
    let mut bins = plan.make_output_vec();
    match plan.process(signal, &mut bins) {
        Ok(()) => bins,
        // Only wrong lengths are errors, and the plan made the buffer.
        Err(_) => Vec::new(),
    }
}

/// The signal of `rows` values that has a spectrum, times `rows`. Overwrites the spectrum. Empty where the lengths do not fit, or where
/// the first or last bin is not real.
pub fn inverse(bins: &mut [Complex<f64>], rows: usize) -> Vec<f64> {
    let plan = RealFftPlanner::new().plan_fft_inverse(rows);
    let mut signal = plan.make_output_vec();
    match plan.process(bins, &mut signal) {
        Ok(()) => signal,
        Err(_) => Vec::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sine_is_one_bin_and_comes_back() {
        let sine: Vec<f64> = (0..32)
            .map(|k| (std::f64::consts::TAU * 3.0 * f64::from(k) / 32.0).sin())
            .collect();
        let mut bins = forward(&mut sine.clone());
        assert_eq!(bins.len(), 17);
        for (k, bin) in bins.iter().enumerate() {
            let expected = if k == 3 { 16.0 } else { 0.0 };
            assert!((bin.norm() - expected).abs() < 1e-12, "{k}: {bin}");
        }
        let back = inverse(&mut bins, 32);
        for (a, b) in back.iter().zip(&sine) {
            assert!((a / 32.0 - b).abs() < 1e-14);
        }
        assert!(forward(&mut []).is_empty());
    }
}
