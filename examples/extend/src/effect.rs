//! An effect: a coupling that gives way when it is pulled and not when it is pushed, `x = u - c min(u, 0)`.

use cellpos_plant::effects::{
    Action, Block, Candidate, Effect, EffectKind, Experiment, Form, ParameterSpec, Place, Scope,
    Piece, Spec, log,
};

/// Where it is known under its id: hand it to [`cellpos_plant::effects::register`].
pub static KIND: SoftCoupling = SoftCoupling;

/// The coupling, which loses the share `give` of every pull.
pub fn soft_coupling(give: f64) -> Effect {
    Effect::new(&KIND, 0, &[give], &[])
}

/// `soft-coupling`.
#[derive(Debug)]
pub struct SoftCoupling;

static SPEC: Spec = Spec {
    id: "soft-coupling",
    place: Place::Pzt,
    equation: "x = u - give min(u, 0)",
    signature: "even harmonics in proportion to the amplitude, at all frequencies, without a lag",
    forms: &[Form::only(&[ParameterSpec::new("give", "1", 0.0, 1.0)])],
    confused_with: &["valve-asymmetry"],
    experiment: Experiment::Amplitudes,
    separate_by: "the same sine about another working point: the knee stays where the coupling is at rest",
    ..Spec::PLAIN
};

impl EffectKind for SoftCoupling {
    fn spec(&self) -> &'static Spec {
        &SPEC
    }

    fn act(&self, effect: &Effect) -> Action {
        Action::Block(Box::new(OneSided {
            give: effect.scalar(0),
        }))
    }

    fn candidates(&self) -> &'static [Candidate] {
        const ALL: &[Candidate] = &[Candidate::chain(&[log("give", 1e-4, 1.0)])];
        ALL
    }

    fn starts(&self, _: usize, _: &Scope) -> Vec<Vec<f64>> {
        [0.02, 0.1, 0.4].into_iter().map(|c| vec![c]).collect()
    }
}

#[derive(Debug, Clone)]
struct OneSided {
    give: f64,
}

impl OneSided {
    fn at(&self, u: f64) -> f64 {
        u - self.give * u.min(0.0)
    }

    fn slope(&self, u: f64) -> f64 {
        if u < 0.0 { 1.0 - self.give } else { 1.0 }
    }

    /// What is lost of the area under a straight line from `a` to `b` um within `h_s`: that of the part below zero.
    fn lost(&self, a: f64, b: f64, h_s: f64) -> f64 {
        let below = if a < 0.0 && b < 0.0 {
            0.5 * (a + b)
        } else if a * b < 0.0 {
            let least = a.min(b);
            -0.5 * least * least / (b - a).abs()
        } else {
            0.5 * a.min(b).min(0.0)
        };
        self.give * below * h_s
    }
}

impl Block for OneSided {
    fn advance(&mut self, _: f64, h_s: f64, input: Piece) -> Piece {
        Piece {
            start: self.at(input.start),
            end: self.at(input.end),
            integral: input.integral - self.lost(input.start, input.end, h_s),
            speed_start: self.slope(input.start) * input.speed_start,
            speed_end: self.slope(input.end) * input.speed_end,
        }
    }

    fn duplicate(&self) -> Box<dyn Block> {
        Box::new(self.clone())
    }

    fn needs_slopes(&self) -> bool {
        true
    }
}
