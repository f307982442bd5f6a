//! Errors of identification; each says what would be right.

use thiserror::Error;

/// Why an identification step could not be carried out.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum IdentError {
    /// A number is outside the range in which it makes sense.
    #[error("{key} = {value} {unit}: {expected}")]
    OutOfRange {
        /// Name of the quantity.
        key: &'static str,
        /// The value found.
        value: f64,
        /// Its unit.
        unit: &'static str,
        /// What would be right.
        expected: &'static str,
    },
    /// Input and output do not have the same number of rows.
    #[error("input has {input} rows and output has {output}: a record needs one output per input")]
    Lengths {
        /// Rows of the input.
        input: usize,
        /// Rows of the output.
        output: usize,
    },
    /// Too few usable rows for the request.
    #[error("{rows} usable rows are too few for {what}: record at least {needed}")]
    TooShort {
        /// What was to be estimated.
        what: &'static str,
        /// Rows found.
        rows: usize,
        /// Rows needed.
        needed: usize,
    },
    /// The input does not move at a frequency at which a response is requested.
    #[error(
        "the input holds no signal at {frequency_hz} Hz (amplitude {amplitude}): excite it there or leave it out"
    )]
    NoInput {
        /// The frequency, Hz.
        frequency_hz: f64,
        /// Amplitude found, in the input's unit.
        amplitude: f64,
    },
    /// A drive line or one of its low harmonics folds onto another drive line at this sampling rate.
    #[error(
        "harmonic {harmonic} of {from_hz} Hz falls on the drive line {onto_hz} Hz at {rate_hz} Hz sampling: move one of them (for example to a prime number of hertz)"
    )]
    AliasOnGrid {
        /// Frequency whose harmonic folds, Hz.
        from_hz: f64,
        /// Which harmonic.
        harmonic: usize,
        /// The line it lands on, Hz.
        onto_hz: f64,
        /// Sampling rate, Hz.
        rate_hz: f64,
    },
    /// Too few points for the parameters of a model.
    #[error(
        "{points} frequencies cannot support {parameters} parameters: measure at least {needed}"
    )]
    TooFewPoints {
        /// Frequencies given.
        points: usize,
        /// Real parameters of the model.
        parameters: usize,
        /// Frequencies needed.
        needed: usize,
    },
    /// The least-squares iteration found no minimum.
    #[error(
        "the fit of {what} did not converge ({reason}): check units and signs of input and output"
    )]
    NoFit {
        /// Which model.
        what: &'static str,
        /// What stopped the iteration.
        reason: &'static str,
    },
    /// The bead was lost. Earlier measurements are kept and the experiment can resume.
    #[error(
        "the bead was lost in segment {segment} of {segments} ({frames} frames in a row without a position): bring it back and resume at that segment"
    )]
    BeadLost {
        /// Segment (from 0) in which it happened.
        segment: usize,
        /// Segments planned.
        segments: usize,
        /// Frames in a row without a position.
        frames: usize,
    },
    /// Not enough edges were seen in the delay test.
    #[error(
        "only {seen} of {sent} edges were seen in the delay test: check that the light reaches the camera and the threshold of {threshold}"
    )]
    EdgesNotSeen {
        /// Edges seen.
        seen: usize,
        /// Edges sent.
        sent: usize,
        /// Threshold used, grey levels or the signal's unit.
        threshold: f64,
    },
}
