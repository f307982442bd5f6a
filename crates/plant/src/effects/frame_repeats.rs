//! `frame-repeats`: frames are delivered twice.

use super::{Action, Effect, EffectKind, Experiment, Form, ParameterSpec, Place, Scope, Spec};

/// A frame is delivered twice at random: the row repeats the position of the row before.
pub fn frame_repeats(rate: f64) -> Effect {
    Effect::new(&KIND, 0, &[rate], &[])
}

#[derive(Debug)]
pub(super) struct FrameRepeats;

pub(super) static KIND: FrameRepeats = FrameRepeats;

static SPEC: Spec = Spec {
    id: "frame-repeats",
    place: Place::Camera,
    shown_at: "",
    equation: "y_k = y_(k-1) with probability rate",
    signature: "increments of exactly zero",
    ahead_of_plant: false,
    forms: &[Form::only(&[ParameterSpec::new("rate", "", 0.0, 0.9)])],
    confused_with: &[],
    inseparable_from: &[],
    experiment: Experiment::Long,
    separate_by: "the frame ids of the camera tell a repeated frame from a bead at rest",
};

impl EffectKind for FrameRepeats {
    fn spec(&self) -> &'static Spec {
        &SPEC
    }

    fn act(&self, effect: &Effect) -> Action {
        Action::Repeat(effect.scalar(0))
    }

    fn build(&'static self, _: usize, values: &[f64], _: &Scope) -> Effect {
        Effect::new(self, 0, values, &[])
    }
}
