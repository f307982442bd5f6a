//! `pixel-locking`: the bias of a centroid within a pixel.

use super::{
    Action, Candidate, Effect, EffectKind, Experiment, Form, ParameterSpec, Place, Role, Scope,
    Shown, Spec, log,
};
use std::f64::consts::TAU;

/// `x + amplitude pixel sin(2 pi x / pixel + phase)`: the bias of a centroid within a pixel; the amplitude in parts of a pixel.
pub fn pixel_locking(pixel_um: f64, amplitude: f64, phase_deg: f64) -> Effect {
    Effect::new(&PixelLocking, 0, &[pixel_um, amplitude, phase_deg], &[])
}

#[derive(Debug)]
pub(super) struct PixelLocking;

static SPEC: Spec = Spec {
    id: "pixel-locking",
    place: Place::Camera,
    equation: "x + amplitude pixel sin(2 pi x/pixel + phase)",
    signature: "an error periodic in position",
    forms: &[Form::only(&[
        ParameterSpec::new("pixel_um", "um", 1e-3, 100.0),
        ParameterSpec::new("amplitude", "px", -0.5, 0.5),
        ParameterSpec::new("phase_deg", "deg", -360.0, 360.0).or(0.0),
    ])],
    experiment: Experiment::Long,
    separate_by: "a stage moved in steps of a tenth of a pixel",
    ..Spec::PLAIN
};

impl EffectKind for PixelLocking {
    fn spec(&self) -> &'static Spec {
        &SPEC
    }

    fn act(&self, effect: &Effect) -> Action {
        Action::Show(Box::new(Locking {
            k: TAU / effect.scalar(0),
            um: effect.scalar(1) * effect.scalar(0),
            phase: effect.scalar(2).to_radians(),
        }))
    }

    fn candidates(&self) -> &'static [Candidate] {
        const ALL: &[Candidate] = &[Candidate {
            off_response: true,
            role: Role::Position,
            ..Candidate::chain(&[log("pixel_um", 0.03, 5.0)]).typical(0.05, 1.5)
        }];
        ALL
    }

    fn starts(&self, _: usize, _: &Scope) -> Vec<Vec<f64>> {
        // Found by a scan over all pixel sizes at once.
        Vec::new()
    }
}

#[derive(Debug, Clone)]
struct Locking {
    k: f64,
    um: f64,
    phase: f64,
}

impl Shown for Locking {
    fn show(&mut self, seen_um: f64, _: f64) -> f64 {
        seen_um + self.um * (self.k * seen_um + self.phase).sin()
    }

    fn duplicate(&self) -> Box<dyn Shown> {
        Box::new(self.clone())
    }
}
