//! `gain-error`: another gain of actuator, pixel scale or bead height.

use super::candidate::one;
use super::{
    Action, Candidate, Effect, EffectKind, Experiment, Form, ParameterSpec, Place, Scope, Spec, lin,
};
use crate::modal::Zpk;

/// The bead's displacement is `factor` times the plant's (bead height in the slit, pixel scale, actuator gain).
pub fn gain_error(factor: f64) -> Effect {
    Effect::new(&GainError, 0, &[factor], &[])
}

#[derive(Debug)]
pub(super) struct GainError;

static SPEC: Spec = Spec {
    id: "gain-error",
    place: Place::Bead,
    shown_at: "bead/camera",
    equation: "x = factor x0",
    signature: "the same at all frequencies, amplitudes and times",
    forms: &[Form::only(&[ParameterSpec::new(
        "factor", "", -100.0, 100.0,
    )])],
    confused_with: &["pdms-relaxation", "gain-drift"],
    experiment: Experiment::Elsewhere,
    separate_by: "actuator gain, pixel scale and bead height give the same factor: image a stage micrometer for the pixel scale, measure the displacement of the piezo, and refocus on a bead at another height",
    ..Spec::PLAIN
};

impl EffectKind for GainError {
    fn spec(&self) -> &'static Spec {
        &SPEC
    }

    fn act(&self, effect: &Effect) -> Action {
        Action::Linear(Zpk {
            gain: effect.scalar(0),
            ..Zpk::one()
        })
    }

    fn check(&self, effect: &Effect) -> Result<(), &'static str> {
        if effect.scalar(0) == 0.0 {
            return Err("factor must not be zero: the bead would never move");
        }
        Ok(())
    }

    fn is_gain(&self) -> bool {
        true
    }

    fn combined(&'static self, first: &Effect, second: &Effect) -> Option<Effect> {
        Some(gain_error(first.scalar(0) * second.scalar(0)))
    }

    fn has_doubles(&self) -> bool {
        true
    }

    fn memory_s(&self, _: &Effect) -> f64 {
        0.0
    }

    fn candidates(&self) -> &'static [Candidate] {
        const ALL: &[Candidate] = &[Candidate::chain(&[lin("factor", 0.05, 20.0, 1e-3)])
            .typical(0.4, 2.5)
            .smallest(0, 0.01)
            .about(1.0)];
        ALL
    }

    fn starts(&self, _: usize, _: &Scope) -> Vec<Vec<f64>> {
        one([0.9, 1.1])
    }
}
