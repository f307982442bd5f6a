//! How well gain and delay of a plant are known, and why.

use cellpos_plant::Model;
use serde::{Deserialize, Serialize};
use std::fmt;

/// Where a margin comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MarginSource {
    /// Nothing is known: the fixed margin.
    Assumed,
    /// The model's 95 % interval, widened to three standard deviations.
    Identified,
    /// The model's interval is narrower than what changes between an identification and a run.
    Floor,
}

impl MarginSource {
    /// The source in words.
    pub fn text(self) -> &'static str {
        match self {
            Self::Assumed => "assumed: the model has no interval for it",
            Self::Identified => "three standard deviations of the identified model",
            Self::Floor => "the least, the model being known better",
        }
    }
}

/// How well the plant is known.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Uncertainty {
    /// The true gain lies between the model's divided and multiplied by this.
    pub gain_factor: f64,
    /// Why so much.
    pub gain_source: MarginSource,
    /// The true delay lies within this of the loop's, s.
    pub delay_s: f64,
    /// Why so much.
    pub delay_source: MarginSource,
}

impl Default for Uncertainty {
    /// For a model without intervals: a third of the gain either way, a third of a tick.
    fn default() -> Self {
        Self {
            gain_factor: 1.3,
            gain_source: MarginSource::Assumed,
            delay_s: 0.3e-3,
            delay_source: MarginSource::Assumed,
        }
    }
}

impl fmt::Display for Uncertainty {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "gain within a factor of {:.2} ({}), delay within {:.2} ms ({})",
            self.gain_factor,
            self.gain_source.text(),
            self.delay_s * 1e3,
            self.delay_source.text()
        )
    }
}

/// Least factor on the gain: a bead half a micrometre off the middle of a slit of 3 um, where the flow is a tenth slower
/// (Poiseuille's parabola), is not where it was when the gain was measured.
const LEAST_GAIN_FACTOR: f64 = 1.1;
/// Least uncertainty of the delay, s: by so much the wait from a frame's arrival to its command varies with the load of the
/// machine.
const LEAST_DELAY_S: f64 = 0.05e-3;
/// Three standard deviations over the half-width of a 95 % interval.
const THREE_SD: f64 = 3.0 / cellpos_numeric::statistics::Z95;

impl Uncertainty {
    /// Margins from the intervals of a model, as `cellpos identify` and `cellpos reconcile` write them: three standard
    /// deviations of gain and delay, for the delay together with its distance from the delay `loop_delay_s` that the loop
    /// reckons with (s, without the hold). A quantity without an interval keeps the margin of [`Uncertainty::default`].
    pub fn of_model(model: &Model, loop_delay_s: f64) -> Self {
        let mut out = Self::default();
        let margin = |value: f64, least: f64| {
            if value > least {
                (value, MarginSource::Identified)
            } else {
                (least, MarginSource::Floor)
            }
        };
        let usable = |[low, high]: &[f64; 2]| low.is_finite() && high.is_finite() && low <= high;
        let gain = model.intervals.get("gain_per_s").filter(|i| usable(i));
        // Both ends of one sign; a gain below zero has its ends the other way round.
        if let Some(&[low, high]) = gain
            && low * high > 0.0
        {
            let half = 0.5 * (high / low).ln().abs();
            (out.gain_factor, out.gain_source) = margin((THREE_SD * half).exp(), LEAST_GAIN_FACTOR);
        }
        let delay = [("time-delay.delay_s", 1.0), ("delay_ms", 1e-3)]
            .into_iter()
            .find_map(|(name, unit_s)| {
                let interval = model.intervals.get(name).filter(|i| usable(i))?;
                Some(interval.map(|end| end * unit_s))
            });
        if let Some([low, high]) = delay {
            let off = (0.5 * (low + high) - loop_delay_s).abs();
            (out.delay_s, out.delay_source) =
                margin(THREE_SD * 0.5 * (high - low) + off, LEAST_DELAY_S);
        }
        out
    }
}
