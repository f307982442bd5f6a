//! The shapes of moves and waves, scaled to 1.

use crate::script::{MoveShape, WaveShape};
use std::f64::consts::{PI, TAU};

/// Share of a move done at a share of its time.
pub(super) fn progress(shape: MoveShape, x: f64) -> f64 {
    match shape {
        MoveShape::ConstantVelocity => x,
        MoveShape::MinimumJerk => x * x * x * (10.0 + x * (6.0 * x - 15.0)),
        MoveShape::SCurve => x - (TAU * x).sin() / TAU,
    }
}

/// A wave of amplitude 1 at a phase in cycles.
pub(super) fn wave(shape: WaveShape, phase: f64) -> f64 {
    let triangle = || 1.0 - 4.0 * ((phase + 0.25).fract() - 0.5).abs();
    match shape {
        WaveShape::Sine => (TAU * phase.fract()).sin(),
        WaveShape::Triangle => triangle(),
        WaveShape::Trapezoid => (2.0 * triangle()).clamp(-1.0, 1.0),
    }
}

/// From 0 to 1 over `length` cycles, as a raised cosine.
pub(super) fn rise(cycles: f64, length: f64) -> f64 {
    if cycles >= length {
        1.0
    } else {
        0.5 - 0.5 * (PI * cycles.max(0.0) / length).cos()
    }
}
