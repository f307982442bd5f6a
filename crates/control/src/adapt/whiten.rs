//! The filter that makes white noise of a bead's wandering.

use crate::error::BuildError;
use crate::riccati::kalman_gain;
use nalgebra::{DMatrix, DVector};

/// Constant-gain Kalman filter of a random walk whose drift wanders as well.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Whitener {
    gain: [f64; 2],
    /// Variance of what it makes of the wandering, um^2.
    pub noise_um2: f64,
}

/// Position and drift per tick of one series, um.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Track {
    at: f64,
    pub drift: f64,
}

impl Whitener {
    /// For variances per tick of the walk and of the drift's change, and of a fix; um^2.
    pub fn new(walk_um2: f64, drift_um2: f64, fix_um2: f64) -> Result<Self, BuildError> {
        let a = DMatrix::from_row_slice(2, 2, &[1.0, 1.0, 0.0, 1.0]);
        let seen = DVector::from_vec(vec![1.0, 0.0]);
        let q = DMatrix::from_diagonal(&DVector::from_vec(vec![walk_um2, drift_um2]));
        // Exact fixes leave no equation to solve.
        let fix_um2 = fix_um2.max(1e-3 * walk_um2);
        let gain = kalman_gain(&a, &seen, &q, fix_um2)?;
        // K = P / (P + R), so the innovation's variance P + R is R / (1 - K).
        let left = (1.0 - gain[0]).max(1e-6);
        Ok(Self {
            gain: [gain[0], gain[1]],
            noise_um2: fix_um2 / left,
        })
    }

    /// What of a value was not to be foreseen.
    pub fn innovation(track: &Track, value: f64) -> f64 {
        value - (track.at + track.drift)
    }

    /// One tick with that innovation, or with none.
    pub fn step(&self, track: &mut Track, innovation: f64) {
        track.at += track.drift + self.gain[0] * innovation;
        track.drift += self.gain[1] * innovation;
    }

    /// A series that begins here.
    pub fn begin(value: f64) -> Track {
        Track {
            at: value,
            drift: 0.0,
        }
    }
}
