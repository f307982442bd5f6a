//! `bubble`: a gas bubble in the chip.

use super::candidate::{grid, one};
use super::{
    Action, Block, Candidate, Effect, EffectKind, Experiment, FitParameter, Form, ParameterSpec,
    Piece, Place, Scope, Spec, lin, log,
};
use crate::modal::Zpk;
use crate::phi::phi_real;

/// A gas bubble, compliance `C = V/(n P)` behind the flow resistance R: `1 / (1 + lag s)`, `lag = R C`.
///
/// It dissolves: `lag(t) = lag exp(-dissolution t)`; zero for a lasting bubble.
pub fn bubble(lag_s: f64, dissolution_per_s: f64) -> Effect {
    Effect::new(&Bubble, 0, &[lag_s, dissolution_per_s], &[])
}

#[derive(Debug)]
pub(super) struct Bubble;

static SPEC: Spec = Spec {
    id: "bubble",
    place: Place::Chip,
    equation: "1/(1 + lag s), lag(t) = lag exp(-dissolution t)",
    signature: "an extra pole that drifts as the bubble dissolves",
    forms: &[Form::only(&[
        ParameterSpec::new("lag_s", "s", 1e-6, 100.0),
        ParameterSpec::new("dissolution_per_s", "1/s", -10.0, 10.0).or(0.0),
    ])],
    confused_with: &["driver-lag", "time-delay", "exposure-averaging"],
    inseparable_from: &["driver-lag"],
    experiment: Experiment::Band,
    separate_by: "excite to 300 Hz and beyond: a pole rolls off, an exposure follows a sinc, a resonance peaks, a delay changes the phase only",
    ..Spec::PLAIN
};

/// The experiment that distinguishes a bubble from a lag of the driver.
pub(super) const FROM_DRIVER_LAG: &str = "a lag of the driver and a bubble in the chip give the same response from command to bead: measure the piezo itself (strain gauge or capacitive sensor) with the fluid disconnected, or repeat after an hour: a bubble's lag drifts as it dissolves";

impl EffectKind for Bubble {
    fn spec(&self) -> &'static Spec {
        &SPEC
    }

    fn act(&self, effect: &Effect) -> Action {
        let (lag, dissolution) = (effect.scalar(0), effect.scalar(1));
        if dissolution == 0.0 {
            return Action::Linear(Zpk::low_pass(1.0 / lag));
        }
        Action::Block(Box::new(Dissolving {
            lag,
            dissolution,
            y: 0.0,
            speed: 0.0,
        }))
    }

    fn at_start(&self, effect: &Effect) -> Option<Zpk> {
        Some(Zpk::low_pass(1.0 / effect.scalar(0)))
    }

    fn separate_from_double(&self) -> Option<&'static str> {
        Some(FROM_DRIVER_LAG)
    }

    fn candidates(&self) -> &'static [Candidate] {
        const ALL: &[Candidate] = &[
            Candidate::chain(&[LAG]).typical(0.0032, 0.15),
            Candidate {
                name: "dissolving",
                late: true,
                ..Candidate::chain(&[LAG, lin("dissolution_per_s", -1.0, 1.0, 1e-4)])
            },
        ];
        ALL
    }

    fn starts(&self, index: usize, _: &Scope) -> Vec<Vec<f64>> {
        if index == 0 {
            one([1e-4, 5e-4, 2e-3, 6e-3, 0.02, 0.06])
        } else {
            grid(&[1e-3, 8e-3, 0.05], &[0.03])
        }
    }

    fn lag_s(&self, _: usize, values: &[f64]) -> Option<f64> {
        values.first().copied()
    }

    fn start_of_lag(&self, index: usize, lag_s: f64) -> Option<Vec<f64>> {
        // If nothing dissolves, the two forms are the same.
        (index == 1).then(|| vec![lag_s, 0.0])
    }

    fn of_lag(&self, lag_s: f64, _: &Scope) -> Vec<(usize, Vec<f64>)> {
        vec![(0, vec![lag_s])]
    }
}

const LAG: FitParameter = log("lag_s", 1e-6, 1.0);

/// First-order lag `lag exp(-dissolution t)`.
#[derive(Debug, Clone)]
struct Dissolving {
    lag: f64,
    dissolution: f64,
    y: f64,
    /// Slope at the end of the last piece, um/s.
    speed: f64,
}

impl Block for Dissolving {
    fn advance(&mut self, time_s: f64, h_s: f64, input: Piece) -> Piece {
        let start = self.y;
        if h_s <= 0.0 {
            return Piece::line(start, start, 0.0);
        }
        // The lag changes over seconds, a piece lasts less than a millisecond: its mean is enough.
        let now = (self.lag * (-self.dissolution * (time_s + 0.5 * h_s)).exp()).max(1e-9);
        let [exp, one, two] = phi_real(-h_s / now);
        let rise = input.end - input.start;
        let gain = h_s / now;
        self.y = exp * start + gain * (one * input.start + two * rise);
        self.speed = (input.end - self.y) / now;
        Piece {
            start,
            end: self.y,
            integral: input.integral - now * (self.y - start),
            speed_start: (input.start - start) / now,
            speed_end: self.speed,
        }
    }

    fn duplicate(&self) -> Box<dyn Block> {
        Box::new(self.clone())
    }

    fn speed(&self, _: f64, _: f64) -> f64 {
        self.speed
    }
}
