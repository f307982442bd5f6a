//! Errors of the builders: small, `Copy`, naming the parameter, its value and what would be right.

use thiserror::Error;

/// The name of a parameter as it is written in files, and its unit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Parameter {
    /// Key, with the unit in the name.
    pub name: &'static str,
    /// Unit, for the message.
    pub unit: &'static str,
}

impl Parameter {
    /// What stands between a value and its unit.
    fn gap(self) -> &'static str {
        if self.unit.is_empty() { "" } else { " " }
    }
}

/// A configuration that cannot be built.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
pub enum BuildError {
    /// A value is not finite or is outside its range.
    #[error("{} = {value}{}{}: must be {wanted}", parameter.name, parameter.gap(), parameter.unit)]
    OutOfRange {
        /// Which one.
        parameter: Parameter,
        /// The value given.
        value: f64,
        /// What would be right.
        wanted: &'static str,
    },
    /// The delay needs more past commands than the state holds.
    #[error(
        "delay_ms = {delay_ms}: the estimator reaches back {longest_ms} ms at most at this sample time"
    )]
    DelayTooLong {
        /// The delay given, camera path only, ms.
        delay_ms: f64,
        /// The longest that can be held, ms.
        longest_ms: f64,
    },
    /// The plant has more modes than the estimator holds.
    #[error(
        "the model has {given} modes besides its integrator: the estimator holds {most}. Measure one on this rig that begins without \
         them, with `[plant] num = [428.0], den = [1.0, 0.0]` (`cellpos identify --model`), or leave the shortest lag out"
    )]
    TooManyModes {
        /// Modes of the model.
        given: usize,
        /// Modes that can be held.
        most: usize,
    },
    /// The plant is not an integrator with stable real modes, so no resting displacement (neutral) exists.
    #[error(
        "the model has no integrating pole (slower than {slowest_rad_per_s} rad/s), so the bead has no neutral"
    )]
    NoIntegrator {
        /// Poles slower than this count as integrators, rad/s.
        slowest_rad_per_s: f64,
    },
    /// A pole of the model is unstable or complex where a real stable one is needed.
    #[error(
        "the model has a pole at {re} + {im}i rad/s: besides the integrator all must be real and stable"
    )]
    Pole {
        /// Real part, rad/s.
        re: f64,
        /// Imaginary part, rad/s.
        im: f64,
    },
    /// A law has more columns of its own than a record holds.
    #[error("the control law names {given} columns: a record holds {most}")]
    TooManyColumns {
        /// Columns named.
        given: usize,
        /// Columns that can be held.
        most: usize,
    },
    /// A column that cannot be one.
    #[error(
        "the control law's column `{name}`: a name is lower-case letters, digits and `_`, and stands once"
    )]
    Column {
        /// Its name.
        name: &'static str,
    },
    /// An iteration that must converge for a well-posed problem did not.
    #[error("{what} did not converge: check the model and the weights")]
    NoConvergence {
        /// Which computation.
        what: &'static str,
    },
}

/// Refuses a value that is not finite or fails `ok`.
pub(crate) fn check(
    name: &'static str,
    unit: &'static str,
    value: f64,
    ok: bool,
    wanted: &'static str,
) -> Result<(), BuildError> {
    if value.is_finite() && ok {
        Ok(())
    } else {
        Err(BuildError::OutOfRange {
            parameter: Parameter { name, unit },
            value,
            wanted,
        })
    }
}
