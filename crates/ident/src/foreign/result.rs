//! Analysis of a foreign record, and its results.

use crate::frequency_response::FrequencyPoint;
use crate::rational::RationalFit;
use crate::sampled::{Hold, Sampling};

/// What to do with a foreign record.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ForeignSettings {
    /// Rows per second.
    pub rate_hz: f64,
    /// Highest order of a linear model tried.
    pub most_order: usize,
    /// What the input does between rows.
    pub hold: Hold,
}

/// How the record was excited.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Excitation {
    /// By a few sines.
    Lines,
    /// By something broadband: averaged spectra.
    Broadband,
}

/// Gain and lag at one driven line.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LineResult {
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// Gain coherent with the line, output unit per input unit.
    pub gain: f64,
    /// Half-width of its 95 % interval.
    pub gain_ci95: f64,
    /// Phase, deg (negative: the output lags).
    pub phase_deg: f64,
    /// Half-width of its 95 % interval, deg.
    pub phase_ci95_deg: f64,
    /// The phase as a time by which the output lags, ms.
    pub lag_ms: f64,
    /// Coherence.
    pub coherence: f64,
}

/// A harmonic in the output.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Harmonic {
    /// The driven line, Hz.
    pub fundamental_hz: f64,
    /// Which harmonic.
    pub number: usize,
    /// Amplitude over that of the fundamental, in the output.
    pub output_ratio: f64,
    /// The same in the input.
    pub input_ratio: f64,
    /// Probability that noise alone shows this much.
    pub p_value: f64,
    /// Whether it exceeds both the noise and the effect of the input's own harmonic.
    pub unexplained: bool,
}

/// The basis of the response.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Basis {
    /// The input is independent of the output: output over input.
    Input,
    /// Closed loop: input and output were projected on its noise-free reference (joint input-output method).
    Reference,
    /// Closed loop without external excitation: plant and controller cannot be separated.
    Nothing {
        /// Part of the input's change that the output's past predicts; None if not tested.
        share: Option<f64>,
    },
}

/// Results for a foreign record.
#[derive(Debug, Clone, PartialEq)]
pub struct ForeignResult {
    /// The basis of the response.
    pub basis: Basis,
    /// How it was excited.
    pub excitation: Excitation,
    /// Driven lines, strongest first (empty for broadband).
    pub lines: Vec<LineResult>,
    /// The response, in order of frequency.
    pub points: Vec<FrequencyPoint>,
    /// Harmonics looked for.
    pub harmonics: Vec<Harmonic>,
    /// Linear models fitted, best AICc first.
    pub models: Vec<RationalFit>,
    /// RMS of the output about its own offset and ramp, output unit.
    pub output_rms: f64,
    /// RMS of the residual of the coherent linear response (lines only), output unit.
    pub linear_residual_rms: Option<f64>,
    /// How the record was sampled.
    pub sampling: Sampling,
}

impl ForeignSettings {
    /// How the record was sampled.
    pub(super) fn sampling(&self) -> Sampling {
        Sampling {
            period_s: 1.0 / self.rate_hz,
            exposure_s: 0.0,
            hold: self.hold,
        }
    }
}

impl ForeignResult {
    /// The result for a record that gives no model; `share` as in [`Basis::Nothing`].
    pub(super) fn nothing(sampling: Sampling, output_rms: f64, share: Option<f64>) -> Self {
        Self {
            basis: Basis::Nothing { share },
            excitation: Excitation::Broadband,
            lines: Vec::new(),
            points: Vec::new(),
            harmonics: Vec::new(),
            models: Vec::new(),
            output_rms,
            linear_residual_rms: None,
            sampling,
        }
    }

    /// Whether harmonics remain that no linear model explains.
    pub fn harmonics_remain(&self) -> bool {
        self.harmonics.iter().any(|h| h.unexplained)
    }
}
