//! An effect: a coupling that gets softer the further it is pushed, `x = u - c u^3`.

use cellpos_plant::effects::{
    Action, Block, Candidate, Effect, EffectKind, Experiment, Form, ParameterSpec, Place, Scope,
    Segment, Spec, log,
};

/// Where it is known under its id: hand it to [`cellpos_plant::effects::register`].
pub static KIND: SoftCoupling = SoftCoupling;

/// The coupling with `c` per um^2.
pub fn soft_coupling(softening_per_um2: f64) -> Effect {
    Effect::new(&KIND, 0, &[softening_per_um2], &[])
}

/// `soft-coupling`.
#[derive(Debug)]
pub struct SoftCoupling;

static SPEC: Spec = Spec {
    id: "soft-coupling",
    place: Place::Pzt,
    shown_at: "",
    equation: "x = u - softening u^3",
    signature: "the gain falls with the square of the amplitude, at all frequencies, without a lag",
    ahead_of_plant: false,
    forms: &[Form::only(&[ParameterSpec::new(
        "softening_per_um2",
        "1/um^2",
        0.0,
        10.0,
    )])],
    confused_with: &["saturation"],
    inseparable_from: &[],
    experiment: Experiment::Amplitudes,
    separate_by: "an amplitude sweep: a clip has a knee, a soft coupling bends from the start",
};

impl EffectKind for SoftCoupling {
    fn spec(&self) -> &'static Spec {
        &SPEC
    }

    fn act(&self, effect: &Effect) -> Action {
        Action::Block(Box::new(Cubic {
            softening: effect.scalar(0),
        }))
    }

    fn candidates(&self) -> &'static [Candidate] {
        const ALL: &[Candidate] = &[Candidate::chain(&[log("softening_per_um2", 1e-5, 1.0)])];
        ALL
    }

    fn starts(&self, _: usize, _: &Scope) -> Vec<Vec<f64>> {
        [0.002, 0.01, 0.04].into_iter().map(|c| vec![c]).collect()
    }

    fn build(&'static self, _: usize, values: &[f64], _: &Scope) -> Effect {
        Effect::new(self, 0, values, &[])
    }
}

#[derive(Debug, Clone)]
struct Cubic {
    softening: f64,
}

impl Cubic {
    fn at(&self, u: f64) -> f64 {
        u - self.softening * u.powi(3)
    }

    fn slope(&self, u: f64) -> f64 {
        1.0 - 3.0 * self.softening * u * u
    }
}

impl Block for Cubic {
    fn advance(&mut self, _: f64, h_s: f64, input: Segment) -> Segment {
        let middle = 0.5 * (input.start + input.end);
        let [start, mid, end] = [input.start, middle, input.end].map(|u| self.at(u));
        Segment {
            start,
            end,
            // Simpson's rule: exact for a cubic of a straight line.
            integral: h_s / 6.0 * (start + 4.0 * mid + end),
            speed_start: self.slope(input.start) * input.speed_start,
            speed_end: self.slope(input.end) * input.speed_end,
        }
    }

    fn reset(&mut self) {}

    fn duplicate(&self) -> Box<dyn Block> {
        Box::new(self.clone())
    }

    fn needs_slopes(&self) -> bool {
        true
    }
}
