//! The few ways in which an effect can act on a signal of the chain.

use super::user::Seen;
use crate::modal::Zpk;
use std::fmt;

/// The action of an effect at its place.
#[derive(Debug)]
pub enum Action {
    /// A linear, time-invariant factor.
    Linear(Zpk),
    /// Limits of the driver's output \[um, absolute\].
    Clip {
        /// Smallest displacement, um.
        low_um: f64,
        /// Largest displacement, um.
        high_um: f64,
    },
    /// Limit of the speed of the driver's output \[um/s\].
    Slew(f64),
    /// Anything else between command and bead.
    Block(Box<dyn Block>),
    /// Tied to the plant: changes its input with knowledge of its position, or replaces its output.
    Around(Box<dyn Around>),
    /// Another path from the PZT's displacement to the record, parallel to the plant.
    Bypass(Zpk),
    /// `y(t - delay)`, s.
    Delay(f64),
    /// The mean over an exposure that ends with the frame, s.
    Exposure(f64),
    /// Frame k is taken at `(1 + skew) t_k`.
    Skew(f64),
    /// Probability of a missing frame.
    Drop(f64),
    /// Probability of a frame that is delivered twice.
    Repeat(f64),
    /// The picture's position for a true one.
    Show(Box<dyn Shown>),
}

/// A signal over one piece of time: a straight line, or close enough to one, from `start` to `end`.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Piece {
    /// Just after the piece's beginning, um.
    pub start: f64,
    /// Just before its end, um.
    pub end: f64,
    /// Integral over the piece, um s.
    pub integral: f64,
    /// Slope just after the beginning, um/s.
    pub speed_start: f64,
    /// Slope just before the end, um/s.
    pub speed_end: f64,
}

impl Piece {
    /// A straight line over `h_s`.
    pub fn line(start: f64, end: f64, h_s: f64) -> Self {
        let speed = if h_s > 0.0 { (end - start) / h_s } else { 0.0 };
        Self {
            start,
            end,
            integral: 0.5 * (start + end) * h_s,
            speed_start: speed,
            speed_end: speed,
        }
    }
}

/// A block of the chain that is not linear, or not constant in time, with its state.
///
/// In the loop of an emulated rig: no allocation, no panic.
pub trait Block: fmt::Debug + Send + Sync {
    /// Advances over a piece of `h_s` (zero: the input jumps, no time passes) that begins at `time_s`.
    fn advance(&mut self, time_s: f64, h_s: f64, input: Piece) -> Piece;

    /// A copy with its state.
    fn duplicate(&self) -> Box<dyn Block>;

    /// Whether it uses slopes and integrals of the input, not only the ends.
    fn needs_slopes(&self) -> bool {
        false
    }

    /// Longest time step with which it is right, s.
    fn longest_s(&self) -> Option<f64> {
        None
    }

    /// Whether a straight input can give a curved output: a moving input is then advanced in short pieces.
    fn bends(&self) -> bool {
        true
    }

    /// Whether it changes its state at some speed: only short steps tell the time of that.
    fn switches(&self) -> bool {
        false
    }

    /// The slope of the output for a slope of the input \[um/s\]; for blocks that never stop the motion.
    fn speed(&self, time_s: f64, input_um_per_s: f64) -> f64 {
        let _ = time_s;
        input_um_per_s
    }

    /// Seeds the random numbers of a block that has any; without a seed nothing is random.
    fn seed(&mut self, seed: u64) {
        let _ = seed;
    }
}

impl Clone for Box<dyn Block> {
    fn clone(&self) -> Self {
        self.duplicate()
    }
}

/// An effect that is tied to the plant. No allocation, no panic.
pub trait Around: fmt::Debug + Send + Sync {
    /// Whether its output replaces the plant's output; else it replaces the plant's input.
    fn replaces_output(&self) -> bool;

    /// Longest step of its equations \[s\], if it differs from the one that the plant's poles need.
    fn longest_s(&self) -> Option<f64>;

    /// Its output now, remembered as the last.
    fn give(&mut self, seen: &Seen) -> f64;

    /// Its output expected `h_s` later. Remembers nothing.
    fn ahead(&self, h_s: f64, now: &Seen, then: &Seen) -> f64;

    /// Advances its states over a piece.
    fn advance(&mut self, h_s: f64, now: &Seen, then: &Seen);

    /// A copy with its state.
    fn duplicate(&self) -> Box<dyn Around>;
}

impl Clone for Box<dyn Around> {
    fn clone(&self) -> Self {
        self.duplicate()
    }
}

/// The position as camera, light and table show it.
pub trait Shown: fmt::Debug + Send + Sync {
    /// The position shown for one seen at `time_s` \[um\].
    fn show(&mut self, seen_um: f64, time_s: f64) -> f64;

    /// A copy with its state.
    fn duplicate(&self) -> Box<dyn Shown>;

    /// Whether the same position always gives the same record, so that a search can use it as a part of the model.
    fn is_static(&self) -> bool {
        false
    }

    /// Seeds the random numbers of a block that has any; without a seed nothing is random.
    fn seed(&mut self, seed: u64) {
        let _ = seed;
    }
}

impl Clone for Box<dyn Shown> {
    fn clone(&self) -> Self {
        self.duplicate()
    }
}
