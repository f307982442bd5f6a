//! `time-delay`: the record lags.

use super::candidate::one;
use super::{
    Action, Candidate, Effect, EffectKind, Experiment, Form, ParameterSpec, Place, Scope, Spec, lin,
};

/// `y(t - delay)`.
pub fn time_delay(delay_s: f64) -> Effect {
    Effect::new(&TimeDelay, 0, &[delay_s], &[])
}

#[derive(Debug)]
pub(super) struct TimeDelay;

static SPEC: Spec = Spec {
    id: "time-delay",
    place: Place::Camera,
    equation: "y(t - delay)",
    signature: "phase in proportion to frequency, flat gain",
    // A heater or a tank may be minutes late.
    forms: &[Form::only(&[ParameterSpec::new(
        "delay_s", "s", 0.0, 3600.0,
    )])],
    confused_with: &["driver-lag", "exposure-averaging", "bubble"],
    experiment: Experiment::Band,
    separate_by: "excite to 300 Hz: a pole rolls off, an exposure follows a sinc, a delay does neither",
    ..Spec::PLAIN
};

impl EffectKind for TimeDelay {
    fn spec(&self) -> &'static Spec {
        &SPEC
    }

    fn act(&self, effect: &Effect) -> Action {
        Action::Delay(effect.scalar(0))
    }

    fn combined(&'static self, first: &Effect, second: &Effect) -> Option<Effect> {
        Some(time_delay(first.scalar(0) + second.scalar(0)))
    }

    fn memory_s(&self, effect: &Effect) -> f64 {
        effect.scalar(0)
    }

    fn candidates(&self) -> &'static [Candidate] {
        // The search decides which delay is too long for a record.
        const ALL: &[Candidate] = &[Candidate::chain(&[lin("delay_s", 0.0, 3600.0, 1e-5)])
            .typical(0.0002, 0.05)
            .smallest(0, 5e-5)];
        ALL
    }

    fn starts(&self, _: usize, scope: &Scope) -> Vec<Vec<f64>> {
        one([0.1, 0.3, 1.0, 2.0, 4.0, 8.0, 20.0, 50.0].map(|k| k * scope.sample_s))
    }

    fn lag_s(&self, _: usize, values: &[f64]) -> Option<f64> {
        values.first().copied()
    }

    fn of_lag(&self, lag_s: f64, _: &Scope) -> Vec<(usize, Vec<f64>)> {
        vec![(0, vec![lag_s])]
    }
}
