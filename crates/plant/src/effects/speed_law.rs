//! Blocks that act on the speed of the input: their common frame.

use crate::effects::action::{Block, Piece};
use std::fmt;

/// A law that maps the speed of the input to the speed of the output.
pub(crate) trait SpeedLaw: fmt::Debug + Clone + Send + Sync + 'static {
    /// How far the output moves in a jump of the input, which is infinitely fast.
    fn jump(&self, jump: f64) -> f64 {
        jump
    }

    /// Motion of the output while the input moves by `moved` in `h_s` > 0 with a speed that changes linearly from `a` to `b`.
    fn travel(&mut self, moved: f64, a: f64, b: f64, h_s: f64) -> f64;

    /// Speed of the output for a speed of the input, in the present state.
    fn speed(&self, speed: f64) -> f64;

    /// As [`Block::speed`], for laws that never stop the motion.
    fn slope(&self, speed: f64) -> f64 {
        speed
    }

    /// As [`Block::switches`].
    fn switches(&self) -> bool {
        false
    }
}

/// A block with a law of the speed.
#[derive(Debug, Clone)]
pub(crate) struct OfSpeed<L> {
    law: L,
    input: f64,
    output: f64,
}

impl<L> OfSpeed<L> {
    pub(crate) fn new(law: L) -> Self {
        Self {
            law,
            input: 0.0,
            output: 0.0,
        }
    }
}

impl<L: SpeedLaw> Block for OfSpeed<L> {
    fn advance(&mut self, _: f64, h_s: f64, input: Piece) -> Piece {
        let start = self.output + self.law.jump(input.start - self.input);
        let travel = if h_s > 0.0 {
            let moved = input.end - input.start;
            let mean = moved / h_s;
            let half = 0.5 * (input.speed_end - input.speed_start);
            self.law.travel(moved, mean - half, mean + half, h_s)
        } else {
            0.0
        };
        self.input = input.end;
        self.output = start + travel;
        Piece {
            start,
            end: self.output,
            integral: h_s * (start + 0.5 * travel),
            speed_start: self.law.speed(input.speed_start),
            speed_end: self.law.speed(input.speed_end),
        }
    }

    fn duplicate(&self) -> Box<dyn Block> {
        Box::new(self.clone())
    }

    fn needs_slopes(&self) -> bool {
        true
    }

    fn switches(&self) -> bool {
        self.law.switches()
    }

    fn speed(&self, _: f64, input_um_per_s: f64) -> f64 {
        self.law.slope(input_um_per_s)
    }
}
