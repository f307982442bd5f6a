//! The error at the harmonics of the reference, from a stretch of ticks with a steady addition.
//!
//! The error is differenced in part first (`x_k = e_k - 0.9 e_(k-1)`). That makes the rest of the Brownian motion nearly white, so
//! a bead that wanders slowly does not spoil a stretch of three cycles. The phasors are divided by the response of the difference.

use super::config::HARMONICS;
use nalgebra::Complex;
use std::f64::consts::TAU;

/// Part of the last error that is subtracted.
const DIFFERENCED: f64 = 0.9;
/// Prior of the noise: its variance, um^2, and its weight in ticks.
const FIRST_NOISE_UM2: f64 = 0.03 * 0.03;
const FIRST_NOISE_TICKS: f64 = 6.0;
/// Ticks over which the noise is averaged.
const NOISE_TICKS: f64 = 2000.0;

/// The part that moves the bead along the reference in a tick, as the loop around the law has it; see [`crate::LoopOutput`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Driven {
    /// Feed-forward of the law for the plant of the design, um of PZT from neutral; 0 for a law without.
    pub feed_forward_um: f64,
    /// What its change in this tick moves the model's bead at once, um: between ticks the path begins with this, and is straight
    /// after it.
    pub jump_um: f64,
    /// Gain that the feed-forward was divided by.
    pub feed_forward_gain: f64,
    /// Gain that the loop is tuned to, over the design's.
    pub gain: f64,
    /// The command met range or slew.
    pub limited: bool,
}

impl Default for Driven {
    /// A loop that does not adapt, without a feed-forward.
    fn default() -> Self {
        Self {
            feed_forward_um: 0.0,
            jump_um: 0.0,
            feed_forward_gain: 1.0,
            gain: 1.0,
            limited: false,
        }
    }
}

/// Sums at one harmonic.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Sums {
    error: Complex<f64>,
    one: Complex<f64>,
    forward: Complex<f64>,
    divided: Complex<f64>,
}

/// A stretch of ticks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Evidence {
    sums: [Sums; HARMONICS],
    sum: f64,
    squares: f64,
    limited: u32,
    ticks: u32,
    before_um: Option<f64>,
}

impl Default for Evidence {
    fn default() -> Self {
        Self {
            sums: [Sums::default(); HARMONICS],
            sum: 0.0,
            squares: 0.0,
            limited: 0,
            ticks: 0,
            before_um: None,
        }
    }
}

/// Variance of the differenced error, as far as it is noise.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct ErrorNoise {
    um2: f64,
    ticks: f64,
}

impl Default for ErrorNoise {
    fn default() -> Self {
        Self {
            um2: FIRST_NOISE_UM2,
            ticks: FIRST_NOISE_TICKS,
        }
    }
}

impl ErrorNoise {
    fn with(&self, (um2, ticks): (f64, f64)) -> Self {
        let all = self.ticks + ticks;
        Self {
            um2: (self.um2 * self.ticks + um2 * ticks) / all.max(1.0),
            ticks: all.min(NOISE_TICKS),
        }
    }
}

/// The turn of a harmonic at a phase in cycles: `e^(-j 2 pi h phase)`.
pub(super) fn turn(harmonic: u32, phase: f64) -> Complex<f64> {
    let (sin, cos) = (TAU * (phase * f64::from(harmonic)).fract()).sin_cos();
    Complex::new(cos, -sin)
}

impl Evidence {
    /// Ticks so far.
    pub(super) fn ticks(&self) -> u32 {
        self.ticks
    }

    /// A tick that does not count: the error is kept for the next.
    pub(super) fn pass(&mut self, error_um: f64) {
        self.before_um = Some(error_um);
    }

    /// A gap: what comes next has no error before it. What was gathered stays.
    pub(super) fn interrupt(&mut self) {
        self.before_um = None;
    }

    /// The next stretch follows without a gap.
    pub(super) fn begin_again(&mut self) {
        *self = Self {
            before_um: self.before_um,
            ..Self::default()
        };
    }

    /// A tick: the error at its phase, and the feed-forward at the phase of the command.
    pub(super) fn add(
        &mut self,
        harmonics: impl Iterator<Item = u32>,
        (phase, error_um): (f64, f64),
        (command_phase, driven): (f64, &Driven),
    ) {
        let Some(before_um) = self.before_um.replace(error_um) else {
            return;
        };
        let x = error_um - DIFFERENCED * before_um;
        self.ticks += 1;
        self.sum += x;
        self.squares += x * x;
        self.limited += u32::from(driven.limited);
        let forward = driven.feed_forward_um;
        for h in harmonics {
            let Some(sums) = self.sums.get_mut(h as usize - 1) else {
                continue;
            };
            let then = turn(h, phase);
            sums.error += then * x;
            sums.one += then;
            let now = turn(h, command_phase);
            sums.forward += now * forward;
            sums.divided += now * (forward / driven.feed_forward_gain);
        }
    }

    /// Whether limits were met in so many of the ticks that an addition did not have its response.
    pub(super) fn is_limited(&self) -> bool {
        self.limited * 10 > self.ticks
    }

    fn differenced(&self, harmonic: u32) -> Complex<f64> {
        let sums = &self.sums[harmonic as usize - 1];
        let n = f64::from(self.ticks.max(1));
        (sums.error - sums.one * (self.sum / n)) * (2.0 / n)
    }

    /// Phasor of the error at a harmonic of a reference of this many cycles a tick, um.
    pub(super) fn error(&self, harmonic: u32, advance: f64) -> Complex<f64> {
        self.differenced(harmonic) / through(harmonic, advance)
    }

    /// By how much the feed-forward was, in the mean, above one divided by `gain`, um of PZT.
    pub(super) fn forward_over(&self, harmonic: u32, gain: f64) -> Complex<f64> {
        let sums = &self.sums[harmonic as usize - 1];
        (sums.divided - sums.forward / gain) * (2.0 / f64::from(self.ticks.max(1)))
    }

    /// The noise with that of this stretch: the residual next to the harmonics.
    pub(super) fn noise(
        &self,
        harmonics: impl Iterator<Item = u32>,
        known: &ErrorNoise,
    ) -> ErrorNoise {
        let n = f64::from(self.ticks.max(1));
        let (mut square, mut free) = (self.squares / n - (self.sum / n).powi(2), n - 1.0);
        for h in harmonics {
            square -= 0.5 * self.differenced(h).norm_sqr();
            free -= 2.0;
        }
        if free < 1.0 {
            return *known;
        }
        known.with((square.max(0.0) * n / free, free))
    }

    /// Variance of [`Evidence::error`], `E|.|^2`, um^2.
    pub(super) fn variance_um2(&self, harmonic: u32, advance: f64, noise: &ErrorNoise) -> f64 {
        4.0 * noise.um2 / f64::from(self.ticks.max(1)) / through(harmonic, advance).norm_sqr()
    }
}

/// Response of the difference.
fn through(harmonic: u32, advance: f64) -> Complex<f64> {
    Complex::new(1.0, 0.0) - turn(harmonic, advance) * DIFFERENCED
}
