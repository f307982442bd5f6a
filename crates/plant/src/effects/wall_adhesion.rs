//! `wall-adhesion`: the bead sticks to the wall.

use super::candidate::one;
use super::{
    Action, Block, Candidate, Effect, EffectKind, Experiment, Form, ParameterSpec, Place, Scope,
    Segment, Spec, log,
};

/// Sticks to the wall unless the flow past it is faster than a threshold: a dead zone of the speed.
pub fn wall_adhesion(speed_um_per_s: f64) -> Effect {
    Effect::new(&KIND, 0, &[speed_um_per_s], &[])
}

#[derive(Debug)]
pub(super) struct WallAdhesion;

pub(super) static KIND: WallAdhesion = WallAdhesion;

static SPEC: Spec = Spec {
    id: "wall-adhesion",
    place: Place::Bead,
    shown_at: "",
    equation: "v = sign(v0) max(|v0| - threshold, 0)",
    signature: "stuck plateaus at reversals; loss of gain at small amplitude; odd harmonics",
    ahead_of_plant: false,
    forms: &[Form::only(&[ParameterSpec::new(
        "speed_um_per_s",
        "um/s",
        0.0,
        1e6,
    )])],
    confused_with: &["backlash", "pzt-hysteresis"],
    inseparable_from: &[],
    experiment: Experiment::Amplitudes,
    separate_by: "an amplitude sweep: the lag of backlash shrinks to nothing, hysteresis grows, adhesion stops the bead at small amplitude",
};

impl EffectKind for WallAdhesion {
    fn spec(&self) -> &'static Spec {
        &SPEC
    }

    fn act(&self, effect: &Effect) -> Action {
        Action::Block(Box::new(Adhesion {
            threshold: effect.scalar(0),
            input: 0.0,
            output: 0.0,
        }))
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

    fn build(&'static self, _: usize, values: &[f64], _: &Scope) -> Effect {
        Effect::new(self, 0, values, &[])
    }
}

/// Dead zone of the speed: the bead lags the flow by the threshold and rests below it.
#[derive(Debug, Clone)]
struct Adhesion {
    threshold: f64,
    input: f64,
    output: f64,
}

/// Integral over a piece of the dead zone of a speed that runs straight from `a` to `b`.
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

impl Block for Adhesion {
    fn advance(&mut self, _: f64, h_s: f64, input: Segment) -> Segment {
        // A jump is infinitely fast and is followed in full.
        let start = self.output + (input.start - self.input);
        let travel = if h_s > 0.0 {
            let mean = (input.end - input.start) / h_s;
            let half = 0.5 * (input.speed_end - input.speed_start);
            dead_zone_travel(mean - half, mean + half, self.threshold, h_s)
        } else {
            0.0
        };
        let zone = |v: f64| (v.abs() - self.threshold).max(0.0) * v.signum();
        self.input = input.end;
        self.output = start + travel;
        Segment {
            start,
            end: self.output,
            integral: h_s * (start + 0.5 * travel),
            speed_start: zone(input.speed_start),
            speed_end: zone(input.speed_end),
        }
    }

    fn reset(&mut self) {
        self.input = 0.0;
        self.output = 0.0;
    }

    fn duplicate(&self) -> Box<dyn Block> {
        Box::new(self.clone())
    }

    fn needs_slopes(&self) -> bool {
        true
    }
}
