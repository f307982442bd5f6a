//! `slew-limit`: current limit of the amplifier into the capacity of the piezo.

use super::candidate::one;
use super::{
    Action, Candidate, Effect, EffectKind, Experiment, Form, ParameterSpec, Place, Scope, Spec, log,
};

/// Current limit of the amplifier into the piezo's capacity: `|dx/dt| <= rate`.
pub fn slew_limit(rate_um_per_s: f64) -> Effect {
    Effect::new(&SlewLimit, 0, &[rate_um_per_s], &[])
}

#[derive(Debug)]
pub(super) struct SlewLimit;

static SPEC: Spec = Spec {
    id: "slew-limit",
    place: Place::Driver,
    equation: "|dx/dt| <= rate",
    signature: "appears above a product of amplitude and frequency; triangles, odd harmonics",
    forms: &[Form::only(&[ParameterSpec::new(
        "rate_um_per_s",
        "um/s",
        1e-2,
        1e8,
    )])],
    confused_with: &["saturation"],
    experiment: Experiment::Rates,
    separate_by: "the same amplitude at a tenth of the frequency: a slew limit vanishes, a clip stays",
    ..Spec::PLAIN
};

impl EffectKind for SlewLimit {
    fn spec(&self) -> &'static Spec {
        &SPEC
    }

    fn act(&self, effect: &Effect) -> Action {
        Action::Slew(effect.scalar(0))
    }

    fn candidates(&self) -> &'static [Candidate] {
        const ALL: &[Candidate] = &[Candidate::chain(&[log("rate_um_per_s", 1.0, 1e6)])];
        ALL
    }

    fn starts(&self, _: usize, _: &Scope) -> Vec<Vec<f64>> {
        one([20.0, 60.0, 150.0, 350.0, 700.0, 1200.0, 2000.0, 8000.0])
    }
}
