//! `saturation`: the driver clips the command.

use super::{
    Action, Candidate, Effect, EffectKind, Experiment, FitParameter, Form, ParameterSpec, Place,
    Scope, Spec, lin,
};

/// Clips the commanded displacement to `[low_um, high_um]`, absolute, not from the working point.
pub fn saturation(low_um: f64, high_um: f64) -> Effect {
    Effect::new(&Saturation, 0, &[low_um, high_um], &[])
}

#[derive(Debug)]
pub(super) struct Saturation;

static SPEC: Spec = Spec {
    id: "saturation",
    place: Place::Driver,
    equation: "x = min(max(u, low), high)",
    signature: "flat tops at fixed levels; the gain falls above a knee",
    forms: &[Form::only(&[
        ParameterSpec::new("low_um", "um", -1e4, 1e4),
        ParameterSpec::new("high_um", "um", -1e4, 1e4),
    ])],
    confused_with: &["slew-limit"],
    experiment: Experiment::Rates,
    separate_by: "the same amplitude at a tenth of the frequency: a slew limit vanishes, a clip stays",
    ..Spec::PLAIN
};

impl EffectKind for Saturation {
    fn spec(&self) -> &'static Spec {
        &SPEC
    }

    fn act(&self, effect: &Effect) -> Action {
        Action::Clip {
            low_um: effect.scalar(0),
            high_um: effect.scalar(1),
        }
    }

    fn check(&self, effect: &Effect) -> Result<(), &'static str> {
        if effect.scalar(0) >= effect.scalar(1) {
            return Err("low_um must be below high_um");
        }
        Ok(())
    }

    fn is_curve(&self) -> bool {
        true
    }

    fn memory_s(&self, _: &Effect) -> f64 {
        0.0
    }

    fn candidates(&self) -> &'static [Candidate] {
        const ALL: &[Candidate] = &[BOTH, HIGH, LOW];
        ALL
    }

    fn starts(&self, index: usize, scope: &Scope) -> Vec<Vec<f64>> {
        let s = scope;
        let low = |c: f64| s.working_point_um + c * (s.low_um - s.working_point_um);
        let high = |c: f64| s.working_point_um + c * (s.high_um - s.working_point_um);
        [0.2, 0.35, 0.5, 0.7, 0.9]
            .iter()
            .map(|c| match index {
                0 => vec![low(*c), high(*c)],
                1 => vec![high(*c)],
                _ => vec![low(*c)],
            })
            .collect()
    }

    fn bind(&self, index: usize, values: &mut [f64]) {
        if let (0, [low, high]) = (index, values) {
            *high = high.max(*low + 1e-3);
        }
    }

    fn build(&'static self, index: usize, values: &[f64], scope: &Scope) -> Effect {
        let low = values.first().copied().unwrap_or(0.0);
        let limits = match index {
            0 => [low, values.get(1).copied().unwrap_or(low)],
            // The limit of a side that is not searched is beyond every command.
            1 => [(scope.low_um - 1.0).min(0.0).min(low - 1e-3), low],
            _ => [low, (scope.high_um + 1.0).max(40.0).max(low + 1e-3)],
        };
        Effect::new(self, 0, &limits, &[])
    }
}

const LOW_UM: FitParameter = lin("low_um", -1e3, 1e4, 1e-3);
const HIGH_UM: FitParameter = lin("high_um", -1e3, 1e4, 1e-3);
const BOTH: Candidate = Candidate::chain(&[LOW_UM, HIGH_UM]);
const HIGH: Candidate = Candidate::chain(&[HIGH_UM]);
const LOW: Candidate = Candidate::chain(&[LOW_UM]);
