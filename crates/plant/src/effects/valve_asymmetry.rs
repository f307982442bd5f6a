//! `valve-asymmetry`: the gain differs outward and inward.

use super::candidate::one;
use super::{
    Action, Block, Candidate, Effect, EffectKind, Experiment, Form, ParameterSpec, Place, Scope,
    Segment, Spec, lin,
};

/// The velocity is `1 + asymmetry` times as large outward and `1 - asymmetry` inward.
pub fn valve_asymmetry(asymmetry: f64) -> Effect {
    Effect::new(&KIND, 0, &[asymmetry], &[])
}

#[derive(Debug)]
pub(super) struct ValveAsymmetry;

pub(super) static KIND: ValveAsymmetry = ValveAsymmetry;

static SPEC: Spec = Spec {
    id: "valve-asymmetry",
    place: Place::Bead,
    shown_at: "",
    equation: "v (1 + a sign v)",
    signature: "drift in proportion to the speed of motion, none at rest",
    ahead_of_plant: false,
    forms: &[Form::only(&[ParameterSpec::new(
        "asymmetry",
        "",
        -0.9,
        0.9,
    )])],
    confused_with: &["flow-drift", "leak"],
    inseparable_from: &[],
    experiment: Experiment::Amplitudes,
    separate_by: "the same sine at two amplitudes and a rest: the drift of a valve goes with the speed of motion, that of a flow does not",
};

impl EffectKind for ValveAsymmetry {
    fn spec(&self) -> &'static Spec {
        &SPEC
    }

    fn act(&self, effect: &Effect) -> Action {
        Action::Block(Box::new(Valve {
            asymmetry: effect.scalar(0),
            input: 0.0,
            output: 0.0,
        }))
    }

    fn candidates(&self) -> &'static [Candidate] {
        const ALL: &[Candidate] = &[Candidate::chain(&[lin("asymmetry", -0.5, 0.5, 1e-4)])
            .typical(-0.2, 0.2)
            .smallest(0, 0.0005)];
        ALL
    }

    fn starts(&self, _: usize, _: &Scope) -> Vec<Vec<f64>> {
        one([-0.01, 0.01])
    }

    fn build(&'static self, _: usize, values: &[f64], _: &Scope) -> Effect {
        Effect::new(self, 0, values, &[])
    }
}

/// Outward faster than inward.
#[derive(Debug, Clone)]
struct Valve {
    asymmetry: f64,
    input: f64,
    output: f64,
}

/// Integral over a piece of the size of a speed that runs straight from `a` to `b`.
fn way(a: f64, b: f64, h_s: f64) -> f64 {
    if a * b >= 0.0 {
        return 0.5 * (a.abs() + b.abs()) * h_s;
    }
    0.5 * h_s * (a * a + b * b) / (a.abs() + b.abs())
}

impl Block for Valve {
    fn advance(&mut self, _: f64, h_s: f64, input: Segment) -> Segment {
        let jump = input.start - self.input;
        let start = self.output + jump + self.asymmetry * jump.abs();
        let (mean, half) = if h_s > 0.0 {
            (
                (input.end - input.start) / h_s,
                0.5 * (input.speed_end - input.speed_start),
            )
        } else {
            (0.0, 0.0)
        };
        let travel = input.end - input.start + self.asymmetry * way(mean - half, mean + half, h_s);
        self.input = input.end;
        self.output = start + travel;
        let gain = |v: f64| v + self.asymmetry * v.abs();
        Segment {
            start,
            end: self.output,
            integral: h_s * (start + 0.5 * travel),
            speed_start: gain(input.speed_start),
            speed_end: gain(input.speed_end),
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

    fn speed(&self, _: f64, input_um_per_s: f64) -> f64 {
        input_um_per_s + self.asymmetry * input_um_per_s.abs()
    }
}
