//! `valve-asymmetry`: the gain differs outward and inward.

use super::candidate::one;
use super::speed_law::{OfSpeed, SpeedLaw};
use super::{
    Action, Candidate, Effect, EffectKind, Experiment, Form, ParameterSpec, Place, Scope, Spec, lin,
};

/// The velocity is `1 + asymmetry` times as large outward and `1 - asymmetry` inward.
pub fn valve_asymmetry(asymmetry: f64) -> Effect {
    Effect::new(&ValveAsymmetry, 0, &[asymmetry], &[])
}

#[derive(Debug)]
pub(super) struct ValveAsymmetry;

static SPEC: Spec = Spec {
    id: "valve-asymmetry",
    place: Place::Bead,
    equation: "v (1 + a sign v)",
    signature: "drift in proportion to the speed of motion, none at rest",
    forms: &[Form::only(&[ParameterSpec::new(
        "asymmetry",
        "",
        -0.9,
        0.9,
    )])],
    confused_with: &["flow-drift", "leak"],
    experiment: Experiment::Amplitudes,
    separate_by: "the same sine at two amplitudes and a rest: the drift of a valve goes with the speed of motion, that of a flow does not",
    ..Spec::PLAIN
};

impl EffectKind for ValveAsymmetry {
    fn spec(&self) -> &'static Spec {
        &SPEC
    }

    fn act(&self, effect: &Effect) -> Action {
        Action::Block(Box::new(OfSpeed::new(Valve {
            asymmetry: effect.scalar(0),
        })))
    }

    fn candidates(&self) -> &'static [Candidate] {
        const ALL: &[Candidate] = &[Candidate::chain(&[lin("asymmetry", -0.5, 0.5, 1e-4)])
            .typical(-0.2, 0.2)
            .smallest(0, 0.002)];
        ALL
    }

    fn starts(&self, _: usize, _: &Scope) -> Vec<Vec<f64>> {
        one([-0.01, 0.01])
    }
}

/// Outward faster than inward.
#[derive(Debug, Clone, Copy)]
struct Valve {
    asymmetry: f64,
}

/// Integral over a piece of the absolute speed, which changes linearly from `a` to `b`.
fn way(a: f64, b: f64, h_s: f64) -> f64 {
    if a * b >= 0.0 {
        return 0.5 * (a.abs() + b.abs()) * h_s;
    }
    0.5 * h_s * (a * a + b * b) / (a.abs() + b.abs())
}

impl SpeedLaw for Valve {
    fn jump(&self, jump: f64) -> f64 {
        self.speed(jump)
    }

    fn travel(&mut self, moved: f64, a: f64, b: f64, h_s: f64) -> f64 {
        moved + self.asymmetry * way(a, b, h_s)
    }

    fn speed(&self, speed: f64) -> f64 {
        speed + self.asymmetry * speed.abs()
    }

    fn slope(&self, speed: f64) -> f64 {
        self.speed(speed)
    }
}
