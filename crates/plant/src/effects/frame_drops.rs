//! `frame-drops`: frames are missing.

use super::{Action, Effect, EffectKind, Experiment, Form, ParameterSpec, Place, Scope, Spec};

/// Frames are missing at random, with this probability each.
pub fn frame_drops(rate: f64) -> Effect {
    Effect::new(&KIND, 0, &[rate], &[])
}

#[derive(Debug)]
pub(super) struct FrameDrops;

pub(super) static KIND: FrameDrops = FrameDrops;

static SPEC: Spec = Spec {
    id: "frame-drops",
    place: Place::Camera,
    shown_at: "",
    equation: "row missing with probability rate",
    signature: "gaps",
    ahead_of_plant: false,
    forms: &[Form::only(&[ParameterSpec::new("rate", "", 0.0, 0.9)])],
    confused_with: &[],
    inseparable_from: &[],
    experiment: Experiment::Long,
    separate_by: "the frame ids of the camera tell a dropped frame from one without a bead",
};

impl EffectKind for FrameDrops {
    fn spec(&self) -> &'static Spec {
        &SPEC
    }

    fn act(&self, effect: &Effect) -> Action {
        Action::Drop(effect.scalar(0))
    }

    fn build(&'static self, _: usize, values: &[f64], _: &Scope) -> Effect {
        Effect::new(self, 0, values, &[])
    }
}
