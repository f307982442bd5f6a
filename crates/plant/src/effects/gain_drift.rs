//! `gain-drift`: a gain that grows or falls with time.

use super::candidate::one;
use super::{
    Action, Block, Candidate, Effect, EffectKind, Experiment, Form, ParameterSpec, Piece, Place,
    Scope, Spec, lin,
};

/// The velocity gain drifts: `K(t) = K0 (1 + per_s t)`.
pub fn gain_drift(per_s: f64) -> Effect {
    Effect::new(&GainDrift, 0, &[per_s], &[])
}

#[derive(Debug)]
pub(super) struct GainDrift;

static SPEC: Spec = Spec {
    id: "gain-drift",
    place: Place::Bead,
    equation: "K(t) = K0 (1 + rate t)",
    signature: "the gain of the first third of a record differs from that of the last",
    forms: &[Form::only(&[ParameterSpec::new("per_s", "1/s", -1.0, 1.0)])],
    confused_with: &["gain-error"],
    experiment: Experiment::Long,
    separate_by: "one long record: compare its first and its last third at a low and at a high frequency",
    ..Spec::PLAIN
};

impl EffectKind for GainDrift {
    fn spec(&self) -> &'static Spec {
        &SPEC
    }

    fn act(&self, effect: &Effect) -> Action {
        Action::Block(Box::new(Drift {
            per_s: effect.scalar(0),
            area: 0.0,
        }))
    }

    fn candidates(&self) -> &'static [Candidate] {
        const ALL: &[Candidate] =
            &[Candidate::chain(&[lin("per_s", -0.5, 0.5, 1e-4)]).smallest(0, 1e-4)];
        ALL
    }

    fn starts(&self, _: usize, _: &Scope) -> Vec<Vec<f64>> {
        one([-0.01, -0.002, 0.002, 0.01])
    }
}

/// `(1 + per_s t) y - per_s integral(y)`: velocity times a growing gain.
#[derive(Debug, Clone)]
struct Drift {
    per_s: f64,
    area: f64,
}

impl Block for Drift {
    fn advance(&mut self, time_s: f64, h_s: f64, input: Piece) -> Piece {
        let (before, after) = (1.0 + self.per_s * time_s, 1.0 + self.per_s * (time_s + h_s));
        let earlier = self.area;
        self.area += input.integral;
        Piece {
            start: before * input.start - self.per_s * earlier,
            end: after * input.end - self.per_s * self.area,
            integral: 0.5 * (before + after) * input.integral
                - self.per_s * h_s * (earlier + 0.5 * input.integral),
            speed_start: before * input.speed_start,
            speed_end: after * input.speed_end,
        }
    }

    fn duplicate(&self) -> Box<dyn Block> {
        Box::new(self.clone())
    }

    fn needs_slopes(&self) -> bool {
        true
    }

    fn bends(&self) -> bool {
        false
    }

    fn speed(&self, time_s: f64, input_um_per_s: f64) -> f64 {
        input_um_per_s * (1.0 + self.per_s * time_s)
    }
}
