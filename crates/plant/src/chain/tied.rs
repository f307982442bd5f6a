//! [`TiedPlant`]: the plant with the effects tied to it: feedback of its position, and equations that replace it.

use super::linear::LinearGroup;
use crate::effects::{Around, Piece, Seen};
use crate::modal::Zpk;

/// A plant with effects that see its input and position. Its input may depend on its position.
///
/// Within a step the input is a straight line from its value at the beginning to the value expected at the end. The plant's
/// response to that line is exact, so the error is second order in the step, whatever the plant's poles. [`Self::longest_s`]
/// keeps the step to a fifth of the fastest time constant.
#[derive(Debug, Clone)]
pub struct TiedPlant {
    plant: LinearGroup,
    ties: Vec<Box<dyn Around>>,
    drive: f64,
    position: f64,
    velocity: f64,
    longest_s: f64,
}

/// Steps are this part of the fastest time constant, and no shorter than that.
const PART_OF_TIME_CONSTANT: f64 = 0.2;
const SHORTEST_S: f64 = 2e-5;

/// With a direct path the position acts on the plant's input at once: number of iterations that solve this loop.
const ROUNDS: usize = 3;

impl TiedPlant {
    /// A plant at rest with its tied effects, in the order in which they act.
    pub fn new(plant: &Zpk, ties: Vec<Box<dyn Around>>) -> Self {
        let plant = LinearGroup::new(plant.clone(), None);
        let wanted = PART_OF_TIME_CONSTANT / plant.fastest().max(1e-6);
        let own = ties.iter().filter_map(|t| t.longest_s());
        Self {
            longest_s: own.fold(wanted, f64::min).max(SHORTEST_S),
            plant,
            ties,
            drive: 0.0,
            position: 0.0,
            velocity: 0.0,
        }
    }

    /// Longest step \[s\].
    pub fn longest_s(&self) -> f64 {
        self.longest_s
    }

    /// Whether something replaces the plant's output, which need not be 0 at rest.
    pub fn replaces_output(&self) -> bool {
        self.ties.iter().any(|t| t.replaces_output())
    }

    /// Where it is at rest, before any input.
    pub fn at_rest(&mut self) -> f64 {
        self.shown(&Seen::default(), 0.0)
    }

    /// The slope of the position at the end of the last step.
    pub fn velocity(&self) -> f64 {
        self.velocity
    }

    /// Input, position and velocity of the plant just after the input has jumped.
    fn beginning(&mut self, time_s: f64, input: f64) -> (f64, f64, f64) {
        let mut drive = self.drive;
        let (mut position, mut velocity) = self.plant.at_input(drive);
        for _ in 0..ROUNDS {
            drive = input;
            for tie in self.ties.iter_mut().filter(|t| !t.replaces_output()) {
                let seen = Seen {
                    time_s,
                    input: drive,
                    position,
                    velocity,
                };
                drive = tie.ahead(0.0, &seen, &seen);
            }
            let before = position;
            (position, velocity) = self.plant.at_input(drive);
            if position == before {
                break;
            }
        }
        (drive, position, velocity)
    }

    /// Advances over a step of `h_s` (zero: the input jumps) in which the input is a straight line.
    pub fn advance(&mut self, time_s: f64, h_s: f64, input: Piece) -> Piece {
        let (first, position, velocity) = self.beginning(time_s, input.start);
        let now = |input| Seen {
            time_s,
            input,
            position,
            velocity,
        };
        if h_s <= 0.0 {
            self.plant
                .advance(0.0, Piece::line(first, first, 0.0), true);
            self.drive = first;
            (self.position, self.velocity) = (position, velocity);
            let shown = self.shown(&now(first), position);
            return Piece {
                start: shown,
                end: shown,
                ..Piece::default()
            };
        }
        let (ahead, speed_ahead) = self.plant.ahead(h_s, first);
        let then = |input, position, velocity| Seen {
            time_s: time_s + h_s,
            input,
            position,
            velocity,
        };
        let (mut from, mut to) = (input.start, input.end);
        for tie in self.ties.iter_mut().filter(|t| !t.replaces_output()) {
            let (seen, later) = (now(from), then(to, ahead, speed_ahead));
            to = tie.ahead(h_s, &seen, &later);
            from = tie.give(&seen);
            tie.advance(h_s, &seen, &later);
        }
        let out = self.plant.advance(h_s, Piece::line(from, to, h_s), true);
        self.drive = to;
        self.velocity = out.speed_end;
        self.position = out.end;
        if !self.replaces_output() {
            return out;
        }
        let seen = now(from);
        let start = self.shown(&seen, out.start);
        let later = then(to, out.end, out.speed_end);
        for tie in self.ties.iter_mut().filter(|t| t.replaces_output()) {
            tie.advance(h_s, &seen, &later);
        }
        let end = self.shown(&later, out.end);
        Piece::line(start, end, h_s)
    }

    /// The position as it is seen after the effects that replace it.
    fn shown(&mut self, seen: &Seen, position: f64) -> f64 {
        let mut shown = position;
        for tie in self.ties.iter_mut().filter(|t| t.replaces_output()) {
            shown = tie.give(&Seen {
                position: shown,
                ..*seen
            });
        }
        shown
    }
}
