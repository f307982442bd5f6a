//! The paper's Appendix B: gain and phase read from a bare FFT. Offered by name, to show what drift does to it.
//!
//! It uses no window and removes no drift: a steady drift `v` adds `v/(pi f)` to every bin, however long the record. At
//! 10 Hz, 10 um/s of drift turn -93.3 deg into about -96 deg. For results use [`crate::frequency_response`].

use cellpos_numeric::fft;
use nalgebra::Complex;

/// The one-sided spectrum of a record.
#[derive(Debug, Clone, PartialEq)]
pub struct Spectrum {
    /// Frequencies of the bins, Hz.
    pub frequency_hz: Vec<f64>,
    /// Phasors (peak amplitude) of the bins.
    pub phasor: Vec<Complex<f64>>,
}

/// Spectrum of `signal`, its mean taken off first; bins scaled to peak amplitudes. Empty for fewer than two samples.
pub fn spectrum(signal: &[f64], period_s: f64) -> Spectrum {
    let n = signal.len();
    if n < 2 {
        return Spectrum {
            frequency_hz: Vec::new(),
            phasor: Vec::new(),
        };
    }
    let mean = signal.iter().sum::<f64>() / n as f64;
    let mut input: Vec<f64> = signal.iter().map(|x| x - mean).collect();
    let output = fft::forward(&mut input);
    let scale = 2.0 / n as f64;
    Spectrum {
        frequency_hz: (0..output.len())
            .map(|k| k as f64 / (n as f64 * period_s))
            .collect(),
        phasor: output.iter().map(|c| c * scale).collect(),
    }
}

/// Gain and phase at `frequency_hz` as Appendix B reads them: ratio of the nearest bins of output and input.
pub fn response(input: &[f64], output: &[f64], period_s: f64, frequency_hz: f64) -> Complex<f64> {
    let bin = (frequency_hz * input.len() as f64 * period_s).round() as usize;
    let (u, y) = (spectrum(input, period_s), spectrum(output, period_s));
    match (u.phasor.get(bin), y.phasor.get(bin)) {
        (Some(u), Some(y)) => y / u,
        _ => Complex::new(f64::NAN, f64::NAN),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_steady_drift_adds_its_speed_over_pi_f_to_every_bin() {
        for n in [500usize, 5000] {
            let drift: Vec<f64> = (0..n).map(|k| 10.0 * k as f64 * 1e-3).collect();
            let s = spectrum(&drift, 1e-3);
            for f in [2.0, 10.0, 50.0] {
                let bin = (f * n as f64 * 1e-3).round() as usize;
                let expected = 10.0 / (std::f64::consts::PI * f);
                assert!(
                    (s.phasor[bin].norm() / expected - 1.0).abs() < 0.01,
                    "{n} rows, {f} Hz"
                );
            }
        }
    }
}
