//! `pdms-relaxation`: the wall of the chip as a standard linear solid.

use super::candidate::grid;
use super::{
    Action, Candidate, Effect, EffectKind, Experiment, Form, ParameterSpec, Place, Scope, Spec,
    lin, log,
};
use crate::modal::Zpk;

/// The wall as a standard linear solid: its stiffness, and with it the numerator of Eq. (A4), gets the factor
/// `(1 + (1 + strength) time s) / (1 + time s)`.
///
/// The gain far above the relaxation frequency is `1 + strength` times that below: the wall reduces slow motion. Its
/// weight in the denominator of Eq. (A4), `alpha A2/A1`, is about 2e-8 and neglected.
pub fn pdms_relaxation(time_s: f64, strength: f64) -> Effect {
    Effect::new(&PdmsRelaxation, AT_REST, &[time_s, strength], &[])
}

/// The same wall for a model whose gain is that of fast motion: the factor of [`pdms_relaxation`] over `1 + strength`.
pub fn pdms_relaxation_of_fast_gain(time_s: f64, strength: f64) -> Effect {
    Effect::new(&PdmsRelaxation, AT_SPEED, &[time_s, strength], &[])
}

/// The model's gain is that of slow motion.
const AT_REST: usize = 0;
/// The model's gain is that of fast motion.
const AT_SPEED: usize = 1;

const NUMBERS: &[ParameterSpec] = &[
    ParameterSpec::new("time_s", "s", 1e-5, 1e4),
    ParameterSpec::new("strength", "", -0.95, 20.0),
];

/// A wall only reduces motion: a fit with the other sign has found something else.
const FREE: Candidate =
    Candidate::chain(&[log("time_s", 1e-3, 50.0), lin("strength", 0.0, 5.0, 1e-3)])
        .typical(0.03, 2.0)
        .smallest(1, 0.01);

#[derive(Debug)]
pub(super) struct PdmsRelaxation;

static SPEC: Spec = Spec {
    id: "pdms-relaxation",
    place: Place::Chip,
    equation: "(1 + (1 + strength) time s)/(1 + time s), over 1 + strength where the model's gain is that of fast motion",
    signature: "a step in gain with a phase bump at 1/(2 pi time), in proportion to the amplitude",
    forms: &Form::anchored(NUMBERS),
    confused_with: &["pzt-creep", "leak", "gain-error"],
    experiment: Experiment::Slow,
    separate_by: "steps both ways with holds of a minute: log-time tail (creep), exponential (relaxation), sag to zero (leak)",
    ..Spec::PLAIN
};

impl EffectKind for PdmsRelaxation {
    fn spec(&self) -> &'static Spec {
        &SPEC
    }

    fn act(&self, effect: &Effect) -> Action {
        let (time_s, strength) = (effect.scalar(0), effect.scalar(1));
        let mut wall = Zpk::relaxation(time_s, strength);
        if effect.form_index() == AT_SPEED {
            wall.gain = 1.0;
        }
        Action::Linear(wall)
    }

    fn has_two_gains(&self) -> bool {
        true
    }

    fn candidates(&self) -> &'static [Candidate] {
        const ALL: &[Candidate] = &FREE.anchored();
        ALL
    }

    fn starts(&self, _: usize, _: &Scope) -> Vec<Vec<f64>> {
        grid(&[0.01, 0.03, 0.1, 0.3, 1.0, 3.0], &[0.1])
    }

    fn lag_s(&self, _: usize, values: &[f64]) -> Option<f64> {
        Some(-values.first()? * values.get(1)?)
    }
}
