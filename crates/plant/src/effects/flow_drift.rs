//! `flow-drift`: a constant flow.

use super::candidate::one;
use super::{
    Action, Block, Candidate, Effect, EffectKind, Experiment, Form, ParameterSpec, Piece, Place,
    Scope, Spec, lin,
};

/// A constant flow added to the plant's.
pub fn flow_drift(um_per_s: f64) -> Effect {
    Effect::new(&FlowDrift, 0, &[um_per_s], &[])
}

#[derive(Debug)]
pub(super) struct FlowDrift;

static SPEC: Spec = Spec {
    id: "flow-drift",
    place: Place::Bead,
    equation: "v = v0 + um_per_s",
    signature: "a ramp in every record, the input at rest included",
    forms: &[Form::only(&[ParameterSpec::new(
        "um_per_s", "um/s", -1e4, 1e4,
    )])],
    confused_with: &["leak", "pzt-creep"],
    experiment: Experiment::Slow,
    separate_by: "a rest of ten seconds: a drift goes on, creep and leak die out; reverse a step: those flip, a drift does not",
    ..Spec::PLAIN
};

impl EffectKind for FlowDrift {
    fn spec(&self) -> &'static Spec {
        &SPEC
    }

    fn act(&self, effect: &Effect) -> Action {
        Action::Block(Box::new(Flow {
            um_per_s: effect.scalar(0),
        }))
    }

    fn candidates(&self) -> &'static [Candidate] {
        const ALL: &[Candidate] = &[Candidate {
            off_response: true,
            ..Candidate::chain(&[lin("um_per_s", -2e3, 2e3, 1e-2)]).smallest(0, 1.0)
        }];
        ALL
    }

    fn starts(&self, _: usize, _: &Scope) -> Vec<Vec<f64>> {
        one([-5.0, 5.0])
    }
}

/// A constant flow.
#[derive(Debug, Clone)]
struct Flow {
    um_per_s: f64,
}

impl Block for Flow {
    fn advance(&mut self, time_s: f64, h_s: f64, input: Piece) -> Piece {
        let v = self.um_per_s;
        Piece {
            start: input.start + v * time_s,
            end: input.end + v * (time_s + h_s),
            integral: input.integral + v * h_s * (time_s + 0.5 * h_s),
            speed_start: input.speed_start + v,
            speed_end: input.speed_end + v,
        }
    }

    fn duplicate(&self) -> Box<dyn Block> {
        Box::new(self.clone())
    }

    fn bends(&self) -> bool {
        false
    }

    fn speed(&self, _: f64, input_um_per_s: f64) -> f64 {
        input_um_per_s + self.um_per_s
    }
}
