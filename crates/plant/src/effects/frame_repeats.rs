//! `frame-repeats`: frames are delivered twice.

use super::{Action, Effect, EffectKind, Experiment, Form, ParameterSpec, Place, Spec};

/// A frame is delivered twice at random: the row repeats the position of the row before.
pub fn frame_repeats(rate: f64) -> Effect {
    Effect::new(&FrameRepeats, 0, &[rate], &[])
}

#[derive(Debug)]
pub(super) struct FrameRepeats;

static SPEC: Spec = Spec {
    id: "frame-repeats",
    place: Place::Camera,
    equation: "y_k = y_(k-1) with probability rate",
    signature: "increments of exactly zero",
    forms: &[Form::only(&[ParameterSpec::new("rate", "", 0.0, 0.9)])],
    experiment: Experiment::Long,
    separate_by: "the frame ids of the camera tell a repeated frame from a bead at rest",
    ..Spec::PLAIN
};

impl EffectKind for FrameRepeats {
    fn spec(&self) -> &'static Spec {
        &SPEC
    }

    fn act(&self, effect: &Effect) -> Action {
        Action::Repeat(effect.scalar(0))
    }
}
