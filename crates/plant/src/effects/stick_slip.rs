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
        // Close to each other: between two speeds of release the likelihood is not smooth.
        grid(&[12.0, 18.0, 27.0, 40.0, 60.0, 90.0], &[3.0, 10.0])
    }

    fn bind(&self, _: usize, values: &mut [f64]) {
        if let [start, stop] = values {
            *stop = stop.min(*start);
        }
    }
}

/// Stuck or free.
#[derive(Debug, Clone)]
struct Stick {
    break_um_per_s: f64,
    stop_um_per_s: f64,
    stuck: bool,
}

impl Stick {
    /// Where a speed that changes linearly from `a` to `b` next lets the bead go or stops it, from the part `from` of the piece on.
    fn change(&self, from: f64, a: f64, b: f64) -> Option<f64> {
        let now = a + (b - a) * from;
        // A bead that is stuck goes at either sign; one that moves stops on its side of zero.
        let (passed, limit) = if self.stuck {
            (
                now.abs() >= self.break_um_per_s,
                self.break_um_per_s.copysign(b - a),
            )
        } else {
            (
                now.abs() < self.stop_um_per_s,
                self.stop_um_per_s.copysign(now),
            )
        };
        if passed {
            return Some(from);
        }
        let at = (limit - a) / (b - a);
        let towards = self.stuck || (b - a) * now < 0.0;
        (towards && at > from && at < 1.0).then_some(at)
    }
}

impl SpeedLaw for Stick {
    fn travel(&mut self, moved: f64, a: f64, b: f64, h_s: f64) -> f64 {
        // A reversal stops the bead and may let it go again within one piece.
        const MOST_CHANGES: usize = 4;
        // What the bead moved beyond the straight line of its speed is spread evenly.
        let beyond = moved - 0.5 * (a + b) * h_s;
        let moved = |from: f64, until: f64| {
            (until - from) * (beyond + h_s * (a + 0.5 * (b - a) * (from + until)))
        };
        let (mut from, mut sum) = (0.0, 0.0);
        for _ in 0..MOST_CHANGES {
            let change = self.change(from, a, b);
            let until = change.unwrap_or(1.0);
            if !self.stuck {
                sum += moved(from, until);
            }
            if change.is_none() {
                return sum;
            }
            self.stuck = !self.stuck;
            from = until;
        }
        if self.stuck {
            sum
        } else {
            sum + moved(from, 1.0)
        }
    }

    fn speed(&self, speed: f64) -> f64 {
        if self.stuck { 0.0 } else { speed }
    }

    fn switches(&self) -> bool {
        true
    }
}
