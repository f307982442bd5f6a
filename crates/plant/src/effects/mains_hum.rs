//! `mains-hum`: a line at the frequency of the mains.

use super::pump_pulsation::Strokes;
use super::{
    Action, Candidate, Effect, EffectKind, Experiment, FitParameter, Form, ParameterSpec, Place,
    Role, Spec, lin,
};

/// Camera, light or table. A line `um sin(2 pi hz t + phase)`, not tied to the input.
pub fn mains_hum(hz: f64, um: f64, phase_deg: f64) -> Effect {
    Effect::new(&MainsHum, 0, &[hz, um, phase_deg], &[])
}

#[derive(Debug)]
pub(super) struct MainsHum;

static SPEC: Spec = Spec {
    id: "mains-hum",
    place: Place::Camera,
    equation: "y + um sin(2 pi hz t + phase)",
    signature: "a line off the grid of the drive, its phase not tied to the input",
    forms: &[Form::only(&[
        ParameterSpec::new("hz", "Hz", 0.1, 1e4),
        ParameterSpec::new("um", "um", -100.0, 100.0),
        ParameterSpec::new("phase_deg", "deg", -360.0, 360.0).or(0.0),
    ])],
    experiment: Experiment::Long,
    separate_by: "a rest with the light switched off and on, and one with the table damped",
    ..Spec::PLAIN
};

impl EffectKind for MainsHum {
    fn spec(&self) -> &'static Spec {
        &SPEC
    }

    fn act(&self, effect: &Effect) -> Action {
        let [hz, um, phase_deg] = std::array::from_fn(|i| effect.scalar(i));
        Action::Show(Box::new(Strokes::new(hz, um, 0.0, phase_deg)))
    }

    /// The frequency of a public grid stays within 1 % (EN 50160). A line at another frequency is no hum.
    fn candidates(&self) -> &'static [Candidate] {
        const fn line(hz: &'static [FitParameter]) -> Candidate {
            Candidate {
                off_response: true,
                role: Role::Line { harmonics: 1 },
                ..Candidate::chain(hz)
            }
        }
        const ALL: &[Candidate] = &[
            line(&[lin("hz", 49.5, 50.5, 1e-3)]),
            line(&[lin("hz", 59.4, 60.6, 1e-3)]),
        ];
        ALL
    }
}
