//! The noise that a stretch of a record shows: variance and correlation of increments.

use crate::data::cleaned::{increment_moments, without_jumps, without_lines};
use crate::data::coloured::Alone;
use crate::data::no_response::without_response;
use crate::data::noise::NoiseModel;
use crate::thresholds::THRESHOLDS;
use serde::Serialize;

/// Where the noise floor comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum FloorSource {
    /// Records whose command rests.
    Rest,
    /// Differences of successive periods of a command that repeats.
    Periods,
    /// Differences of records with the same command.
    EqualRecords,
    /// The noise that the model states.
    Stated,
    /// Nowhere: nothing rests or repeats, and nothing is stated. The figures are then the fit's own residual.
    Unknown,
}

impl FloorSource {
    /// In words, for results.
    pub fn words(self) -> &'static str {
        match self {
            Self::Rest => "measured at rest",
            Self::Periods => "measured between periods of the command",
            Self::EqualRecords => "measured between records of the same command",
            Self::Stated => {
                "stated in the model: no record has a rest of the command or repeats it for long enough"
            }
            Self::Unknown => {
                "not known: no rest of the command, no repeated command, no stated noise"
            }
        }
    }

    /// Whether there is a floor at all.
    pub fn is_known(self) -> bool {
        self != Self::Unknown
    }
}

/// Variance and lag-1 covariance of increments, how many, and where from.
#[derive(Debug, Clone)]
pub(super) struct Estimate {
    pub(super) c0: f64,
    pub(super) c1: f64,
    pub(super) rows: usize,
    /// The independent share of these.
    pub(super) independent: f64,
    pub(super) source: FloorSource,
    /// The noise itself, lines and jumps off, and which rows count.
    pub(super) alone: (Vec<f64>, Vec<bool>),
    pub(super) share: f64,
}

impl Estimate {
    pub(super) fn alone(&self) -> Alone<'_> {
        Alone {
            values: &self.alone.0,
            counts: &self.alone.1,
            share: self.share,
        }
    }

    /// Whether it has rows enough.
    pub(super) fn counts(&self) -> bool {
        self.rows >= THRESHOLDS.floor_rows && self.c0 > 0.0
    }

    /// Independent increments.
    pub(super) fn independent(&self) -> usize {
        (self.independent * self.rows as f64) as usize
    }

    /// The same without what follows the command linearly, in residuals that contain noise `share` times that of one record. `None` of
    /// what is too short for a regression.
    pub(super) fn without_response(
        &self,
        (command_um, e, ok): (&[f64], &[f64], &[bool]),
        sample_s: f64,
        share: f64,
    ) -> Option<Self> {
        const ROUNDS: usize = 10;
        const SETTLED: f64 = 2e-3;
        // Noise and response settle together. The change from round to round
        // shrinks slowly, so a secant goes to the correlation that would not change.
        let mut correlation = self.c1 / self.c0.max(f64::MIN_POSITIVE);
        let mut before: Option<(f64, f64)> = None;
        let mut known = None;
        for _ in 0..ROUNDS {
            let noise = NoiseModel::from_increments(self.c0, correlation * self.c0);
            let (clean, fitted) = without_response(command_um, e, ok, &noise)?;
            let rows = self.rows as f64;
            let share = share * rows / (rows - fitted as f64).max(1.0);
            let own = of(&clean, ok, sample_s, self.source, share);
            let step = own.c1 / own.c0.max(f64::MIN_POSITIVE) - correlation;
            known = Some(own);
            let next = match before {
                Some((last, step_then)) if step != step_then => {
                    correlation - step * (correlation - last) / (step - step_then)
                }
                _ => correlation + step,
            };
            if step.abs() < SETTLED || !next.is_finite() {
                break;
            }
            before = Some((correlation, step));
            correlation = next.clamp(NoiseModel::LEAST_CORRELATION, NoiseModel::MOST_CORRELATION);
        }
        known
    }

    pub(super) fn sigma(&self) -> f64 {
        NoiseModel::from_increments(self.c0, self.c1).innovation_um()
    }

    /// The upper limit of the standard deviation after this number of increments.
    pub(super) fn most(&self) -> f64 {
        self.sigma() * (1.0 + error_of(self.independent()))
    }
}

/// Relative error of a noise's standard deviation from this number of increments: three standard deviations, because one of
/// several estimates is small by chance. A noise that was not measured is taken as stated.
pub(crate) fn error_of(rows: usize) -> f64 {
    match rows {
        0 => 0.0,
        rows => 3.0 / (2.0 * rows as f64).sqrt(),
    }
}

/// Independent squares in the sum over this number of successive differences, as a share of the number. Neighbours share a noise:
/// their correlation is -1/2, that of their squares 1/4, and the sum of `m` squares scatters as that of `m^2/(m + (m - 1)/2)`
/// independent ones.
pub(super) fn independent(differences: f64) -> f64 {
    let m = differences.max(1.0);
    m / (m + 0.5 * (m - 1.0))
}

/// An estimate from residuals or differences that contain noise alone, `share` times that of one record.
pub(super) fn of(
    e: &[f64],
    ok: &[bool],
    sample_s: f64,
    source: FloorSource,
    share: f64,
) -> Estimate {
    let (clean, fitted) = without_lines(e, ok, sample_s);
    let counts = without_jumps(&clean, ok);
    let (c0, c1, rows) = increment_moments(&clean, &counts);
    // Numbers that were fitted, the mean among them, took their share of the squares.
    let fitted = (1 + fitted).min(rows / 2) as f64;
    let share = share * rows as f64 / (rows as f64 - fitted).max(1.0);
    Estimate {
        c0: share * c0,
        c1: share * c1,
        rows,
        independent: 1.0,
        source,
        alone: (clean, counts),
        share,
    }
}

/// Differences of two stretches with the same command.
pub(super) struct Differences<'a> {
    /// Of the commands, which a loop makes from the noise of each.
    pub(super) command_um: &'a [f64],
    pub(super) of: &'a [f64],
    pub(super) ok: &'a [bool],
}

impl Differences<'_> {
    /// The noise of one of the two. A bead that walks is held in closed loop, and its estimate leaves out
    /// the linear response to the difference of the commands.
    pub(super) fn noise(&self, sample_s: f64, source: FloorSource, walks: bool) -> Estimate {
        const OF_TWO: f64 = 0.5;
        let raw = of(self.of, self.ok, sample_s, source, OF_TWO);
        let rows = (self.command_um, self.of, self.ok);
        let answers = self.command_um.iter().any(|u| *u != 0.0);
        match walks && answers {
            true => (raw.without_response(rows, sample_s, OF_TWO)).unwrap_or(raw),
            false => raw,
        }
    }
}

/// The increments of residuals as they are.
pub(super) fn of_increments(e: &[f64], present: &[bool]) -> Estimate {
    let (c0, c1, rows) = increment_moments(e, present);
    Estimate {
        c0,
        c1,
        rows,
        independent: 1.0,
        source: FloorSource::Unknown,
        alone: (e.to_vec(), present.to_vec()),
        share: 1.0,
    }
}

/// Those that differ from the least by chance together.
pub(super) fn pooled(of: &[Estimate], least: &Estimate) -> Estimate {
    let by_chance = |f: &&Estimate| {
        let error = error_of(f.independent()).hypot(error_of(least.independent()));
        (f.sigma() / least.sigma() - 1.0).abs() <= error
    };
    let near: Vec<&Estimate> = of.iter().filter(by_chance).collect();
    let n: f64 = near
        .iter()
        .map(|f| f.independent() as f64)
        .sum::<f64>()
        .max(1.0);
    let mean = |get: fn(&Estimate) -> f64| {
        near.iter()
            .map(|f| get(f) * f.independent() as f64)
            .sum::<f64>()
            / n
    };
    Estimate {
        c0: mean(|f| f.c0),
        c1: mean(|f| f.c1),
        rows: n as usize,
        independent: 1.0,
        source: FloorSource::Unknown,
        alone: Default::default(),
        share: 1.0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::TAU;

    /// A loop that answers the noise of a bead that walks. The bead follows 20 % less and a row later than the model says.
    #[test]
    fn periods_of_a_loop_tell_the_noise_and_not_the_answers_to_it() {
        const PERIOD: usize = 100;
        let mut random = cellpos_numeric::Random::new(11);
        let (mut bead, mut model) = (0.0, 0.0);
        let (mut command, mut residual) = (vec![0.0; 2], vec![0.0; 2]);
        for k in 2..9000 {
            bead += 0.8 * 0.3 * command[k - 2] + random.normal();
            model += 0.3 * command[k - 1];
            let sine = 20.0 * (TAU * k as f64 / PERIOD as f64).sin();
            command.push(1.5 * (sine - bead) + 0.5 * random.normal());
            residual.push(bead - model);
        }
        let apart =
            |x: &[f64]| -> Vec<f64> { (PERIOD..x.len()).map(|k| x[k] - x[k - PERIOD]).collect() };
        let (command, of) = (apart(&command), apart(&residual));
        let ok = vec![true; of.len()];
        let told = Differences {
            command_um: &command,
            of: &of,
            ok: &ok,
        };
        let correlation = |e: &Estimate| e.c1 / e.c0;
        let raw = told.noise(1e-3, FloorSource::Periods, false);
        let own = told.noise(1e-3, FloorSource::Periods, true);
        assert!(correlation(&raw).abs() > 0.1, "{}", correlation(&raw));
        assert!(correlation(&own).abs() < 0.05, "{}", correlation(&own));
        assert!((own.c0 - 1.0).abs() < 0.05, "{}", own.c0);
    }
}
