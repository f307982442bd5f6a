//! `frame-jitter`: each frame is late by a random time.

use super::time_delay::time_delay;
use super::{Action, Effect, EffectKind, Experiment, Form, ParameterSpec, Place, Shown, Spec};
use cellpos_numeric::Random;

/// Each frame is late by a time drawn evenly from 0 to `up_to_s`; nothing without a seed.
pub fn frame_jitter(up_to_s: f64) -> Effect {
    Effect::new(&FrameJitter, 0, &[up_to_s], &[])
}

/// The smallest that matters: at 100 um/s it moves a fix by 3 nm RMS \[s\].
pub const FRAME_JITTER_LEAST_S: f64 = 1e-4;

/// What it does to the mean of the positions: a delay.
pub fn frame_jitter_mean(up_to_s: f64) -> Effect {
    time_delay(0.5 * up_to_s)
}

#[derive(Debug)]
pub(super) struct FrameJitter;

static SPEC: Spec = Spec {
    id: "frame-jitter",
    place: Place::Camera,
    equation: "y(t - d), d even in 0..up_to",
    signature: "noise in proportion to the speed",
    forms: &[Form::only(&[ParameterSpec::new("up_to_s", "s", 0.0, 0.1)])],
    confused_with: &["time-delay"],
    experiment: Experiment::Long,
    separate_by: "the time stamps of the frames",
    ..Spec::PLAIN
};

impl EffectKind for FrameJitter {
    fn spec(&self) -> &'static Spec {
        &SPEC
    }

    fn act(&self, effect: &Effect) -> Action {
        Action::Show(Box::new(Jitter {
            up_to_s: effect.scalar(0),
            last: None,
            random: None,
        }))
    }
}

#[derive(Debug, Clone)]
struct Jitter {
    up_to_s: f64,
    /// Position and time before.
    last: Option<(f64, f64)>,
    random: Option<Random>,
}

impl Shown for Jitter {
    fn show(&mut self, seen_um: f64, time_s: f64) -> f64 {
        let Some(random) = &mut self.random else {
            return seen_um;
        };
        let late_s = self.up_to_s * random.uniform();
        let shown = match self.last {
            Some((before_um, before_s)) if time_s > before_s => {
                seen_um - late_s * (seen_um - before_um) / (time_s - before_s)
            }
            _ => seen_um,
        };
        self.last = Some((seen_um, time_s));
        shown
    }

    fn duplicate(&self) -> Box<dyn Shown> {
        Box::new(self.clone())
    }

    fn seed(&mut self, seed: u64) {
        self.random = Some(Random::new(seed));
    }
}
