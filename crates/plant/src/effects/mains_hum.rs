//! `mains-hum`: a line at the frequency of the mains.

use super::candidate::one;
use super::{
    Action, Candidate, Effect, EffectKind, Experiment, Form, ParameterSpec, Place, Role, Scope,
    Shown, Spec, lin,
};
use std::f64::consts::TAU;

/// Camera, light or table. A line `um sin(2 pi hz t + phase)`, not tied to the input.
pub fn mains_hum(hz: f64, um: f64, phase_deg: f64) -> Effect {
    Effect::new(&KIND, 0, &[hz, um, phase_deg], &[])
}

#[derive(Debug)]
pub(super) struct MainsHum;

pub(super) static KIND: MainsHum = MainsHum;

static SPEC: Spec = Spec {
    id: "mains-hum",
    place: Place::Camera,
    shown_at: "",
    equation: "y + um sin(2 pi hz t + phase)",
    signature: "a line off the grid of the drive, its phase not tied to the input",
    ahead_of_plant: false,
    forms: &[Form::only(&[
        ParameterSpec::new("hz", "Hz", 0.1, 1e4),
        ParameterSpec::new("um", "um", -100.0, 100.0),
        ParameterSpec::new("phase_deg", "deg", -360.0, 360.0).or(0.0),
    ])],
    confused_with: &[],
    inseparable_from: &[],
    experiment: Experiment::Long,
    separate_by: "a rest with the light switched off and on, and one with the table damped",
};

impl EffectKind for MainsHum {
    fn spec(&self) -> &'static Spec {
        &SPEC
    }

    fn act(&self, effect: &Effect) -> Action {
        Action::Show(Box::new(Line {
            w: TAU * effect.scalar(0),
            um: effect.scalar(1),
            phase: effect.scalar(2).to_radians(),
        }))
    }

    fn candidates(&self) -> &'static [Candidate] {
        const ALL: &[Candidate] = &[Candidate {
            off_response: true,
            role: Role::Line { harmonics: 1 },
            ..Candidate::chain(&[lin("hz", 45.0, 65.0, 1e-3)])
        }];
        ALL
    }

    fn starts(&self, _: usize, _: &Scope) -> Vec<Vec<f64>> {
        one([50.0, 60.0])
    }

    fn build(&'static self, _: usize, values: &[f64], _: &Scope) -> Effect {
        Effect::new(self, 0, values, &[])
    }
}

#[derive(Debug, Clone)]
struct Line {
    w: f64,
    um: f64,
    phase: f64,
}

impl Shown for Line {
    fn show(&mut self, seen_um: f64, time_s: f64) -> f64 {
        seen_um + self.um * (self.w * time_s + self.phase).sin()
    }

    fn duplicate(&self) -> Box<dyn Shown> {
        Box::new(self.clone())
    }
}
