//! The plant as the loop sees it: an integrator with neutral, a few fast modes, a feed-through and a delay.
//!
//! `p(t) = q + sum_i c_i x_i + D (u - n)`, `dq/dt = K (u - n)`, `dx_i/dt = a_i x_i + (u - n)`, where `n` is neutral, the
//! displacement at which the bead rests. Every plant of Eq. (4) has this form once its slowest pole (587 s in Eq. (6))
//! counts as an integrator: the drift state takes up the difference.

use crate::error::{BuildError, check};

/// Modes besides the integrator that the estimator holds.
pub const MODES: usize = 2;

/// One real, stable mode: `c / (s - a)`.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct LoopMode {
    /// Pole a, rad/s, negative; 0 marks an unused place.
    pub pole_rad_per_s: f64,
    /// Residue c, 1/s.
    pub residue_per_s: f64,
}

/// The plant as the loop sees it (see the module).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LoopModel {
    /// K: bead velocity per PZT displacement from neutral, 1/s.
    pub gain_per_s: f64,
    /// Modes; unused places are zero.
    pub modes: [LoopMode; MODES],
    /// D: the part of the bead's motion that follows the PZT at once, um/um.
    pub feedthrough: f64,
    /// Time from the mid-exposure of a frame to the tick that uses it, plus any delay of the actuator, s. Without the
    /// half sample of hold.
    pub delay_s: f64,
    /// Sample time, s.
    pub sample_time_s: f64,
}

impl LoopModel {
    /// A bare integrator `K/s`, sampled at 1 kHz.
    pub fn integrator(gain_per_s: f64, delay_s: f64) -> Self {
        Self {
            gain_per_s,
            modes: [LoopMode::default(); MODES],
            feedthrough: 0.0,
            delay_s,
            sample_time_s: 1e-3,
        }
    }

    /// Eq. (6) by its partial fractions, its 587 s pole taken as an integrator.
    pub fn eq6(delay_s: f64) -> Self {
        let (k, b1, b0, a1, a0) = (
            0.01872_f64,
            20_261.5_f64,
            1_745_041.0_f64,
            76.3_f64,
            0.13_f64,
        );
        let root = (a1 * a1 - 4.0 * a0).sqrt();
        let (fast, slow) = (-(a1 + root) / 2.0, -2.0 * a0 / (a1 + root));
        let residue = |p: f64, other: f64| k * (p * p + b1 * p + b0) / (p - other);
        let mode = LoopMode {
            pole_rad_per_s: fast,
            residue_per_s: residue(fast, slow),
        };
        Self {
            gain_per_s: residue(slow, fast),
            modes: [mode, LoopMode::default()],
            feedthrough: k,
            delay_s,
            sample_time_s: 1e-3,
        }
    }

    /// Checks every value.
    ///
    /// # Errors
    /// [`BuildError::OutOfRange`] naming the key.
    pub fn validate(&self) -> Result<(), BuildError> {
        let ts_ok = self.sample_time_s > 0.0 && self.sample_time_s <= 1.0;
        check(
            "sample_time_s",
            "s",
            self.sample_time_s,
            ts_ok,
            "positive, at most 1 s",
        )?;
        let gain_ok = self.gain_per_s.abs() >= LEAST_GAIN_PER_S
            && self.gain_per_s.abs() * self.sample_time_s < 1e3;
        check(
            "gain_per_s",
            "1/s",
            self.gain_per_s,
            gain_ok,
            "at least 1e-6 per s, and less than 1000 um of bead for 1 um in a sample (Eq. (6) has 428/s)",
        )?;
        check(
            "feedthrough",
            "um/um",
            self.feedthrough,
            self.feedthrough.abs() < 1e3,
            "finite",
        )?;
        check(
            "delay_s",
            "s",
            self.delay_s,
            self.delay_s >= 0.0 && self.delay_s < 1.0,
            "0 or more, below 1 s",
        )?;
        for mode in &self.modes {
            let p = mode.pole_rad_per_s;
            check(
                "pole_rad_per_s",
                "rad/s",
                p,
                p < 0.0 || (p == 0.0 && mode.residue_per_s == 0.0),
                "negative",
            )?;
            check(
                "residue_per_s",
                "1/s",
                mode.residue_per_s,
                mode.residue_per_s.abs() * self.sample_time_s < MOST_RESIDUE_UM,
                "less than 1e9 um of bead for 1 um in a sample",
            )?;
        }
        Ok(())
    }

    /// Delay in samples, fractional.
    pub fn delay_samples(&self) -> f64 {
        self.delay_s / self.sample_time_s
    }

    /// Bead velocity per PZT displacement just after the modes have not yet responded, 1/s: `K + sum c_i`.
    pub fn fast_gain_per_s(&self) -> f64 {
        self.gain_per_s + self.modes.iter().map(|m| m.residue_per_s).sum::<f64>()
    }

    /// How late the bead's velocity follows a slow change of the displacement, s: the sum of the lags less that of the leads, without
    /// `delay_s`. 1.5 ms for Eq. (6).
    pub fn lag_s(&self) -> f64 {
        let used = self.modes.iter().filter(|m| m.pole_rad_per_s != 0.0);
        let modes: f64 = used.map(|m| m.residue_per_s / m.pole_rad_per_s).sum();
        (modes - self.feedthrough) / self.gain_per_s
    }
}

/// Gain below which no stroke moves a bead, 1/s: 1 m of stroke for 1 um/s.
const LEAST_GAIN_PER_S: f64 = 1e-6;
/// Motion by one mode in a sample for 1 um of command, um. Two poles that lie close together have large residues of opposite signs; beyond
/// this, rounding is all that is left of their difference.
const MOST_RESIDUE_UM: f64 = 1e9;
/// A mode whose time constant is shorter than this part of a sample has settled at once: its static part joins the feedthrough. The time
/// of the command is off by less than that. A fit leaves such a pole anywhere beyond the band, with a residue that grows with it.
const SETTLED_SAMPLES: f64 = 1e-3;
/// Poles slower than this count as integrators, rad/s: the drift state takes up what they lack.
const SLOWEST_RAD_PER_S: f64 = 0.5;

impl LoopModel {
    /// The partial fractions of a transfer function from displacement (relative to neutral) to bead position.
    ///
    /// # Errors
    /// No integrator, complex or unstable poles, more than [`MODES`] modes besides the integrator.
    pub fn from_transfer_function(
        plant: &cellpos_plant::TransferFunction,
        delay_s: f64,
        sample_time_s: f64,
    ) -> Result<Self, BuildError> {
        let space = cellpos_plant::StateSpace::from_transfer_function(plant);
        let n = space.order();
        let mut this = Self {
            gain_per_s: 0.0,
            modes: [LoopMode::default(); MODES],
            feedthrough: space.d,
            delay_s,
            sample_time_s,
        };
        let mut integrators = 0;
        let mut modes = Vec::new();
        for i in 0..n {
            let off = (0..n)
                .filter(|&j| j != i)
                .map(|j| space.a[(i, j)].abs())
                .fold(0.0, f64::max);
            let pole = space.a[(i, i)];
            if off > 0.0 || pole > SLOWEST_RAD_PER_S {
                return Err(BuildError::Pole { re: pole, im: off });
            }
            let residue = space.b[i] * space.c[i];
            if pole.abs() <= SLOWEST_RAD_PER_S {
                integrators += 1;
                this.gain_per_s += residue;
            } else if -pole * sample_time_s * SETTLED_SAMPLES > 1.0 {
                this.feedthrough -= residue / pole;
            } else {
                modes.push(LoopMode {
                    pole_rad_per_s: pole,
                    residue_per_s: residue,
                });
            }
        }
        if integrators == 0 || this.gain_per_s == 0.0 {
            return Err(BuildError::NoIntegrator {
                slowest_rad_per_s: SLOWEST_RAD_PER_S,
            });
        }
        if modes.len() > MODES {
            return Err(BuildError::TooManyModes {
                given: modes.len(),
                most: MODES,
            });
        }
        for (slot, mode) in this.modes.iter_mut().zip(modes) {
            *slot = mode;
        }
        this.validate()?;
        Ok(this)
    }
}
