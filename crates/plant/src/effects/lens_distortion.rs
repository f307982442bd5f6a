//! `lens-distortion`: the scale of the image changes across the field.

use super::candidate::{grid, lin};
use super::{
    Action, Candidate, Effect, EffectKind, Experiment, Form, ParameterSpec, Place, Scope, Shown,
    Spec,
};

/// `x + per_um2 (x - axis)^3` about the axis of the lens.
pub fn lens_distortion(per_um2: f64, axis_um: f64) -> Effect {
    Effect::new(&LensDistortion, 0, &[per_um2, axis_um], &[])
}

#[derive(Debug)]
pub(super) struct LensDistortion;

static SPEC: Spec = Spec {
    id: "lens-distortion",
    place: Place::Camera,
    equation: "x + c (x - axis)^3",
    signature: "the gain differs by position, not by amplitude about one place",
    forms: &[Form::only(&[
        ParameterSpec::new("per_um2", "1/um^2", -1.0, 1.0),
        ParameterSpec::new("axis_um", "um", -1e4, 1e4).or(0.0),
    ])],
    confused_with: &["gain-error"],
    experiment: Experiment::Elsewhere,
    separate_by: "a stage micrometer across the field",
    ..Spec::PLAIN
};

impl EffectKind for LensDistortion {
    fn spec(&self) -> &'static Spec {
        &SPEC
    }

    fn act(&self, effect: &Effect) -> Action {
        Action::Show(Box::new(Lens {
            per_um2: effect.scalar(0),
            axis_um: effect.scalar(1),
        }))
    }

    fn candidates(&self) -> &'static [Candidate] {
        const ALL: &[Candidate] = &[Candidate::chain(&[
            lin("per_um2", -1.0, 1.0, 1e-7),
            lin("axis_um", -1e3, 1e3, 1e-2),
        ])];
        ALL
    }

    fn starts(&self, _: usize, scope: &Scope) -> Vec<Vec<f64>> {
        // 2 % of the travel at its end, about the start of the records and about either end.
        let share = 0.02 / scope.travel_um.powi(2);
        let axes = [-1.0, 0.0, 1.0].map(|times| times * scope.travel_um);
        grid(&[-share, share], &axes)
    }
}

#[derive(Debug, Clone)]
struct Lens {
    per_um2: f64,
    axis_um: f64,
}

impl Shown for Lens {
    fn show(&mut self, seen_um: f64, _: f64) -> f64 {
        seen_um + self.per_um2 * (seen_um - self.axis_um).powi(3)
    }

    fn is_static(&self) -> bool {
        true
    }

    fn duplicate(&self) -> Box<dyn Shown> {
        Box::new(self.clone())
    }
}
