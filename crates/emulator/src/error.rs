//! Errors in the description of a world.

/// The reason why such a world cannot be built.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum WorldError {
    /// An invalid value.
    #[error("[emulator] `{key}` is {value}, must be {must}")]
    Value {
        /// Key.
        key: &'static str,
        /// Value found.
        value: f64,
        /// What would be right, with the unit.
        must: &'static str,
    },
    /// The model cannot be run.
    #[error("[emulator] `model`: {0}")]
    Model(String),
}

/// Checks that a value is between two others, both included; `must` states that in words, with the unit.
pub(crate) fn within(
    key: &'static str,
    value: f64,
    low: f64,
    high: f64,
    must: &'static str,
) -> Result<(), WorldError> {
    if (low..=high).contains(&value) {
        Ok(())
    } else {
        Err(WorldError::Value { key, value, must })
    }
}
