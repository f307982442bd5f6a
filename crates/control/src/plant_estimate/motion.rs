//! A model driven by the commands, and the innovations of its motion.

use super::whiten::{Correction, Track, Whitener};
use crate::estimator::{Estimator, Fix, PredictedState};
use crate::exposure::Past;

/// Lags of the instrument beyond the design's delay, samples. A position between two ticks is on the line through them, so that
/// any delay between the first and the last is in their span.
pub(super) const LAGS: [f64; MEMBERS] = [-1.0, 0.0, 1.0, 2.0];
/// How many.
pub(super) const MEMBERS: usize = 4;

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

    /// The same for each lag beyond `delay`, ticks.
    pub(super) fn at(&self, fix: &Fix, delay: f64, exposure: f64) -> Option<[f64; MEMBERS]> {
        let ago = delay + fix.age as f64 + fix.offset;
        let mut at_um = [0.0; MEMBERS];
        for (at, lag) in at_um.iter_mut().zip(LAGS) {
            *at = self.seen(ago + lag, exposure)?;
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
