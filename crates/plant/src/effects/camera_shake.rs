//! `camera-shake`: the piezo shakes the camera.

use super::{
    Action, Candidate, Effect, EffectKind, Experiment, Form, ParameterSpec, Place, Scope, Spec,
    lin, log,
};
use crate::modal::Zpk;
use nalgebra::Complex;

/// The PZT's motion through a second-order high-pass, added to the record: `share s^2/(s^2 + 2 zeta w s + w^2)`.
pub fn camera_shake(frequency_hz: f64, damping: f64, share: f64) -> Effect {
    Effect::new(&CameraShake, 0, &[frequency_hz, damping, share], &[])
}

#[derive(Debug)]
pub(super) struct CameraShake;

static SPEC: Spec = Spec {
    id: "camera-shake",
    place: Place::Camera,
    equation: "y + share s^2/(s^2 + 2 zeta w s + w^2) x",
    signature: "a resonance on the measured side only, its phase +180 deg below it",
    forms: &[Form::only(&[
        ParameterSpec::new("frequency_hz", "Hz", 1.0, 1e5),
        ParameterSpec::new("damping", "", 1e-4, 5.0),
        ParameterSpec::new("share", "", -10.0, 10.0),
    ])],
    confused_with: &["pzt-resonance"],
    experiment: Experiment::Band,
    separate_by: "the camera on another table: a resonance of the piezo stays, one of the stand does not",
    ..Spec::PLAIN
};

impl EffectKind for CameraShake {
    fn spec(&self) -> &'static Spec {
        &SPEC
    }

    fn act(&self, effect: &Effect) -> Action {
        let low = Zpk::resonance(effect.scalar(0), effect.scalar(1));
        let zero = Complex::new(0.0, 0.0);
        Action::Bypass(Zpk {
            zeros: vec![zero, zero],
            gain: effect.scalar(2),
            ..low
        })
    }

    fn candidates(&self) -> &'static [Candidate] {
        const ALL: &[Candidate] = &[Candidate::chain(&[
            log("frequency_hz", 20.0, 450.0),
            log("damping", 0.005, 0.9),
            lin("share", -2.0, 2.0, 1e-3),
        ])
        .typical(25.0, 400.0)
        .smallest(2, 0.001)];
        ALL
    }

    fn starts(&self, _: usize, _: &Scope) -> Vec<Vec<f64>> {
        [35.0, 60.0, 90.0, 130.0, 180.0, 260.0]
            .iter()
            .flat_map(|hz| [0.03, 0.2].map(|z| vec![*hz, z, 0.02]))
            .collect()
    }
}
