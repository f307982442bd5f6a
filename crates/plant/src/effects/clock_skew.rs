//! `clock-skew`: the clock of the camera runs fast or slow.

use super::candidate::one;
use super::{
    Action, Candidate, Effect, EffectKind, Experiment, Form, ParameterSpec, Place, Scope, Spec, lin,
};

/// Frame k is taken at `t_k (1 + 1e-6 ppm)` of the drive's clock.
pub fn clock_skew(ppm: f64) -> Effect {
    Effect::new(&ClockSkew, 0, &[ppm], &[])
}

#[derive(Debug)]
pub(super) struct ClockSkew;

static SPEC: Spec = Spec {
    id: "clock-skew",
    place: Place::Camera,
    equation: "t' = (1 + e) t",
    signature: "a phase error that grows through the record in proportion to frequency",
    forms: &[Form::only(&[ParameterSpec::new("ppm", "ppm", -1e5, 1e5)])],
    confused_with: &["time-delay"],
    experiment: Experiment::Long,
    separate_by: "one long record: compare its first and its last third at a low and at a high frequency",
    ..Spec::PLAIN
};

impl EffectKind for ClockSkew {
    fn spec(&self) -> &'static Spec {
        &SPEC
    }

    fn act(&self, effect: &Effect) -> Action {
        Action::Skew(1e-6 * effect.scalar(0))
    }

    fn candidates(&self) -> &'static [Candidate] {
        const ALL: &[Candidate] =
            &[Candidate::chain(&[lin("ppm", -5e4, 5e4, 1.0)]).smallest(0, 10.0)];
        ALL
    }

    fn starts(&self, _: usize, _: &Scope) -> Vec<Vec<f64>> {
        one([-400.0, -100.0, -20.0, 20.0, 100.0, 400.0])
    }
}
