//! The equations of a user-defined effect, with its states, shared by its blocks.

use super::definition::{
    Compiled, INPUT, MOST, MOST_STATES, OUTPUT, POSITION, SIGNALS, TIME, VELOCITY,
};
use std::sync::Arc;

/// Limit of the states; equations that grow beyond it have no solution.
const LARGEST: f64 = 1e12;

/// The signals at one instant.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Seen {
    /// Time since the start, s.
    pub time_s: f64,
    /// Input of the place, measured from the model's state of rest.
    pub input: f64,
    /// What the plant gives.
    pub position: f64,
    /// Its slope, per second.
    pub velocity: f64,
}

/// Expressions with the values of their parameters, and the states.
#[derive(Debug, Clone)]
pub(super) struct Core {
    compiled: Arc<Compiled>,
    parameters: [f64; MOST],
    count: usize,
    start: [f64; MOST_STATES],
    states: [f64; MOST_STATES],
    /// The last output, um.
    output: f64,
    /// Size of the equations' unit at input, position and output, um.
    units: [f64; 3],
}

type Values = [f64; SIGNALS.len() + MOST];

impl Core {
    pub(super) fn new(compiled: Arc<Compiled>, parameters: &[f64], units: [f64; 3]) -> Self {
        let mut all = [0.0; MOST];
        for (slot, p) in all.iter_mut().zip(parameters) {
            *slot = *p;
        }
        let mut core = Self {
            compiled,
            parameters: all,
            count: parameters.len().min(MOST),
            start: [0.0; MOST_STATES],
            states: [0.0; MOST_STATES],
            output: 0.0,
            units,
        };
        let values = core.values(&Seen::default(), &core.states);
        for (start, program) in core.start.iter_mut().zip(&core.compiled.starts) {
            let value = program.value(&values);
            *start = if value.is_finite() { value } else { 0.0 };
        }
        core.states = core.start;
        core
    }

    pub(super) fn has_states(&self) -> bool {
        !self.compiled.rates.is_empty()
    }

    fn values(&self, seen: &Seen, states: &[f64; MOST_STATES]) -> Values {
        let mut v: Values = [0.0; SIGNALS.len() + MOST];
        let [entering, position, given] = self.units;
        v[INPUT] = seen.input / entering;
        v[OUTPUT] = self.output / given;
        v[POSITION] = seen.position / position;
        v[VELOCITY] = seen.velocity / position;
        v[TIME] = seen.time_s;
        let own = &mut v[SIGNALS.len()..];
        own[..self.count].copy_from_slice(&self.parameters[..self.count]);
        for (slot, s) in own[self.count..].iter_mut().zip(states) {
            *slot = *s;
        }
        v
    }

    /// The output at an instant; if the expression has no value, the last output is held.
    pub(super) fn output(&self, seen: &Seen) -> f64 {
        self.output_with(seen, &self.states)
    }

    fn output_with(&self, seen: &Seen, states: &[f64; MOST_STATES]) -> f64 {
        let value = self.compiled.output.value(&self.values(seen, states));
        if value.is_finite() {
            value * self.units[2]
        } else {
            self.output
        }
    }

    /// The output expected `h_s` later, if the states continue at their present rate.
    pub(super) fn output_ahead(&self, h_s: f64, now: &Seen, then: &Seen) -> f64 {
        let rates = self.rates(now, &self.states);
        self.output_with(then, &self.moved(&self.states, &rates, h_s))
    }

    fn rates(&self, seen: &Seen, states: &[f64; MOST_STATES]) -> [f64; MOST_STATES] {
        let mut rates = [0.0; MOST_STATES];
        if self.has_states() {
            let values = self.values(seen, states);
            for (rate, program) in rates.iter_mut().zip(&self.compiled.rates) {
                let value = program.value(&values);
                *rate = if value.is_finite() { value } else { 0.0 };
            }
        }
        rates
    }

    fn moved(
        &self,
        states: &[f64; MOST_STATES],
        rates: &[f64; MOST_STATES],
        h_s: f64,
    ) -> [f64; MOST_STATES] {
        std::array::from_fn(|i| (states[i] + h_s * rates[i]).clamp(-LARGEST, LARGEST))
    }

    /// Advances states and memory over a piece by the trapezoidal rule of Heun.
    pub(super) fn advance(&mut self, h_s: f64, now: &Seen, then: &Seen) {
        if self.has_states() && h_s > 0.0 {
            let first = self.rates(now, &self.states);
            let second = self.rates(then, &self.moved(&self.states, &first, h_s));
            let mean = std::array::from_fn(|i| 0.5 * (first[i] + second[i]));
            self.states = self.moved(&self.states, &mean, h_s);
        }
    }

    /// Gives the output at an instant and remembers it.
    pub(super) fn give(&mut self, seen: &Seen) -> f64 {
        self.output = self.output(seen);
        self.output
    }

    /// The outputs just after the beginning and at the end of a piece; advances states and memory.
    pub(super) fn piece(&mut self, h_s: f64, now: &Seen, then: &Seen) -> (f64, f64) {
        let start = self.give(now);
        if h_s <= 0.0 {
            return (start, start);
        }
        self.advance(h_s, now, then);
        (start, self.give(then))
    }

    /// Derivatives of output and rates by input, position, velocity and states, at rest: for small motions.
    pub(super) fn slopes(&self, size: f64) -> Slopes {
        let rest = Seen::default();
        let step = size.max(1e-9);
        let mut slopes = Slopes {
            states: self.compiled.rates.len(),
            ..Slopes::default()
        };
        for column in 0..3 {
            let at = |sign: f64| {
                let mut seen = rest;
                match column {
                    0 => seen.input = sign * step,
                    1 => seen.position = sign * step,
                    _ => seen.velocity = sign * step,
                }
                (self.output(&seen), self.rates(&seen, &self.states))
            };
            let (up, down) = (at(1.0), at(-1.0));
            slopes.output[column] = (up.0 - down.0) / (2.0 * step);
            for i in 0..MOST_STATES {
                slopes.rates[i][column] = (up.1[i] - down.1[i]) / (2.0 * step);
            }
        }
        for j in 0..slopes.states {
            let step = (1e-4 * self.states[j].abs()).max(1e-6);
            let at = |sign: f64| {
                let mut states = self.states;
                states[j] += sign * step;
                (self.output_with(&rest, &states), self.rates(&rest, &states))
            };
            let (up, down) = (at(1.0), at(-1.0));
            slopes.output[3 + j] = (up.0 - down.0) / (2.0 * step);
            for i in 0..MOST_STATES {
                slopes.rates[i][3 + j] = (up.1[i] - down.1[i]) / (2.0 * step);
            }
        }
        slopes
    }
}

/// Derivatives at rest: columns are input, position, velocity, then the states.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Slopes {
    pub states: usize,
    pub output: [f64; 3 + MOST_STATES],
    pub rates: [[f64; 3 + MOST_STATES]; MOST_STATES],
}
