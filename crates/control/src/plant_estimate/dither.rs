//! The dither: a random binary motion of the bead by the command, chosen without regard to the fixes.

use super::motion::Motion;
use crate::estimator::{Estimator, PredictedState};

/// Ticks that the bead stays on a side at least: a plant that answers over two samples still answers a whole side.
const STAY_TICKS: u32 = 2;

/// State of the dither.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Dither {
    /// Command that is added in the next tick, um.
    pub command_um: f64,
    /// The one of the last tick, which is held if no tick follows, um.
    pub given_um: f64,
    /// Motion of the model under the dither.
    pub motion: Motion,
    side: f64,
    stayed: u32,
    bits: u32,
}

impl Dither {
    pub(super) fn new() -> Self {
        Self {
            command_um: 0.0,
            given_um: 0.0,
            motion: Motion::start(0.0),
            side: 0.0,
            stayed: 0,
            bits: 0x2545_f491,
        }
    }

    /// The model one tick on, and the next command: sides `side_um` of PZT and tick from the middle. Whether all is finite.
    pub(super) fn tick(&mut self, estimator: &Estimator, side_um: f64) -> bool {
        self.given_um = self.command_um;
        let finite = self.motion.drive(estimator, self.command_um);
        self.command_um = 0.0;
        self.stayed += 1;
        if self.stayed < STAY_TICKS {
            return finite;
        }
        self.stayed = 0;
        // Galois' shift register of 32 bits, x^32 + x^22 + x^2 + x + 1: 50 days at 1 kHz until it comes round.
        let bit = self.bits & 1;
        self.bits = (self.bits >> 1) ^ (0x8020_0003 * bit);
        let side_um = if bit == 1 { side_um } else { -side_um };
        self.command_um = side_um - self.side;
        self.side = side_um;
        finite
    }

    /// A tick that never came. The actuator holds the last command, and with it the part of the dither; the bead leaves its side. That
    /// is an error for the loop to remove, so the motion that the loop is to leave alone does not have it. Whether all is finite.
    pub(super) fn hold(&mut self, estimator: &Estimator) -> bool {
        self.motion.drive(estimator, 0.0)
    }

    /// Back to the middle, while the loop does not control the bead.
    pub(super) fn rest(&mut self) {
        (self.command_um, self.given_um, self.side) = (0.0, 0.0, 0.0);
        self.motion = Motion::start(0.0);
    }

    /// State of the model that the dither made.
    pub(super) fn state(&self) -> &PredictedState {
        self.motion.state()
    }
}
