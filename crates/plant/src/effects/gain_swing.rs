//! `gain-swing`: a gain that rises and falls.

use super::{
    Action, Block, Candidate, Effect, EffectKind, Experiment, Form, ParameterSpec, Piece, Place,
    Scope, Spec, lin, log,
};
use std::f64::consts::TAU;

/// The velocity gain swings: `K(t) = K0 (1 + depth sin(2 pi t / period + phase))`.
pub fn gain_swing(depth: f64, period_s: f64, phase_deg: f64) -> Effect {
    Effect::new(&GainSwing, 0, &[depth, period_s, phase_deg], &[])
}

#[derive(Debug)]
pub(super) struct GainSwing;

static SPEC: Spec = Spec {
    id: "gain-swing",
    place: Place::Bead,
    equation: "K(t) = K0 (1 + d sin(2 pi t/T + p))",
    signature: "the gain goes up and down through a record",
    forms: &[Form::only(&[
        ParameterSpec::new("depth", "", -1.0, 1.0),
        ParameterSpec::new("period_s", "s", 0.1, 1e4),
        ParameterSpec::new("phase_deg", "deg", -1e4, 1e4).or(0.0),
    ])],
    confused_with: &["gain-drift", "gain-error"],
    experiment: Experiment::Long,
    separate_by: "one long record of the same sine: its amplitude goes up and down with the period",
    ..Spec::PLAIN
};

impl EffectKind for GainSwing {
    fn spec(&self) -> &'static Spec {
        &SPEC
    }

    fn act(&self, effect: &Effect) -> Action {
        Action::Block(Box::new(Swing {
            depth: effect.scalar(0),
            w: TAU / effect.scalar(1),
            phase: effect.scalar(2).to_radians(),
            input: 0.0,
            output: 0.0,
            known: (f64::NAN, 0.0),
        }))
    }

    fn candidates(&self) -> &'static [Candidate] {
        const ALL: &[Candidate] = &[Candidate::chain(&[
            lin("depth", -0.9, 0.9, 1e-3),
            log("period_s", 1.0, 200.0),
            lin("phase_deg", -720.0, 720.0, 0.5),
        ])
        .typical(-0.5, 0.5)
        .smallest(0, 0.01)];
        ALL
    }

    fn starts(&self, _: usize, scope: &Scope) -> Vec<Vec<f64>> {
        [2.0, 3.0, 4.5, 7.0, 11.0, 18.0, 35.0, 80.0]
            .iter()
            .filter(|t| **t < 4.0 * scope.length_s)
            .flat_map(|t| [0.0, 90.0].map(|p| vec![0.1, *t, p]))
            .collect()
    }
}

/// Velocity times a swinging gain.
#[derive(Debug, Clone)]
struct Swing {
    depth: f64,
    w: f64,
    phase: f64,
    input: f64,
    output: f64,
    /// Cache of the last time and its gain: a piece begins where the piece before it ends.
    known: (f64, f64),
}

impl Swing {
    fn gain(&self, time_s: f64) -> f64 {
        1.0 + self.depth * (self.w * time_s + self.phase).sin()
    }
}

impl Block for Swing {
    fn advance(&mut self, time_s: f64, h_s: f64, input: Piece) -> Piece {
        let end_s = time_s + h_s;
        let first = if (time_s - self.known.0).abs() < 1e-12 {
            self.known.1
        } else {
            self.gain(time_s)
        };
        let last = self.gain(end_s);
        self.known = (end_s, last);
        // A piece lasts less than a thousandth of a period, so the mean of its end gains is its mean gain.
        let middle = 0.5 * (first + last);
        let start = self.output + first * (input.start - self.input);
        self.output = start + middle * (input.end - input.start);
        self.input = input.end;
        Piece {
            start,
            end: self.output,
            integral: h_s * start + middle * (input.integral - h_s * input.start),
            speed_start: first * input.speed_start,
            speed_end: last * input.speed_end,
        }
    }

    fn duplicate(&self) -> Box<dyn Block> {
        Box::new(self.clone())
    }

    fn needs_slopes(&self) -> bool {
        true
    }

    fn bends(&self) -> bool {
        false
    }

    fn speed(&self, time_s: f64, input_um_per_s: f64) -> f64 {
        input_um_per_s * self.gain(time_s)
    }
}
