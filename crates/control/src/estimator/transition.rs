//! The deterministic part of the state, and how commands move it.

use crate::loop_model::{LoopModel, MODES};

/// Deterministic part of the state at one time.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct PredictedState {
    /// Integrator part of the position, um.
    pub q: f64,
    /// Neutral, um.
    pub n: f64,
    /// Fast modes, um s.
    pub modes: [f64; MODES],
    /// Command in force just before this time, um.
    pub last_um: f64,
}

/// Transition over a time, exact for a constant command.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Transition {
    pub(super) gain: f64,
    a: [f64; MODES],
    b: [f64; MODES],
    pub(super) fraction: f64,
}

impl Transition {
    pub(super) fn new(model: &LoopModel, fraction: f64) -> Self {
        let t = model.sample_time_s * fraction;
        let mut this = Self {
            gain: model.gain_per_s * t,
            a: [0.0; MODES],
            b: [0.0; MODES],
            fraction,
        };
        for (i, mode) in model.modes.iter().enumerate() {
            if mode.pole_rad_per_s < 0.0 {
                // Backwards over more than that nothing is left of a state but noise: the mode stood where the command had it.
                const FARTHEST_BACK: f64 = 2.0;
                let exponent = mode.pole_rad_per_s * t;
                this.a[i] = if exponent > FARTHEST_BACK {
                    0.0
                } else {
                    exponent.exp()
                };
                this.b[i] = (this.a[i] - 1.0) / mode.pole_rad_per_s;
            }
        }
        this
    }

    pub(super) fn advance(&self, m: &PredictedState, command_um: f64) -> PredictedState {
        let drive = command_um - m.n;
        let mut next = PredictedState {
            q: m.q + self.gain * drive,
            n: m.n,
            modes: m.modes,
            last_um: command_um,
        };
        for ((x, a), b) in next.modes.iter_mut().zip(&self.a).zip(&self.b) {
            *x = a * *x + b * drive;
        }
        if self.fraction == 0.0 {
            next.last_um = m.last_um;
        }
        next
    }

    /// The state before a tick that [`Transition::advance`] made, with the command of that tick.
    pub(super) fn retreat(&self, m: &PredictedState, command_um: f64) -> PredictedState {
        /// Part of a mode that a tick must leave, for what it was before to be told from it.
        const LEAST_LEFT: f64 = 0.1;
        let drive = command_um - m.n;
        let mut before = PredictedState {
            q: m.q - self.gain * drive,
            ..*m
        };
        for ((x, a), b) in before.modes.iter_mut().zip(&self.a).zip(&self.b) {
            *x = if *a > LEAST_LEFT {
                (*x - b * drive) / a
            } else {
                b * drive
            };
        }
        before
    }
}
