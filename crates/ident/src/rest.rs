//! What a record holds besides the response to its input: the output less that of a fitted plant, and the power of its increments by
//! frequency.
//!
//! A plant with lags carries what a stretch's input began into the next. The ratio of the two spectra of a stretch shows that as noise, the
//! more the longer the lags are; the rest does not. Not for effects that are not linear: what is left of them at the driven lines and their
//! harmonics is taken off, the remainder is in the rest.

use cellpos_numeric::fft;

use crate::candidate_model::CandidateModel;
use crate::error::IdentError;
use crate::frequency_response::{DrivenStretch, FrequencyPoint};
use crate::noise::{Scatter, shares};
use crate::order_selection::OrderSelection;
use crate::sampled::Sampling;
use crate::tone_fit::{ToneFit, fit_block};
use nalgebra::Complex;
use std::f64::consts::TAU;

/// Points whose frames were older or younger than on average, as frames of the average age would have shown them.
///
/// A longer delay is more than a phase shift: images of the held command that fold onto a line turn by another angle. A fit to the points
/// with the phase shift alone describes the plant well enough for that part.
pub(crate) fn of_one_delay(
    points: Vec<FrequencyPoint>,
    sampling: Sampling,
    two_lags: bool,
) -> Result<Vec<FrequencyPoint>, IdentError> {
    if points.iter().all(|p| p.later_s == 0.0) {
        return Ok(points);
    }
    let model = plant_of(&points, sampling, two_lags)?;
    let shown = |p: &FrequencyPoint, later_s: f64| {
        later(&model, later_s).sampled_response(p.frequency_hz, sampling)
    };
    let all = points.iter();
    Ok(all
        .map(|p| p.scaled(shown(p, 0.0) / shown(p, p.later_s)))
        .collect())
}

/// The plant that fits the points best, their ages taken for phases.
pub(crate) fn plant_of(
    points: &[FrequencyPoint],
    sampling: Sampling,
    two_lags: bool,
) -> Result<CandidateModel, IdentError> {
    let turned = points.iter().map(|p| {
        let angle = TAU * p.frequency_hz * p.later_s;
        p.scaled(Complex::from_polar(1.0, angle))
    });
    let turned: Vec<FrequencyPoint> = turned.collect();
    let problem = OrderSelection::new(&turned, sampling, None)?.with_two_lags(two_lags);
    Ok(problem.fit()?.best().model)
}

/// A plant whose frames are older.
pub(crate) fn later(model: &CandidateModel, later_s: f64) -> CandidateModel {
    let delay_s = model.delay_s + later_s;
    CandidateModel { delay_s, ..*model }
}

/// The rest of a segment.
pub(crate) struct Rest {
    /// Output less the plant's, um; `NaN` in a row without an output.
    pub(crate) rows: Vec<f64>,
    /// Mean square of the change of the plant's velocity from row to row, (um/s)^2.
    pub(crate) velocity_changes: f64,
}

impl Rest {
    /// Of a segment whose frames were `later_s` older than on average.
    pub(crate) fn of(
        segment: &DrivenStretch<'_>,
        model: &CandidateModel,
        later_s: f64,
        sampling: Sampling,
    ) -> Self {
        let shown = later(model, later_s)
            .sampler(sampling)
            .record(segment.input);
        let changes = shown[segment.from..].windows(3);
        let count = changes.len().max(1) as f64;
        let change = |w: &[f64]| ((w[2] - 2.0 * w[1] + w[0]) / segment.period_s).powi(2);
        let velocity_changes = changes.map(change).sum::<f64>() / count;
        let rows = segment.output.iter().zip(&shown).map(|(y, x)| y - x);
        Self {
            rows: rows.collect(),
            velocity_changes,
        }
    }

    /// Power of the increments in octaves from `lowest_hz` on, without the lines of `segment`.
    pub(crate) fn octaves(&self, segment: &DrivenStretch<'_>, lowest_hz: f64) -> Vec<Scatter> {
        let (from, period_s) = (segment.from, segment.period_s);
        let all: Vec<f64> = [segment.lines_hz, segment.detection_hz].concat();
        let fit = ToneFit::default();
        let Some(fitted) = fit_block(&self.rows, from, self.rows.len(), period_s, &all, fit) else {
            return Vec::new();
        };
        let level = |k: usize| -> f64 {
            let tones = all.iter().zip(&fitted.phasors);
            tones
                .map(|(hz, p)| (p * Complex::from_polar(1.0, TAU * hz * k as f64 * period_s)).re)
                .sum()
        };
        let (middle, half) = (
            0.5 * (from + self.rows.len()) as f64,
            0.5 * (self.rows.len() - from) as f64,
        );
        let mut increments: Vec<f64> = (from + 1..self.rows.len())
            .map(|k| {
                let drift = fitted.drift.iter().rev();
                let drift = drift.fold(0.0, |sum, c| sum * (k as f64 - middle) / half + c);
                self.rows[k] - self.rows[k - 1] - (level(k) - level(k - 1)) - drift
            })
            .collect();
        let weights: Vec<f64> = (increments.iter().enumerate())
            .map(|(k, um)| match um.is_finite() {
                true => taper(k, increments.len()),
                false => 0.0,
            })
            .collect();
        for (um, weight) in increments.iter_mut().zip(&weights) {
            *um = if um.is_finite() { *um * weight } else { 0.0 };
        }
        let shown: f64 = weights.iter().map(|w| w * w).sum();
        let pairs: f64 = weights.windows(2).map(|w| w[0] * w[1]).sum();
        let fourth: f64 = weights.iter().map(|w| w.powi(4)).sum();
        let rows = increments.len() as f64;
        let spectrum = fft::forward(&mut increments);
        let bin_hz = 1.0 / (rows * period_s);
        let mut octaves: Vec<(usize, Scatter)> = Vec::new();
        for (bin, value) in spectrum.iter().enumerate().skip(3) {
            let hz = bin as f64 * bin_hz;
            let driven = |line: &f64| (hz - line).abs() < 2.5 * bin_hz;
            if hz < lowest_hz || 2.0 * (hz + bin_hz) * period_s > 1.0 || all.iter().any(driven) {
                continue;
            }
            let octave = (hz / lowest_hz).log2() as usize;
            if octaves.last().is_none_or(|(last, _)| *last != octave) {
                octaves.push((octave, Scatter::NONE));
            }
            // Localisation noise of a row without a neighbour cancels with nothing.
            let mut shares = shares(hz, period_s, self.velocity_changes);
            shares[1] = 2.0 + (shares[1] - 2.0) * pairs / shown;
            let of_bin = Scatter {
                um2: (value.re * value.re + value.im * value.im) / shown,
                shares,
                dof: 2.0 * shown * shown / (rows * fourth),
            };
            if let Some((_, sum)) = octaves.last_mut() {
                sum.join(&of_bin);
            }
        }
        octaves.into_iter().map(|(_, scatter)| scatter).collect()
    }
}

/// A cosine over a tenth of the rows at each end: of a flow that wanders, ends that do not meet would show at every frequency.
fn taper(row: usize, rows: usize) -> f64 {
    let from_end = row.min(rows - 1 - row) as f64 + 0.5;
    let part = (from_end / (0.1 * rows as f64)).min(1.0);
    0.5 - 0.5 * (std::f64::consts::PI * part).cos()
}
