//! The tuning in force, between the estimate of the plant that finds it and the laws that use it.

/// The tuning in force, as a law is told of it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tuning {
    /// Gain of the plant over the design's. Displacements that a law is given, and those that it answers, are of the PZT
    /// times this; so are limits of displacement that it keeps by itself.
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
