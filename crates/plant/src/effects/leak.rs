//! `leak`: a leak past the piston.

use super::candidate::one;
use super::{
    Action, Candidate, Effect, EffectKind, Experiment, Form, ParameterSpec, Place, Scope, Spec, log,
};
use crate::modal::Zpk;

/// Leak past the piston: `s / (s + corner)`.
pub fn leak(corner_rad_per_s: f64) -> Effect {
    Effect::new(&Leak, 0, &[corner_rad_per_s], &[])
}

#[derive(Debug)]
pub(super) struct Leak;

static SPEC: Spec = Spec {
    id: "leak",
    place: Place::Chip,
    equation: "s/(s + corner)",
    signature: "a step sags exponentially to zero; phase lead at low frequencies",
    forms: &[Form::only(&[ParameterSpec::new(
        "corner_rad_per_s",
        "rad/s",
        1e-6,
        1e4,
    )])],
    confused_with: &["pzt-creep", "pdms-relaxation", "flow-drift"],
    experiment: Experiment::Slow,
    separate_by: "steps both ways with holds of a minute: log-time tail (creep), exponential (relaxation), sag to zero (leak)",
    ..Spec::PLAIN
};

impl EffectKind for Leak {
    fn spec(&self) -> &'static Spec {
        &SPEC
    }

    fn act(&self, effect: &Effect) -> Action {
        Action::Linear(Zpk::high_pass(effect.scalar(0)))
    }

    fn candidates(&self) -> &'static [Candidate] {
        const ALL: &[Candidate] = &[Candidate::chain(&[log("corner_rad_per_s", 1e-4, 300.0)])
            .typical(0.005, 20.0)
            .smallest(0, 0.01)];
        ALL
    }

    fn starts(&self, _: usize, _: &Scope) -> Vec<Vec<f64>> {
        one([0.01, 0.05, 0.3, 1.0, 3.0, 10.0, 30.0])
    }
}
