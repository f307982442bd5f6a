//! `exposure-averaging`: the mean over the exposure.

use super::candidate::one;
use super::{
    Action, Candidate, Effect, EffectKind, Experiment, Form, ParameterSpec, Place, Scope, Spec, lin,
};

/// The mean over the exposure that ends with the frame: gain `sinc(f Te)`, phase `-180 f Te` deg.
pub fn exposure_averaging(exposure_s: f64) -> Effect {
    Effect::new(&ExposureAveraging, 0, &[exposure_s], &[])
}

#[derive(Debug)]
pub(super) struct ExposureAveraging;

static SPEC: Spec = Spec {
    id: "exposure-averaging",
    place: Place::Camera,
    equation: "mean of y over the exposure",
    signature: "gain sinc(f Te) and phase -180 f Te deg",
    forms: &[Form::only(&[ParameterSpec::new(
        "exposure_s",
        "s",
        0.0,
        1.0,
    )])],
    confused_with: &["time-delay", "driver-lag"],
    experiment: Experiment::Band,
    separate_by: "excite to 300 Hz and beyond: a pole rolls off, an exposure follows a sinc, a resonance peaks, a delay changes the phase only",
    ..Spec::PLAIN
};

impl EffectKind for ExposureAveraging {
    fn spec(&self) -> &'static Spec {
        &SPEC
    }

    fn act(&self, effect: &Effect) -> Action {
        Action::Exposure(effect.scalar(0))
    }

    fn combined(&'static self, _: &Effect, second: &Effect) -> Option<Effect> {
        // A camera has one exposure: the later estimate replaces the earlier.
        Some(second.clone())
    }

    fn memory_s(&self, effect: &Effect) -> f64 {
        effect.scalar(0)
    }

    fn candidates(&self) -> &'static [Candidate] {
        const ALL: &[Candidate] =
            &[Candidate::chain(&[lin("exposure_s", 1e-6, 0.02, 1e-5)]).typical(0.0, 0.0011)];
        ALL
    }

    fn starts(&self, _: usize, scope: &Scope) -> Vec<Vec<f64>> {
        one([0.2, 0.5, 0.9].map(|k| k * scope.sample_s))
    }

    fn lag_s(&self, _: usize, values: &[f64]) -> Option<f64> {
        values.first().map(|s| 0.5 * s)
    }

    fn of_lag(&self, lag_s: f64, _: &Scope) -> Vec<(usize, Vec<f64>)> {
        vec![(0, vec![2.0 * lag_s])]
    }
}
