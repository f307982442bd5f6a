//! A model driven by the commands, and the innovations of its motion.

use super::whiten::{Correction, Track, Whitener};
use crate::estimator::{Estimator, PredictedState};
use crate::exposure::{Past, mean};

/// Lags of the series, samples, from the tick that [`Alignment`] gives.
pub(super) const LAGS: [f64; MEMBERS] = [-1.0, 0.0, 1.0, 2.0, 3.0];
/// How many: any of the delays that are looked for, from any time between two ticks.
pub(super) const MEMBERS: usize = 5;
/// Fixes of a block, where a move of the dither takes a tick. Whitened binary dither is correlated with itself over 3 ticks; a block of
/// five times that has all but a tenth of the correlation of neighbouring products.
pub(super) const BLOCK: u32 = 16;

/// Where the exposures are between the ticks.
///
/// The model's path bends at the ticks only. A position between two ticks is on the line through both, so series at whole ticks span
/// every delay. Series at any other times do not: the line through two points with a bend between them leaves the path, and a gain
/// would come out too large. The path jumps at the ticks as well if the plant has a direct feedthrough. A jump is as far as the speed
/// moves the bead in a part of a tick, so the line through the positions without jumps, taken that part further, has it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Alignment {
    /// Age of a fix that is usual, and whole ticks from its exposure to lag 0, ticks.
    usual: f64,
    whole: f64,
    /// Mean square of the ages about the usual one, but for whole ticks, ticks^2.
    scatter: f64,
}

impl Alignment {
    /// By a fix of this age, for a design with this delay, ticks.
    pub(super) fn begin(delay: f64, age: f64) -> Self {
        Self {
            usual: age,
            whole: (delay + age).floor(),
            scatter: 0.0,
        }
    }

    /// Takes the age of a fix into the usual one, over a block of fixes. Whether the series still have the usual fix within half a tick.
    #[must_use]
    pub(super) fn follow(&mut self, delay: f64, age: f64) -> bool {
        let off = age - self.usual;
        let part = off - off.round();
        self.scatter += (part * part - self.scatter) / f64::from(BLOCK);
        self.usual += off.clamp(-0.5, 0.5) / f64::from(BLOCK);
        (self.first(delay) - 0.5).abs() < 1.0
    }

    /// Where the design's delay is among the lags, samples.
    pub(super) fn first(&self, delay: f64) -> f64 {
        delay + self.usual - self.whole
    }

    /// Time over which the exposures of fixes are spread, ticks: that of each, and the scatter of their ages. Variances of times add, and
    /// that of an exposure is a twelfth of its square.
    pub(super) fn spread(&self, exposure: f64) -> f64 {
        (exposure * exposure + 12.0 * self.scatter).sqrt()
    }

    /// Age of the model's position for a lag and a fix of this age, whole ticks: a fix may come ticks late. The rest of the ages is in
    /// [`Alignment::spread`].
    fn ago(&self, lag: f64, age: f64) -> f64 {
        self.whole + lag + (age - self.usual).round()
    }
}

/// What a frame shows, as a sum over the series of the lags.
pub(super) struct Frame {
    /// Where the design's delay is among the lags, ticks.
    pub first: f64,
    /// Time in which the speed moves the bead as far as the jump does, ticks.
    pub jump: f64,
    /// Exposure, ticks.
    pub exposure: f64,
}

impl Frame {
    /// Weights of the series for a delay beyond the design's, samples. A delay beyond the lags counts as the last one.
    pub(super) fn of(&self, delay: f64) -> [f64; MEMBERS] {
        let lag = (self.first + delay - LAGS[0]).clamp(0.0, (MEMBERS - 1) as f64);
        let weight = |j: usize| {
            mean(lag, self.exposure, |lag| {
                let before = lag.floor().min((MEMBERS - 2) as f64);
                let part = lag - before - self.jump;
                Some(match j as f64 - before {
                    0.0 => 1.0 - part,
                    1.0 => part,
                    _ => 0.0,
                })
            })
        };
        std::array::from_fn(|j| weight(j).unwrap_or(0.0))
    }
}

/// The model and its recent positions, and each delay's series in the filter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Motion {
    model: PredictedState,
    past: Past,
    tracks: Option<[Track; MEMBERS]>,
}

impl Motion {
    /// At rest at a command, um.
    pub(super) fn start(command_um: f64) -> Self {
        Self {
            model: PredictedState {
                n: command_um,
                last_um: command_um,
                ..PredictedState::default()
            },
            past: Past::default(),
            tracks: None,
        }
    }

    /// One tick on with a command, um. Whether the model is still finite.
    #[must_use]
    pub(super) fn drive(&mut self, estimator: &Estimator, command_um: f64) -> bool {
        let change_um = command_um - self.model.last_um;
        self.model = estimator.tick_state(&self.model, command_um);
        let position_um = estimator.position(&self.model);
        let jump_um = estimator.model().feedthrough * change_um;
        self.past.push(position_um, jump_um);
        position_um.is_finite()
    }

    /// State of the model now.
    pub(super) fn state(&self) -> &PredictedState {
        &self.model
    }

    /// Position at the exposure of a fix that is `delay` ticks old, um; `None` if that is longer ago than is kept.
    pub(super) fn seen(&self, delay: f64, exposure: f64) -> Option<f64> {
        self.past.seen(delay, exposure)
    }

    /// Positions without jumps for each lag and a fix of this age, ticks.
    pub(super) fn at(&self, aligned: &Alignment, age: f64) -> Option<[f64; MEMBERS]> {
        let mut at_um = [0.0; MEMBERS];
        for (at, lag) in at_um.iter_mut().zip(LAGS) {
            *at = self.past.without_jumps(aligned.ago(lag, age))?;
        }
        Some(at_um)
    }

    /// Series that begin at these positions.
    pub(super) fn begin(&mut self, at_um: [f64; MEMBERS]) {
        self.tracks = Some(at_um.map(Whitener::begin));
    }

    /// Innovations of the positions; `None` before [`Motion::begin`].
    pub(super) fn innovations(
        &self,
        fix: &Correction,
        at_um: &[f64; MEMBERS],
    ) -> Option<[f64; MEMBERS]> {
        let tracks = self.tracks.as_ref()?;
        Some(std::array::from_fn(|j| {
            fix.innovation(&tracks[j], at_um[j])
        }))
    }

    /// A fix with those innovations.
    pub(super) fn follow(&mut self, fix: &Correction, innovations: &[f64; MEMBERS]) {
        let tracks = self.tracks.iter_mut().flatten();
        for (track, innovation) in tracks.zip(innovations) {
            fix.step(track, *innovation);
        }
    }
}
