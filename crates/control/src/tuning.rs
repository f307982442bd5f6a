//! The tuning in force, between the estimate of the plant that finds it and the laws that use it.

/// The tuning in force, as a law gets it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tuning {
    /// Gain of the plant over the design's. All displacements in a law's input, output and own limits are PZT displacements times this
    /// factor.
    pub gain: f64,
    /// Loop delay (with the half sample of hold) over the design's.
    pub delay: f64,
}

impl Default for Tuning {
    /// That of the design.
    fn default() -> Self {
        Self {
            gain: 1.0,
            delay: 1.0,
        }
    }
}
