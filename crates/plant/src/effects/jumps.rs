//! `jumps`: the bead or the table jumps.

use super::{Action, Effect, EffectKind, Experiment, Form, ParameterSpec, Place, Shown, Spec};
use cellpos_numeric::Random;

/// Steps of `um` either way at random times, `per_s` a second; nothing without a seed.
pub fn jumps(per_s: f64, um: f64) -> Effect {
    Effect::new(&Jumps, 0, &[per_s, um], &[])
}

#[derive(Debug)]
pub(super) struct Jumps;

static SPEC: Spec = Spec {
    id: "jumps",
    place: Place::Camera,
    shown_at: "bead/table",
    equation: "x + steps at random times",
    signature: "increments beyond the noise, nothing before or after",
    forms: &[Form::only(&[
        ParameterSpec::new("per_s", "1/s", 0.0, 1e3),
        ParameterSpec::new("um", "um", 0.0, 1e3),
    ])],
    confused_with: &["pixel-locking"],
    experiment: Experiment::Long,
    separate_by: "a film of the bead at the moment of a jump",
    ..Spec::PLAIN
};

impl EffectKind for Jumps {
    fn spec(&self) -> &'static Spec {
        &SPEC
    }

    fn act(&self, effect: &Effect) -> Action {
        Action::Show(Box::new(Steps {
            per_s: effect.scalar(0),
            um: effect.scalar(1),
            at_um: 0.0,
            last_s: 0.0,
            random: None,
        }))
    }
}

#[derive(Debug, Clone)]
struct Steps {
    per_s: f64,
    um: f64,
    at_um: f64,
    last_s: f64,
    random: Option<Random>,
}

impl Shown for Steps {
    fn show(&mut self, seen_um: f64, time_s: f64) -> f64 {
        if let Some(random) = &mut self.random
            && time_s > self.last_s
        {
            let chance = 1.0 - (-self.per_s * (time_s - self.last_s)).exp();
            self.last_s = time_s;
            if random.uniform() < chance {
                self.at_um += if random.uniform() < 0.5 {
                    self.um
                } else {
                    -self.um
                };
            }
        }
        seen_um + self.at_um
    }

    fn duplicate(&self) -> Box<dyn Shown> {
        Box::new(self.clone())
    }

    fn seed(&mut self, seed: u64) {
        self.random = Some(Random::new(seed));
    }
}
