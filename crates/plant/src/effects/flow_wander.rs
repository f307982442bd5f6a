//! `flow-wander`: a flow that wanders.

use super::{
    Action, Block, Effect, EffectKind, Experiment, Form, ParameterSpec, Piece, Place, Spec,
};
use cellpos_numeric::Random;

/// A flow that wanders: an Ornstein-Uhlenbeck process of `um_per_s` RMS and the correlation time `time_s`; nothing without a seed.
pub fn flow_wander(um_per_s: f64, time_s: f64) -> Effect {
    Effect::new(&FlowWander, 0, &[um_per_s, time_s], &[])
}

#[derive(Debug)]
pub(super) struct FlowWander;

static SPEC: Spec = Spec {
    id: "flow-wander",
    place: Place::Bead,
    equation: "dv = -v dt/T + noise",
    signature: "slow motion without relation to the command, at rest too",
    forms: &[Form::only(&[
        ParameterSpec::new("um_per_s", "um/s", 0.0, 1e4),
        ParameterSpec::new("time_s", "s", 1e-3, 1e4),
    ])],
    confused_with: &["flow-drift"],
    experiment: Experiment::Long,
    separate_by: "a rest of a minute: its increments are correlated over seconds",
    ..Spec::PLAIN
};

impl EffectKind for FlowWander {
    fn spec(&self) -> &'static Spec {
        &SPEC
    }

    fn act(&self, effect: &Effect) -> Action {
        Action::Block(Box::new(Wander {
            um_per_s: effect.scalar(0),
            time_s: effect.scalar(1),
            speed: 0.0,
            way: 0.0,
            random: None,
        }))
    }
}

/// An Ornstein-Uhlenbeck flow and its integral, the displacement so far.
#[derive(Debug, Clone)]
struct Wander {
    um_per_s: f64,
    time_s: f64,
    speed: f64,
    way: f64,
    random: Option<Random>,
}

impl Block for Wander {
    fn advance(&mut self, _: f64, h_s: f64, input: Piece) -> Piece {
        let (old, from) = (self.speed, self.way);
        if let Some(random) = &mut self.random
            && h_s > 0.0
        {
            let keep = (-h_s / self.time_s).exp();
            self.speed = keep * old + self.um_per_s * (1.0 - keep * keep).sqrt() * random.normal();
            self.way += 0.5 * (old + self.speed) * h_s;
        }
        Piece {
            start: input.start + from,
            end: input.end + self.way,
            integral: input.integral + 0.5 * (from + self.way) * h_s,
            speed_start: input.speed_start + old,
            speed_end: input.speed_end + self.speed,
        }
    }

    fn duplicate(&self) -> Box<dyn Block> {
        Box::new(self.clone())
    }

    fn bends(&self) -> bool {
        false
    }

    fn speed(&self, _: f64, input_um_per_s: f64) -> f64 {
        input_um_per_s + self.speed
    }

    fn seed(&mut self, seed: u64) {
        self.random = Some(Random::new(seed));
    }
}
