//! `pump-pulsation`: the strokes of a pump.

use super::{
    Action, Candidate, Effect, EffectKind, Experiment, Form, ParameterSpec, Place, Role, Shown,
    Spec, lin,
};
use std::f64::consts::TAU;

/// A line below 20 Hz with its second harmonic: `um (sin(w t + p) + second sin(2 (w t + p)))`.
pub fn pump_pulsation(hz: f64, um: f64, second: f64, phase_deg: f64) -> Effect {
    Effect::new(&PumpPulsation, 0, &[hz, um, second, phase_deg], &[])
}

#[derive(Debug)]
pub(super) struct PumpPulsation;

static SPEC: Spec = Spec {
    id: "pump-pulsation",
    place: Place::Camera,
    shown_at: "bead",
    equation: "y + um (sin(w t) + second sin(2 w t))",
    signature: "a line as of the mains, at the strokes of a pump",
    forms: &[Form::only(&[
        ParameterSpec::new("hz", "Hz", 1e-3, 1e3),
        ParameterSpec::new("um", "um", -1e3, 1e3),
        ParameterSpec::new("second", "", -10.0, 10.0).or(0.0),
        ParameterSpec::new("phase_deg", "deg", -360.0, 360.0).or(0.0),
    ])],
    confused_with: &["mains-hum"],
    experiment: Experiment::Long,
    separate_by: "the pump at another speed, and stopped",
    ..Spec::PLAIN
};

impl EffectKind for PumpPulsation {
    fn spec(&self) -> &'static Spec {
        &SPEC
    }

    fn act(&self, effect: &Effect) -> Action {
        let [hz, um, second, phase_deg] = std::array::from_fn(|i| effect.scalar(i));
        Action::Show(Box::new(Strokes::new(hz, um, second, phase_deg)))
    }

    /// The harmonics of a stroke fall off at least as their number: five hold 89 % of the power of a saw-tooth.
    fn candidates(&self) -> &'static [Candidate] {
        const ALL: &[Candidate] = &[Candidate {
            off_response: true,
            role: Role::Line { harmonics: 5 },
            ..Candidate::chain(&[lin("hz", 0.5, 20.0, 1e-4)])
        }];
        ALL
    }
}

/// A line and its second harmonic, over the line.
#[derive(Debug, Clone)]
pub(super) struct Strokes {
    w: f64,
    um: f64,
    second: f64,
    phase: f64,
}

impl Strokes {
    pub(super) fn new(hz: f64, um: f64, second: f64, phase_deg: f64) -> Self {
        Self {
            w: TAU * hz,
            um,
            second,
            phase: phase_deg.to_radians(),
        }
    }
}

impl Shown for Strokes {
    fn show(&mut self, seen_um: f64, time_s: f64) -> f64 {
        let angle = self.w * time_s + self.phase;
        seen_um + self.um * (angle.sin() + self.second * (2.0 * angle).sin())
    }

    fn duplicate(&self) -> Box<dyn Shown> {
        Box::new(self.clone())
    }
}
