//! `driver-lag`: first-order low-pass of the amplifier.

use super::candidate::one;
use super::{
    Action, Candidate, Effect, EffectKind, Experiment, Form, ParameterSpec, Place, Scope, Spec, log,
};
use crate::modal::Zpk;
use std::f64::consts::TAU;

/// First-order low-pass of the amplifier, `x' = w (u - x)`, `w = 2 pi bandwidth`; -3 dB at `bandwidth_hz`.
pub fn driver_lag(bandwidth_hz: f64) -> Effect {
    Effect::new(&DriverLag, 0, &[bandwidth_hz], &[])
}

#[derive(Debug)]
pub(super) struct DriverLag;

static SPEC: Spec = Spec {
    id: "driver-lag",
    place: Place::Driver,
    equation: "x' = 2 pi bandwidth (u - x)",
    signature: "gain rolls off and the phase goes to -90 deg, the same at all amplitudes",
    forms: &[Form::only(&[ParameterSpec::new(
        "bandwidth_hz",
        "Hz",
        0.1,
        1e5,
    )])],
    confused_with: &[
        "time-delay",
        "exposure-averaging",
        "bubble",
        "pzt-resonance",
    ],
    inseparable_from: &["bubble"],
    experiment: Experiment::Band,
    separate_by: "excite to 300 Hz and beyond: a pole rolls off, an exposure follows a sinc, a resonance peaks, a delay changes the phase only",
    ..Spec::PLAIN
};

impl EffectKind for DriverLag {
    fn spec(&self) -> &'static Spec {
        &SPEC
    }

    fn act(&self, effect: &Effect) -> Action {
        Action::Linear(Zpk::low_pass(TAU * effect.scalar(0)))
    }

    fn separate_from_double(&self) -> Option<&'static str> {
        Some(super::bubble::FROM_DRIVER_LAG)
    }

    fn memory_s(&self, effect: &Effect) -> f64 {
        (std::f64::consts::TAU * effect.scalar(0)).recip()
    }

    fn candidates(&self) -> &'static [Candidate] {
        const ALL: &[Candidate] =
            &[Candidate::chain(&[log("bandwidth_hz", 0.5, 2e4)]).typical(50.0, 5000.0)];
        ALL
    }

    fn starts(&self, _: usize, _: &Scope) -> Vec<Vec<f64>> {
        one([15.0, 50.0, 120.0, 300.0, 800.0, 2000.0])
    }

    fn lag_s(&self, _: usize, values: &[f64]) -> Option<f64> {
        values.first().map(|hz| 1.0 / (TAU * hz))
    }

    fn of_lag(&self, lag_s: f64, _: &Scope) -> Vec<(usize, Vec<f64>)> {
        vec![(0, vec![1.0 / (TAU * lag_s)])]
    }
}
