//! A user-defined effect as a block of the chain.

use super::core::{Core, Seen};
use crate::effects::{Around, Block, Piece, Shown};

/// At the driver, the piezo or the bead.
#[derive(Debug, Clone)]
pub(super) struct Inline {
    pub core: Core,
    /// The signal is the bead's: its slope is a velocity.
    pub of_bead: bool,
    pub step_s: Option<f64>,
}

impl Inline {
    fn seen(&self, time_s: f64, signal: f64, slope: f64) -> Seen {
        let (position, velocity) = if self.of_bead {
            (signal, slope)
        } else {
            (0.0, 0.0)
        };
        Seen {
            time_s,
            input: signal,
            position,
            velocity,
        }
    }
}

impl Block for Inline {
    fn advance(&mut self, time_s: f64, h_s: f64, input: Piece) -> Piece {
        let now = self.seen(time_s, input.start, input.speed_start);
        let then = self.seen(time_s + h_s, input.end, input.speed_end);
        let (start, end) = self.core.piece(h_s, &now, &then);
        Piece::line(start, end, h_s)
    }

    fn duplicate(&self) -> Box<dyn Block> {
        Box::new(self.clone())
    }

    fn needs_slopes(&self) -> bool {
        self.of_bead
    }

    fn longest_s(&self) -> Option<f64> {
        self.step_s
    }
}

/// Tied to the plant.
#[derive(Debug, Clone)]
pub(super) struct Tied {
    pub core: Core,
    pub replaces: bool,
    pub step_s: Option<f64>,
}

impl Around for Tied {
    fn replaces_output(&self) -> bool {
        self.replaces
    }

    fn longest_s(&self) -> Option<f64> {
        self.step_s
    }

    fn give(&mut self, seen: &Seen) -> f64 {
        self.core.give(seen)
    }

    fn ahead(&self, h_s: f64, now: &Seen, then: &Seen) -> f64 {
        self.core.output_ahead(h_s, now, then)
    }

    fn advance(&mut self, h_s: f64, now: &Seen, then: &Seen) {
        self.core.advance(h_s, now, then);
    }

    fn duplicate(&self) -> Box<dyn Around> {
        Box::new(self.clone())
    }
}

/// At the camera.
#[derive(Debug, Clone)]
pub(super) struct Pictured {
    pub core: Core,
}

impl Shown for Pictured {
    fn show(&mut self, seen_um: f64, time_s: f64) -> f64 {
        self.core.give(&Seen {
            time_s,
            input: seen_um,
            position: seen_um,
            velocity: 0.0,
        })
    }

    fn duplicate(&self) -> Box<dyn Shown> {
        Box::new(self.clone())
    }

    fn is_static(&self) -> bool {
        true
    }
}
