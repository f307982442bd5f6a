//! `frame-drops`: frames are missing.

use super::{Action, Effect, EffectKind, Experiment, Form, ParameterSpec, Place, Spec};

/// Frames are missing at random, with this probability each.
pub fn frame_drops(rate: f64) -> Effect {
    Effect::new(&FrameDrops, 0, &[rate], &[])
}

#[derive(Debug)]
pub(super) struct FrameDrops;

static SPEC: Spec = Spec {
    id: "frame-drops",
    place: Place::Camera,
    equation: "row missing with probability rate",
    signature: "gaps",
    forms: &[Form::only(&[ParameterSpec::new("rate", "", 0.0, 0.9)])],
    experiment: Experiment::Long,
    separate_by: "the frame ids of the camera tell a dropped frame from one without a bead",
    ..Spec::PLAIN
};

impl EffectKind for FrameDrops {
    fn spec(&self) -> &'static Spec {
        &SPEC
    }

    fn act(&self, effect: &Effect) -> Action {
        Action::Drop(effect.scalar(0))
    }
}
