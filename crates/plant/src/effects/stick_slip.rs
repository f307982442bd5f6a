//! `stick-slip`: the bead sticks until it breaks free, then moves until the flow is slow.

use super::candidate::grid;
use super::speed_law::{OfSpeed, SpeedLaw};
use super::{
    Action, Candidate, Effect, EffectKind, Experiment, Form, ParameterSpec, Place, Scope, Spec, log,
};

/// Stuck until the flow reaches `break_um_per_s`, free until it falls below `stop_um_per_s`.
pub fn stick_slip(break_um_per_s: f64, stop_um_per_s: f64) -> Effect {
    Effect::new(&StickSlip, 0, &[break_um_per_s, stop_um_per_s], &[])
}

#[derive(Debug)]
pub(super) struct StickSlip;

static SPEC: Spec = Spec {
    id: "stick-slip",
    place: Place::Bead,
    equation: "stuck until |v| > break, free until |v| < stop",
    signature: "as adhesion, but full speed once free: memory",
    forms: &[Form::only(&[
        ParameterSpec::new("break_um_per_s", "um/s", 0.0, 1e6),
        ParameterSpec::new("stop_um_per_s", "um/s", 0.0, 1e6),
    ])],
    confused_with: &["wall-adhesion", "backlash"],
    experiment: Experiment::Amplitudes,
    separate_by: "a slow triangle: adhesion moves slower than the flow, a slip at full speed once free",
    ..Spec::PLAIN
};

impl EffectKind for StickSlip {
    fn spec(&self) -> &'static Spec {
        &SPEC
    }

    fn act(&self, effect: &Effect) -> Action {
        Action::Block(Box::new(OfSpeed::new(Stick {
            break_um_per_s: effect.scalar(0),
            stop_um_per_s: effect.scalar(1),
            stuck: true,
        })))
    }

    fn check(&self, effect: &Effect) -> Result<(), &'static str> {
        if effect.scalar(1) > effect.scalar(0) {
            return Err("stop_um_per_s must not be above break_um_per_s");
        }
        Ok(())
    }

    fn has_doubles(&self) -> bool {
        true
    }

    fn candidates(&self) -> &'static [Candidate] {
        const ALL: &[Candidate] = &[Candidate::chain(&[
            log("break_um_per_s", 0.5, 2e3),
            log("stop_um_per_s", 0.05, 2e3),
        ])
        .typical(5.0, 300.0)
        .smallest(0, 5.0)];
        ALL
    }

    fn starts(&self, _: usize, _: &Scope) -> Vec<Vec<f64>> {
        grid(&[12.0, 30.0, 75.0], &[3.0, 10.0])
    }

    fn build(&'static self, _: usize, values: &[f64], _: &Scope) -> Effect {
        let v = |i: usize| values.get(i).copied().unwrap_or(0.0);
        Effect::new(self, 0, &[v(0), v(1).min(v(0))], &[])
    }
}

/// Stuck or free.
#[derive(Debug, Clone)]
struct Stick {
    break_um_per_s: f64,
    stop_um_per_s: f64,
    stuck: bool,
}

impl SpeedLaw for Stick {
    fn travel(&mut self, moved: f64, a: f64, b: f64, h_s: f64) -> f64 {
        if self.stuck {
            // It breaks free within the piece, when the speed passes the threshold.
            let limit = self.break_um_per_s;
            if a.abs() >= limit {
                self.stuck = false;
                return moved;
            }
            if b.abs() > limit {
                self.stuck = false;
                let f = (limit - a.abs()) / (b.abs() - a.abs());
                return 0.5 * (limit.copysign(b) + b) * (1.0 - f) * h_s;
            }
            return 0.0;
        }
        // A speed that passes zero passes the lower threshold as well.
        if b.abs() < self.stop_um_per_s || a * b < 0.0 {
            self.stuck = true;
        }
        moved
    }

    fn speed(&self, speed: f64) -> f64 {
        if self.stuck { 0.0 } else { speed }
    }

    fn reset(&mut self) {
        self.stuck = true;
    }
}
