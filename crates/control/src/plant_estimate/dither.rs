//! The dither: a random binary motion of the bead by the command, chosen without regard to the fixes.

use super::motion::Motion;
use crate::estimator::{Estimator, PredictedState};

/// Time in which a command of the dither moves the bead to the other side, s, or a tick if that is longer. Its power is down to a half at
/// 440 Hz, a little beyond the lines of an identification. A faster command would make a PZT ring, which no model has seen there.
const MOVE_S: f64 = 1e-3;

/// Ticks of a move. The bead then stays for one at least: a plant that answers over two samples still answers a whole side.
pub(super) fn move_ticks(sample_s: f64) -> u32 {
    (MOVE_S / sample_s).round().max(1.0) as u32
}

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
    /// Command in each tick of the move to this side, um, and ticks since it began.
    step_um: f64,
    since: u32,
    bits: u32,
}

impl Dither {
    pub(super) fn new() -> Self {
        Self {
            command_um: 0.0,
            given_um: 0.0,
            motion: Motion::start(0.0),
            side: 0.0,
            step_um: 0.0,
            since: 0,
            bits: 0x2545_f491,
        }
    }

    /// The model one tick on, and the next command: sides `side_um` of PZT and tick from the middle, moves of `move_ticks`. Whether all is
    /// finite.
    pub(super) fn tick(&mut self, estimator: &Estimator, side_um: f64, move_ticks: u32) -> bool {
        self.given_um = self.command_um;
        let finite = self.motion.drive(estimator, self.command_um);
        self.since += 1;
        if self.since > move_ticks {
            self.since = 0;
            // Galois' shift register of 32 bits, x^32 + x^22 + x^2 + x + 1: 50 days at 1 kHz until it comes round.
            let bit = self.bits & 1;
            self.bits = (self.bits >> 1) ^ (0x8020_0003 * bit);
            let side_um = if bit == 1 { side_um } else { -side_um };
            self.step_um = (side_um - self.side) / f64::from(move_ticks);
            self.side = side_um;
        }
        self.command_um = if self.since < move_ticks {
            self.step_um
        } else {
            0.0
        };
        finite
    }

    /// A tick that never came. The actuator holds the last command, and with it the part of the dither; the bead leaves its side. That
    /// is an error for the loop to remove, so the motion that the loop is to leave alone does not have it. Whether all is finite.
    pub(super) fn hold(&mut self, estimator: &Estimator) -> bool {
        self.motion.drive(estimator, 0.0)
    }

    /// Back to the middle, while the loop does not control the bead.
    pub(super) fn rest(&mut self) {
        (self.command_um, self.given_um) = (0.0, 0.0);
        (self.side, self.step_um) = (0.0, 0.0);
        self.motion = Motion::start(0.0);
    }

    /// State of the model that the dither made.
    pub(super) fn state(&self) -> &PredictedState {
        self.motion.state()
    }
}
