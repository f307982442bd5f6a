//! `stiffening`: a chip that pushes back more the further it is driven.

use super::{
    Action, Block, Candidate, Effect, EffectKind, Experiment, Form, ParameterSpec, Piece, Place,
    Scope, Spec, lin,
};

/// Stiffening of the chip: the displacement that acts is `u + per_um2 u^3`, from the working point.
pub fn stiffening(per_um2: f64) -> Effect {
    Effect::new(&Stiffening, CUBE, &[per_um2], &[])
}

/// The same by the square: `u + per_um u |u|`.
pub fn stiffening_by_square(per_um: f64) -> Effect {
    Effect::new(&Stiffening, SQUARE, &[per_um], &[])
}

/// Indices of the forms.
const CUBE: usize = 0;
const SQUARE: usize = 1;

/// By which power of the displacement the gain of a form grows.
fn power(form: usize) -> i32 {
    match form {
        SQUARE => 1,
        _ => 2,
    }
}

#[derive(Debug)]
pub(super) struct Stiffening;

static SPEC: Spec = Spec {
    id: "stiffening",
    place: Place::Chip,
    equation: "u + c u^3, or u + c u |u|",
    signature: "odd harmonics that grow with the square of the amplitude at all frequencies, no lag",
    ahead_of_plant: true,
    forms: &[
        Form {
            name: "cube",
            ..Form::only(&[ParameterSpec::new("per_um2", "1/um^2", -10.0, 10.0)])
        },
        Form {
            name: "square",
            ..Form::only(&[ParameterSpec::new("per_um", "1/um", -10.0, 10.0)])
        },
    ],
    confused_with: &["pzt-hysteresis", "saturation"],
    experiment: Experiment::Amplitudes,
    separate_by: "the same sine at three amplitudes: the third harmonic of a stiffening grows with the cube, at all frequencies alike",
    ..Spec::PLAIN
};

impl EffectKind for Stiffening {
    fn spec(&self) -> &'static Spec {
        &SPEC
    }

    fn act(&self, effect: &Effect) -> Action {
        Action::Block(Box::new(Stiff {
            share: effect.scalar(0),
            power: power(effect.form_index()),
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
        const ALL: &[Candidate] = &[
            Candidate {
                name: "cube",
                ..Candidate::chain(&[lin("per_um2", 0.0, 0.5, 1e-4)]).typical(0.0, 0.3)
            },
            Candidate {
                name: "square",
                ..Candidate::chain(&[lin("per_um", 0.0, 1.0, 1e-4)]).typical(0.0, 0.3)
            },
        ];
        ALL
    }

    fn starts(&self, form: usize, scope: &Scope) -> Vec<Vec<f64>> {
        let power = power(form);
        [0.02, 0.1]
            .iter()
            .map(|c| vec![c / scope.stroke_um.powi(power).max(1e-6)])
            .collect()
    }
}

/// `u + share |u|^power u`.
#[derive(Debug, Clone)]
struct Stiff {
    share: f64,
    power: i32,
}

impl Block for Stiff {
    fn advance(&mut self, _: f64, h_s: f64, input: Piece) -> Piece {
        let at = |u: f64| u + self.share * u.abs().powi(self.power) * u;
        Piece::line(at(input.start), at(input.end), h_s)
    }

    fn duplicate(&self) -> Box<dyn Block> {
        Box::new(self.clone())
    }
}
