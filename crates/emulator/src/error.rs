//! What can be wrong with the world that is asked for.

/// Why there is no such world.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum WorldError {
    /// A value that cannot be.
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

/// Checks that a value lies between two others, both included; `must` says that in words, with the unit.
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
