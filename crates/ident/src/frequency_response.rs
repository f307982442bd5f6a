//! Frequency response at known lines, with variances from period-to-period scatter and coherence.
//!
//! **Joint input-output method**: input and output are both projected on the excitation, whose frequencies and phases
//! are known. The response is the ratio of the two means. In closed loop the feedback carries noise into the input.
//! This noise does not correlate with the excitation, so it averages out of both projections, and the ratio has no bias
//! even at low coherence. The direct estimate (cross-spectrum over input spectrum) is offered by name, to show its
//! bias. Not for records without a periodic excitation: see [`crate::spectral`].

use nalgebra::Complex;

use crate::error::IdentError;
use crate::tone_fit::{ToneFit, Whitening, block_borders, fit_block};

/// One stretch of a record during which a fixed set of lines was driven.
#[derive(Debug, Clone, Copy)]
pub struct DrivenStretch<'a> {
    /// Input (commanded displacement, um), one value per row.
    pub input: &'a [f64],
    /// Output (bead position, um), `NaN` if a frame showed no bead.
    pub output: &'a [f64],
    /// First row to use (after the start-up transient).
    pub from: usize,
    /// One past the last row to use.
    pub to: usize,
    /// Time between rows, s.
    pub period_s: f64,
    /// Driven lines, Hz.
    pub lines_hz: &'a [f64],
    /// Further lines fitted along (harmonics, detection lines), Hz: reported, never part of the response.
    pub detection_hz: &'a [f64],
}

/// How the two projections become a response.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Estimator {
    /// Ratio of the mean projections on the excitation: unbiased in closed loop.
    #[default]
    Joint,
    /// Cross-spectrum over input spectrum: biased in closed loop at low coherence. For comparison.
    Direct,
}

/// Settings of [`measure`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settings {
    /// Sines plus drift.
    pub fit: ToneFit,
    /// Periods of the lowest line per block, at least.
    pub min_periods: f64,
    /// Blocks at most.
    pub most_blocks: usize,
    /// How the response is formed.
    pub estimator: Estimator,
    /// Blocks hold whole multiples of this time, s, instead of the lowest line's period. Needed if the excitation has
    /// more lines than are measured: they are orthogonal only over its own period.
    pub block_s: Option<f64>,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            fit: ToneFit::default(),
            min_periods: 1.0,
            most_blocks: 16,
            estimator: Estimator::Joint,
            block_s: None,
        }
    }
}

/// The response at one line.
#[derive(Debug, Clone, PartialEq)]
pub struct FrequencyPoint {
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// Output over input as the record shows it: hold, delay and exposure included.
    pub response: Complex<f64>,
    /// Variance of `response`, `E|error|^2` (real and imaginary part share it equally), from the scatter of blocks.
    pub scatter_variance: f64,
    /// Variance for the weights: from the noise model if one fits all lines, else from the scatter.
    pub variance: f64,
    /// Degrees of freedom of `variance` (infinite for a known noise level).
    pub variance_dof: f64,
    /// Coherence of the output with the excitation, 0 to 1.
    pub coherence: f64,
    /// Mean input phasor (peak amplitude, input unit).
    pub input: Complex<f64>,
    /// Mean output phasor (peak amplitude, output unit).
    pub output: Complex<f64>,
    /// Response of each block minus `response`, to first order: the pool of the bootstrap.
    pub block_errors: Vec<Complex<f64>>,
    /// Rows used.
    pub rows: usize,
    /// How much older the frames of this point were at their ticks than those of all points on average, s.
    pub later_s: f64,
    /// Mean square of the change of the output's velocity from row to row in the segment of this point, (output unit/s)^2.
    pub velocity_changes: f64,
    /// Variance of `response`, `E|error|^2`, for white increments of the output of variance 1 (levels, if they were fitted); 0: not known.
    pub spread: f64,
}

impl FrequencyPoint {
    /// The same point, its output times `factor`.
    pub(crate) fn scaled(&self, factor: Complex<f64>) -> Self {
        let power = factor.norm_sqr();
        Self {
            response: self.response * factor,
            output: self.output * factor,
            scatter_variance: self.scatter_variance * power,
            variance: self.variance * power,
            block_errors: self.block_errors.iter().map(|e| e * factor).collect(),
            spread: self.spread * power,
            ..self.clone()
        }
    }

    /// Gain, dB.
    pub fn gain_db(&self) -> f64 {
        20.0 * self.response.norm().log10()
    }

    /// Phase in (-180, 180] deg.
    pub fn phase_deg(&self) -> f64 {
        self.response.arg().to_degrees()
    }

    /// Standard deviation of the gain, dB.
    pub fn gain_sd_db(&self) -> f64 {
        20.0 / std::f64::consts::LN_10 * (0.5 * self.variance).sqrt() / self.response.norm()
    }

    /// Standard deviation of the phase, deg.
    pub fn phase_sd_deg(&self) -> f64 {
        ((0.5 * self.variance).sqrt() / self.response.norm()).to_degrees()
    }
}

/// Result at a detection line: output that no driven line causes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DetectionLine {
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// Output phasor (peak amplitude, output unit).
    pub output: Complex<f64>,
    /// Input phasor at the same line.
    pub input: Complex<f64>,
    /// Standard deviation of the output's amplitude from block scatter (root of `E|error|^2`).
    pub output_sd: f64,
    /// Probability that noise alone shows this much (Hotelling's test of a complex mean, for a finite number of
    /// blocks).
    pub p_value: f64,
}

/// The response at all lines of a segment, and the detection lines.
#[derive(Debug, Clone, PartialEq)]
pub struct SegmentResponse {
    /// One point per driven line.
    pub points: Vec<FrequencyPoint>,
    /// One entry per detection line.
    pub detection: Vec<DetectionLine>,
    /// Blocks used.
    pub blocks: usize,
    /// Mean residual variance of the output's block fits (of increments or levels, as fitted), output unit squared.
    pub output_residual_variance: f64,
}

/// Measures the response at the driven lines of one segment.
///
/// # Errors
/// [`IdentError::Lengths`], [`IdentError::TooShort`] (fewer than two usable blocks), [`IdentError::NoInput`].
pub fn measure(
    segment: &DrivenStretch<'_>,
    settings: &Settings,
) -> Result<SegmentResponse, IdentError> {
    if segment.input.len() != segment.output.len() {
        return Err(IdentError::Lengths {
            input: segment.input.len(),
            output: segment.output.len(),
        });
    }
    let all: Vec<f64> = segment
        .lines_hz
        .iter()
        .chain(segment.detection_hz)
        .copied()
        .collect();
    let lowest = all.iter().copied().fold(f64::INFINITY, f64::min);
    let columns = columns(&all, settings);
    let to = segment.to.min(segment.input.len());
    let rows = to.saturating_sub(segment.from);
    if rows < 2 * (columns + 4) || rows as f64 * segment.period_s * lowest < 2.0 {
        let periods = (2.0 / (lowest * segment.period_s)).ceil() as usize;
        return Err(IdentError::TooShort {
            what: "a frequency response",
            rows,
            needed: periods.max(2 * (columns + 4)),
        });
    }
    let borders = borders(segment, settings, &all);
    let mut inputs: Vec<Vec<Complex<f64>>> = Vec::new();
    let mut outputs: Vec<Vec<Complex<f64>>> = Vec::new();
    let (mut used, mut residual) = (0, 0.0);
    // On an integrating plant the increments of the output follow the levels of the input. Increments of both would add
    // the input's noise at the two ends of a block, multiplied by the large gain of a low line.
    let input_fit = match settings.fit.whitening {
        Whitening::Levels => settings.fit,
        Whitening::Increments => ToneFit {
            drift_degree: settings.fit.drift_degree.saturating_sub(1),
            whitening: Whitening::Levels,
        },
    };
    for w in borders.windows(2) {
        let fit = |signal, how| fit_block(signal, w[0], w[1], segment.period_s, &all, how);
        if let (Some(u), Some(y)) = (
            fit(segment.input, input_fit),
            fit(segment.output, settings.fit),
        ) {
            // Skip a block that lost half its frames: it would weigh as much as a full one.
            if 2 * y.rows > w[1] - w[0] {
                used += y.rows;
                residual += y.residual_variance;
                inputs.push(u.phasors);
                outputs.push(y.phasors);
            }
        }
    }
    let blocks = inputs.len();
    if blocks < 2 {
        return Err(IdentError::TooShort {
            what: "variances from at least two blocks",
            rows: used,
            needed: 2 * (columns + 4),
        });
    }
    let driven = segment.lines_hz.len();
    let column = |data: &[Vec<Complex<f64>>], i: usize| -> Vec<Complex<f64>> {
        data.iter().map(|b| b[i]).collect()
    };
    let points = (0..driven)
        .map(|i| {
            point(
                all[i],
                &column(&inputs, i),
                &column(&outputs, i),
                used,
                settings.estimator,
            )
        })
        .collect::<Result<Vec<_>, _>>()?;
    let detection = (driven..all.len())
        .map(|i| detection_line(all[i], &column(&inputs, i), &column(&outputs, i)))
        .collect();
    Ok(SegmentResponse {
        points,
        detection,
        blocks,
        output_residual_variance: residual / blocks as f64,
    })
}

fn columns(all_hz: &[f64], settings: &Settings) -> usize {
    2 * all_hz.len() + settings.fit.drift_degree + 1
}

/// Borders of the blocks of a segment whose lines are `all_hz`.
fn borders(segment: &DrivenStretch<'_>, settings: &Settings, all_hz: &[f64]) -> Vec<usize> {
    let lowest = all_hz.iter().copied().fold(f64::INFINITY, f64::min);
    let to = segment.to.min(segment.input.len());
    let rows = to.saturating_sub(segment.from);
    // Blocks long enough for the regressors, so that a multisine is cut into fewer blocks.
    let most = (settings.most_blocks).min(rows / (2 * columns(all_hz, settings)));
    block_borders(
        segment.from,
        to,
        segment.period_s,
        settings.block_s.map_or(lowest, |block_s| 1.0 / block_s),
        settings.min_periods,
        most.max(2),
    )
}

/// Measures `points`, the driven lines of `segment`, by its `rest`: the output less the response of a plant to the input. Each response is
/// that of the plant, `of_plant` at a frequency, and the part that the rest adds; its scatter is the rest's.
///
/// A motion that a block's input began before the block, or leaves to the next, is then neither scatter nor bias. An input that answers
/// the output does not bias it either where rows are missing from the output.
pub(crate) fn measure_by_rest(
    points: &mut [FrequencyPoint],
    segment: &DrivenStretch<'_>,
    settings: &Settings,
    rest: &[f64],
    of_plant: impl Fn(f64) -> Complex<f64>,
) {
    let all: Vec<f64> = [segment.lines_hz, segment.detection_hz].concat();
    let of_block = |w: &[usize]| {
        let block = fit_block(rest, w[0], w[1], segment.period_s, &all, settings.fit)?;
        (2 * block.rows > w[1] - w[0]).then_some(block)
    };
    let borders = borders(segment, settings, &all);
    let blocks: Vec<_> = borders.windows(2).filter_map(of_block).collect();
    let count = blocks.len() as f64;
    if count < 2.0 {
        return;
    }
    for (i, point) in points.iter_mut().enumerate() {
        let own: Vec<Complex<f64>> = blocks.iter().map(|block| block.phasors[i]).collect();
        let common = mean(&own);
        point.response = of_plant(point.frequency_hz) + common / point.input;
        point.output = point.response * point.input;
        point.block_errors = own.iter().map(|e| (e - common) / point.input).collect();
        let sum: f64 = point.block_errors.iter().map(|e| e.norm_sqr()).sum();
        point.scatter_variance = sum / (count * (count - 1.0));
        point.variance = point.scatter_variance;
        let freedom: f64 = blocks.iter().map(|block| block.freedom[i]).sum();
        point.variance_dof = freedom * (count - 1.0) / count;
        let spread: f64 = blocks.iter().map(|block| block.spread[i]).sum();
        point.spread = spread / (count * count * point.input.norm_sqr());
    }
}

fn mean(values: &[Complex<f64>]) -> Complex<f64> {
    values.iter().sum::<Complex<f64>>() / values.len() as f64
}

fn point(
    frequency_hz: f64,
    inputs: &[Complex<f64>],
    outputs: &[Complex<f64>],
    rows: usize,
    estimator: Estimator,
) -> Result<FrequencyPoint, IdentError> {
    let blocks = inputs.len() as f64;
    let (input, output) = (mean(inputs), mean(outputs));
    let largest = inputs.iter().map(|u| u.norm()).fold(0.0, f64::max);
    if input.norm() < 1e-12 || input.norm() < 1e-9 * largest {
        return Err(IdentError::NoInput {
            frequency_hz,
            amplitude: input.norm(),
        });
    }
    let response = match estimator {
        Estimator::Joint => output / input,
        Estimator::Direct => {
            let cross: Complex<f64> = outputs.iter().zip(inputs).map(|(y, u)| y * u.conj()).sum();
            cross / inputs.iter().map(|u| u.norm_sqr()).sum::<f64>()
        }
    };
    let block_errors: Vec<Complex<f64>> = inputs
        .iter()
        .zip(outputs)
        .map(|(u, y)| (y - response * u) / input)
        .collect();
    let scatter =
        block_errors.iter().map(|e| e.norm_sqr()).sum::<f64>() / (blocks * (blocks - 1.0));
    let power = outputs.iter().map(|y| y.norm_sqr()).sum::<f64>() / blocks;
    Ok(FrequencyPoint {
        frequency_hz,
        response,
        scatter_variance: scatter,
        variance: scatter,
        variance_dof: 2.0 * (blocks - 1.0),
        coherence: if power > 0.0 {
            output.norm_sqr() / power
        } else {
            0.0
        },
        input,
        output,
        block_errors,
        rows,
        later_s: 0.0,
        velocity_changes: 0.0,
        spread: 0.0,
    })
}

fn detection_line(
    frequency_hz: f64,
    inputs: &[Complex<f64>],
    outputs: &[Complex<f64>],
) -> DetectionLine {
    let blocks = outputs.len() as f64;
    let output = mean(outputs);
    let variance =
        outputs.iter().map(|y| (y - output).norm_sqr()).sum::<f64>() / (blocks * (blocks - 1.0));
    let dof = 2.0 * (blocks - 1.0);
    let p_value = if variance > 0.0 {
        cellpos_numeric::statistics::f_exceeds(output.norm_sqr() / variance, 2.0, dof)
    } else {
        0.0
    };
    DetectionLine {
        frequency_hz,
        output,
        input: mean(inputs),
        output_sd: variance.sqrt(),
        p_value,
    }
}
