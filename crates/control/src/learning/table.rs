//! The result of a learner, as it is kept in files: `learned.toml`.

use crate::uncertainty::Uncertainty;
use serde::{Deserialize, Serialize};

/// One harmonic of a learned addition: `cos_um cos(2 pi h phase) + sin_um sin(2 pi h phase)`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LearnedHarmonic {
    /// Which harmonic.
    pub harmonic: u32,
    /// Cosine part, um of PZT.
    pub cos_um: f64,
    /// Sine part, um of PZT.
    pub sin_um: f64,
}

/// The result of a learner, in the form of a file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LearnedTable {
    /// Frequency of the reference, Hz.
    pub frequency_hz: f64,
    /// Cycles learned.
    pub cycles: f64,
    /// Times that the learner retreated; 3: the learning was given up.
    pub retreats: u32,
    /// RMS of the measured error over the first cycles, um.
    pub error_before_um: Option<f64>,
    /// RMS of the measured error over the last cycles, um.
    pub error_after_um: Option<f64>,
    /// How well the plant was taken to be known in the convergence test; `None` in tables from before this was written.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub margins: Option<Uncertainty>,
    /// Gain over the model's by which the feed-forward was divided together with the addition. It is `None` if nothing was
    /// learned, and 1 in tables of a loop that does not adapt.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub feed_forward_gain: Option<f64>,
    /// The harmonics.
    pub harmonics: Vec<LearnedHarmonic>,
}
