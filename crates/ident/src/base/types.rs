//! Inputs and results of a base fit.

use super::form::Form;
use crate::error::IdentError;
use crate::rational::RationalFit;

/// One record: input and output row by row at the same even rate, the output NaN if missing.
#[derive(Debug, Clone, PartialEq)]
pub struct Series {
    /// Input, any unit.
    pub input: Vec<f64>,
    /// Output just before the input of the same row acts, any unit; NaN where none was seen.
    pub output: Vec<f64>,
}

/// A base model with its residual.
#[derive(Debug, Clone, PartialEq)]
pub struct BaseFit {
    /// What was fitted.
    pub form: Form,
    /// The model; standard deviations allow for a residual that is correlated in time.
    pub model: RationalFit,
    /// Input at which an integrating plant is at rest, if the records determine it; None for a plant that does not integrate.
    pub rest_input: Option<f64>,
    /// RMS of the output about its mean, output unit.
    pub output_rms: f64,
    /// RMS of output minus free run on the fitted rows, output unit.
    pub residual_rms: f64,
    /// The same RMS on the halves that a fit to the other halves predicts, output unit; None if only one form was requested.
    pub held_out_rms: Option<f64>,
    /// Whether the plant integrates and the free run's residual is a random walk: Brownian motion or drift, not an error of the model.
    pub wanders: bool,
    /// Whether a number is at an end of the range that sampling and length of the records allow.
    pub at_bound: bool,
}

impl BaseFit {
    /// Whether the records determine every number of the model.
    pub(super) fn is_seen(&self) -> bool {
        let m = &self.model;
        let all = m.numerator_sd.iter().chain(&m.denominator_sd);
        all.chain([&m.delay_sd_s]).all(|sd| sd.is_finite())
    }
}

/// Fewest rows with an output for a model with `parameters` numbers.
const ROWS_PER_PARAMETER: usize = 8;

/// Refuses records that cannot be fitted.
pub(super) fn checked(
    records: &[Series],
    rate_hz: f64,
    parameters: usize,
) -> Result<(), IdentError> {
    if !(rate_hz.is_finite() && rate_hz > 0.0) {
        return Err(IdentError::OutOfRange {
            key: "rate_hz",
            value: rate_hz,
            unit: "Hz",
            expected: "the rows per second, above 0",
        });
    }
    for r in records {
        if r.input.len() != r.output.len() {
            return Err(IdentError::Lengths {
                input: r.input.len(),
                output: r.output.len(),
            });
        }
    }
    let rows = records
        .iter()
        .flat_map(|r| &r.output)
        .filter(|y| y.is_finite())
        .count();
    let needed = (ROWS_PER_PARAMETER * parameters).max(50);
    if rows < needed {
        return Err(IdentError::TooShort {
            what: "a base model of this order",
            rows,
            needed,
        });
    }
    let moved = records.iter().any(|r| {
        let size = r.input.iter().fold(0.0f64, |a, v| a.max(v.abs()));
        let first = r.input.first().copied().unwrap_or(0.0);
        (r.input.iter()).any(|v| (v - first).abs() > 1e-9 * size)
    });
    if !moved {
        return Err(IdentError::OutOfRange {
            key: "input",
            value: records
                .first()
                .and_then(|r| r.input.first())
                .copied()
                .unwrap_or(f64::NAN),
            unit: "(its own unit)",
            expected: "an input that moves: this column is constant; is it the right column?",
        });
    }
    Ok(())
}
