//! `stiffening`: a chip that pushes back more the further it is driven.

use super::{
    Action, Block, Candidate, Effect, EffectKind, Experiment, Form, ParameterSpec, Piece, Place,
    Scope, Spec, lin,
};

/// Stiffening of the chip: the displacement that acts is `u + per_um2 u^3`, from the working point.
pub fn stiffening(per_um2: f64) -> Effect {
    Effect::new(&KIND, 0, &[per_um2], &[])
}

#[derive(Debug)]
pub(super) struct Stiffening;

pub(super) static KIND: Stiffening = Stiffening;

static SPEC: Spec = Spec {
    id: "stiffening",
    place: Place::Chip,
    shown_at: "",
    equation: "u + c u^3",
    signature: "odd harmonics that grow with the square of the amplitude at all frequencies, no lag",
    ahead_of_plant: true,
    forms: &[Form::only(&[ParameterSpec::new(
        "per_um2", "1/um^2", -10.0, 10.0,
    )])],
    confused_with: &["pzt-hysteresis", "saturation"],
    inseparable_from: &[],
    experiment: Experiment::Amplitudes,
    separate_by: "the same sine at three amplitudes: the third harmonic of a stiffening grows with the cube, at all frequencies alike",
};

impl EffectKind for Stiffening {
    fn spec(&self) -> &'static Spec {
        &SPEC
    }

    fn act(&self, effect: &Effect) -> Action {
        Action::Block(Box::new(Cubic {
            per_um2: effect.scalar(0),
        }))
    }

    fn is_curve(&self) -> bool {
        true
    }

    fn memory_s(&self, _: &Effect) -> f64 {
        0.0
    }

    fn candidates(&self) -> &'static [Candidate] {
        // Softening is excluded: it would fit the round knee of a saturation.
        const ALL: &[Candidate] =
            &[Candidate::chain(&[lin("per_um2", 0.0, 0.5, 1e-4)]).typical(0.0, 0.3)];
        ALL
    }

    fn starts(&self, _: usize, scope: &Scope) -> Vec<Vec<f64>> {
        [0.02, 0.1]
            .iter()
            .map(|c| vec![c / scope.stroke_um.powi(2).max(1e-6)])
            .collect()
    }

    fn build(&'static self, _: usize, values: &[f64], _: &Scope) -> Effect {
        Effect::new(self, 0, values, &[])
    }
}

/// `u + per_um2 u^3`.
#[derive(Debug, Clone)]
struct Cubic {
    per_um2: f64,
}

impl Block for Cubic {
    fn advance(&mut self, _: f64, h_s: f64, input: Piece) -> Piece {
        let at = |u: f64| u + self.per_um2 * u.powi(3);
        Piece::line(at(input.start), at(input.end), h_s)
    }

    fn reset(&mut self) {}

    fn duplicate(&self) -> Box<dyn Block> {
        Box::new(self.clone())
    }
}
