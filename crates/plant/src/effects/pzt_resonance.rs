//! `pzt-resonance`: mechanical resonance of the piezo.

use super::candidate::grid;
use super::{
    Action, Candidate, Effect, EffectKind, Experiment, Form, ParameterSpec, Place, Scope, Spec, log,
};
use crate::modal::Zpk;
use std::f64::consts::{FRAC_1_SQRT_2, TAU};

/// Mechanical resonance: `w^2 / (s^2 + 2 zeta w s + w^2)`, undamped natural frequency and damping ratio.
pub fn pzt_resonance(frequency_hz: f64, damping: f64) -> Effect {
    Effect::new(&PztResonance, 0, &[frequency_hz, damping], &[])
}

#[derive(Debug)]
pub(super) struct PztResonance;

static SPEC: Spec = Spec {
    id: "pzt-resonance",
    place: Place::Pzt,
    equation: "w^2/(s^2 + 2 zeta w s + w^2)",
    signature: "a peak, then -180 deg; the same at all amplitudes",
    forms: &[Form::only(&[
        ParameterSpec::new("frequency_hz", "Hz", 1.0, 1e6),
        ParameterSpec::new("damping", "", 1e-4, 5.0),
    ])],
    confused_with: &["driver-lag", "time-delay", "bubble"],
    experiment: Experiment::Band,
    separate_by: "excite to 300 Hz and beyond: a pole rolls off, an exposure follows a sinc, a resonance peaks, a delay changes the phase only",
    ..Spec::PLAIN
};

impl EffectKind for PztResonance {
    fn spec(&self) -> &'static Spec {
        &SPEC
    }

    fn act(&self, effect: &Effect) -> Action {
        Action::Linear(Zpk::resonance(effect.scalar(0), effect.scalar(1)))
    }

    fn candidates(&self) -> &'static [Candidate] {
        // A response that is damped more has no peak: it is that of a lag.
        const ALL: &[Candidate] = &[Candidate::chain(&[
            log("frequency_hz", 20.0, 4e4),
            log("damping", 0.002, FRAC_1_SQRT_2),
        ])
        .typical(150.0, 4e4)];
        ALL
    }

    fn starts(&self, _: usize, _: &Scope) -> Vec<Vec<f64>> {
        grid(
            &[120.0, 200.0, 260.0, 330.0, 450.0, 700.0, 1200.0],
            &[0.03, 0.15, 0.6],
        )
    }

    fn band(&self, values: &[f64], sample_s: f64) -> usize {
        values
            .first()
            .map_or(0, |hz| (2.0 * hz * sample_s) as usize)
    }

    fn lag_s(&self, _: usize, values: &[f64]) -> Option<f64> {
        Some(2.0 * values.get(1)? / (TAU * values.first()?))
    }

    fn of_lag(&self, lag_s: f64, scope: &Scope) -> Vec<(usize, Vec<f64>)> {
        // If the resonance is faster than the frames, only the phase from frame to frame shows its ringing. The sum of squares
        // then has a minimum in each quarter of a cycle, so the search starts in each.
        const DAMPING: f64 = 0.1;
        let hz = 2.0 * DAMPING / (TAU * lag_s);
        let quarters: &[f64] = if hz * scope.sample_s > 1.0 {
            &[0.0, -0.5, -0.25, 0.25, 0.5]
        } else {
            &[0.0]
        };
        quarters
            .iter()
            .map(|q| hz + q / scope.sample_s)
            .filter(|hz| (150.0..4e4).contains(hz))
            .map(|hz| (0, vec![hz, 0.5 * TAU * hz * lag_s]))
            .collect()
    }
}
