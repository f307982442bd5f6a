//! `wall-adhesion`: the bead sticks to the wall.

use super::candidate::one;
use super::speed_law::{OfSpeed, SpeedLaw};
use super::{
    Action, Candidate, Effect, EffectKind, Experiment, Form, ParameterSpec, Place, Scope, Spec, log,
};

/// Sticks to the wall unless the flow past it is faster than a threshold: a dead zone of the speed.
pub fn wall_adhesion(speed_um_per_s: f64) -> Effect {
    Effect::new(&WallAdhesion, 0, &[speed_um_per_s], &[])
}

#[derive(Debug)]
pub(super) struct WallAdhesion;

static SPEC: Spec = Spec {
    id: "wall-adhesion",
    place: Place::Bead,
    equation: "v = sign(v0) max(|v0| - threshold, 0)",
    signature: "stuck plateaus at reversals; loss of gain at small amplitude; odd harmonics",
    forms: &[Form::only(&[ParameterSpec::new(
        "speed_um_per_s",
        "um/s",
        0.0,
        1e6,
    )])],
    confused_with: &["backlash", "pzt-hysteresis"],
    experiment: Experiment::Amplitudes,
    separate_by: "an amplitude sweep: the lag of backlash shrinks to nothing, hysteresis grows, adhesion stops the bead at small amplitude; a dead zone of the driver does the same behind a plant whose speed follows the command: measure the displacement of the piezo itself",
    ..Spec::PLAIN
};

impl EffectKind for WallAdhesion {
    fn spec(&self) -> &'static Spec {
        &SPEC
    }

    fn act(&self, effect: &Effect) -> Action {
        Action::Block(Box::new(OfSpeed::new(Adhesion {
            threshold: effect.scalar(0),
        })))
    }

    fn has_doubles(&self) -> bool {
        true
    }

    fn candidates(&self) -> &'static [Candidate] {
        const ALL: &[Candidate] = &[Candidate::chain(&[log("speed_um_per_s", 0.05, 2e3)])
            .typical(0.5, 300.0)
            .smallest(0, 5.0)];
        ALL
    }

    fn starts(&self, _: usize, _: &Scope) -> Vec<Vec<f64>> {
        one([2.0, 6.0, 20.0, 50.0, 120.0])
    }
}

/// Dead zone of the speed: the bead lags the flow by the threshold and rests below it.
#[derive(Debug, Clone)]
struct Adhesion {
    threshold: f64,
}

/// Integral over a piece of the dead zone of a speed that changes linearly from `a` to `b`.
fn dead_zone_travel(a: f64, b: f64, threshold: f64, h: f64) -> f64 {
    let zone = |v: f64| (v.abs() - threshold).max(0.0) * v.signum();
    let (small, large) = (a.abs().min(b.abs()), a.abs().max(b.abs()));
    // Wholly inside or outside: no division by a small difference.
    if large <= threshold {
        return 0.0;
    }
    if (small >= threshold && a * b > 0.0) || (b - a).abs() < 1e-9 * large {
        return 0.5 * (zone(a) + zone(b)) * h;
    }
    // The dead zone is odd, so its primitive is even.
    let even = |v: f64| 0.5 * zone(v) * zone(v);
    h * (even(b) - even(a)) / (b - a)
}

impl SpeedLaw for Adhesion {
    fn travel(&mut self, _: f64, a: f64, b: f64, h_s: f64) -> f64 {
        dead_zone_travel(a, b, self.threshold, h_s)
    }

    fn speed(&self, speed: f64) -> f64 {
        (speed.abs() - self.threshold).max(0.0) * speed.signum()
    }
}
