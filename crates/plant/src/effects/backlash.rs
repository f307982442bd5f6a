//! `backlash`: play in the coupling to the syringe.

use super::candidate::one;
use super::{
    Action, Block, Candidate, Effect, EffectKind, Experiment, Form, ParameterSpec, Piece, Place,
    Scope, Spec, log,
};

/// Play in the coupling to the syringe: `x = max(u - width/2, min(u + width/2, x))`.
pub fn backlash(width_um: f64) -> Effect {
    Effect::new(&Backlash, 0, &[width_um], &[])
}

#[derive(Debug)]
pub(super) struct Backlash;

static SPEC: Spec = Spec {
    id: "backlash",
    place: Place::Pzt,
    equation: "x = max(u - width/2, min(u + width/2, x))",
    signature: "a lag that shrinks as the amplitude grows; flat after every reversal",
    forms: &[Form::only(&[ParameterSpec::new(
        "width_um", "um", 0.0, 100.0,
    )])],
    confused_with: &["pzt-hysteresis", "wall-adhesion"],
    experiment: Experiment::Amplitudes,
    separate_by: "an amplitude sweep: the lag of backlash shrinks to nothing, hysteresis grows, adhesion stops the bead at small amplitude",
    ..Spec::PLAIN
};

impl EffectKind for Backlash {
    fn spec(&self) -> &'static Spec {
        &SPEC
    }

    fn act(&self, effect: &Effect) -> Action {
        Action::Block(Box::new(Play {
            half_um: 0.5 * effect.scalar(0),
            x: 0.0,
        }))
    }

    fn candidates(&self) -> &'static [Candidate] {
        const ALL: &[Candidate] =
            &[Candidate::chain(&[log("width_um", 1e-3, 20.0)]).typical(0.0, 1.0)];
        ALL
    }

    fn starts(&self, _: usize, _: &Scope) -> Vec<Vec<f64>> {
        one([0.01, 0.03, 0.1, 0.25, 0.5, 1.0])
    }
}

/// Play of half width `half_um`, output `x`.
#[derive(Debug, Clone)]
struct Play {
    half_um: f64,
    x: f64,
}

impl Block for Play {
    fn advance(&mut self, _: f64, h_s: f64, input: Piece) -> Piece {
        let mut follow = |u: f64| {
            self.x = (u - self.half_um).max((u + self.half_um).min(self.x));
            self.x
        };
        let start = follow(input.start);
        let end = follow(input.end);
        Piece::line(start, end, h_s)
    }

    fn duplicate(&self) -> Box<dyn Block> {
        Box::new(self.clone())
    }
}
