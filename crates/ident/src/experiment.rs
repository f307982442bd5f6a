//! An identification experiment: a plan of excitation segments, run tick by tick on anything that moves a bead.
//!
//! The plan is data, the rig is a [`Bench`]. If the bead is lost, the run ends, keeps the finished segments, and can resume at the one
//! that failed. Not for real-time pacing: a bench does that.

use nalgebra::Complex;

use crate::error::IdentError;
use crate::excitation::{ExcitationLimits, Signal, Tone, fold, shaped_amplitude_um};
use crate::frequency_response::{
    DrivenStretch, FrequencyPoint, SegmentResponse, Settings, measure, measure_by_rest,
};
use crate::noise::apply_noise_model;
use crate::rest::{Rest, later, plant_of};
use crate::sampled::Sampling;
pub use crate::segments::{
    Cause, Measured, RecordedSegment, Schedule, Span, Stopped, common_age_s,
};
use cellpos_numeric::Random;
use serde::{Deserialize, Serialize};

/// One tick of a record.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Row {
    /// Displacement commanded from this tick on, um.
    pub command_um: f64,
    /// The bead position that the tick saw, um; `None` if no frame showed a bead.
    pub bead_um: Option<f64>,
}

/// A rig, real or emulated, that adds an excitation to the command that holds the bead.
pub trait Bench {
    /// Errors of the rig itself.
    type Error;
    /// Runs one tick with `excitation_um` added to the command (closed loop) or about the working point (open loop).
    ///
    /// # Errors
    /// The rig's own: a lost camera, a board that does not answer.
    fn tick(&mut self, excitation_um: f64) -> Result<Row, Self::Error>;
}

/// One stretch of an experiment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PlannedSegment {
    /// Its name, for reports.
    pub label: String,
    /// What to add to the command.
    pub signal: Signal,
    /// Lines driven, Hz.
    pub lines_hz: Vec<f64>,
    /// Lines fitted along to detect nonlinearity, Hz.
    pub detection_hz: Vec<f64>,
    /// Time for transients to decay, s; recorded, not evaluated.
    pub settle_s: f64,
    /// Time used, s.
    pub measure_s: f64,
}

/// Time over which a segment's excitation fades out, s.
const RELEASE_S: f64 = 0.2;

/// A list of segments at one sampling period.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Plan {
    /// Time between ticks, s.
    pub period_s: f64,
    /// Segments in order.
    pub segments: Vec<PlannedSegment>,
    /// Rows in a row without a position of a held bead that spoil a segment; without a rig file they end the run.
    pub lost_frames: usize,
}

/// A segment to run, and its amplitude.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Turn {
    /// Index of the segment in the plan.
    pub index: usize,
    /// Amplitude relative to the planned one.
    pub part: f64,
}

impl Turn {
    /// A segment as it is planned.
    pub fn planned(index: usize) -> Self {
        Self { index, part: 1.0 }
    }
}

/// The expected plant and loop that amplitudes are shaped by, at one frequency: `X2/X1`, and plant times controller
/// (0 in open loop).
pub type Expected<'a> = &'a dyn Fn(f64) -> (Complex<f64>, Complex<f64>);

impl Plan {
    /// Stepped sines, one segment per line, lowest first. Low lines last longer, because Brownian motion makes the noise of a line fall
    /// as 1/f.
    pub fn stepped_sines(
        lines_hz: &[f64],
        expected: Expected<'_>,
        limits: ExcitationLimits,
        period_s: f64,
        seconds_at_1_hz: f64,
    ) -> Self {
        let segments = lines_hz
            .iter()
            .map(|&f| {
                let (plant, loop_gain) = expected(f);
                let amplitude_um = shaped_amplitude_um(f, plant, loop_gain, limits);
                let whole = |s: f64| ((s * f).round() / f).max(1.0 / f);
                let settle_s = 0.4;
                PlannedSegment {
                    label: format!("{f} Hz"),
                    signal: Signal::Tones {
                        tones: vec![Tone {
                            frequency_hz: f,
                            amplitude_um,
                            phase_rad: 0.0,
                        }],
                        fade_in_s: 0.2,
                    },
                    lines_hz: vec![f],
                    detection_hz: harmonics_to_watch(f, 1.0 / period_s),
                    settle_s,
                    measure_s: whole((seconds_at_1_hz / f).clamp(2.0, 15.0)),
                }
            })
            .collect();
        Self {
            period_s,
            segments,
            lost_frames: 50,
        }
    }

    /// All lines at once with random phases, after a settling time. Each line gets the share of the bead's and the PZT's amplitude that
    /// keeps the expected peak (three times the RMS) within `limits`. Lines are moved to odd multiples of 0.5 Hz, so that even
    /// nonlinearity falls between them. The even neighbours of every third line serve as detection lines.
    pub fn multisine(
        lines_hz: &[f64],
        expected: Expected<'_>,
        limits: ExcitationLimits,
        period_s: f64,
        seconds_at_1_hz: f64,
        seed: u64,
    ) -> Self {
        let grid = 0.5;
        let mut odd: Vec<f64> = lines_hz
            .iter()
            .map(|f| (2.0 * ((f / grid - 1.0) / 2.0).round().max(0.0) + 1.0) * grid)
            .collect();
        odd.sort_by(f64::total_cmp);
        odd.dedup();
        let peak = 3.0 * (0.5 * odd.len() as f64).sqrt();
        let share = ExcitationLimits {
            bead_um: limits.bead_um / peak,
            bead_um_per_s: limits.bead_um_per_s / peak,
            pzt_um: limits.pzt_um / peak,
            slew_um_per_s: limits.slew_um_per_s / peak,
        };
        let mut random = Random::new(seed);
        let tones = odd
            .iter()
            .map(|&f| {
                let (plant, loop_gain) = expected(f);
                Tone {
                    frequency_hz: f,
                    amplitude_um: shaped_amplitude_um(f, plant, loop_gain, share),
                    phase_rad: 2.0 * std::f64::consts::PI * random.uniform(),
                }
            })
            .collect();
        let detection_hz = odd.iter().step_by(3).map(|f| f + grid).collect();
        let segment = PlannedSegment {
            label: format!("multisine, {} lines", odd.len()),
            signal: Signal::Tones {
                tones,
                fade_in_s: 0.2,
            },
            lines_hz: odd,
            detection_hz,
            settle_s: 0.5,
            measure_s: (2.0 * seconds_at_1_hz).clamp(4.0, 600.0),
        };
        Self {
            period_s,
            segments: vec![segment],
            lost_frames: 50,
        }
    }

    /// A logarithmic sweep from the lowest line to the highest, repeated every four seconds. It is measured at the lines, moved to
    /// multiples of 0.25 Hz, where it is periodic. It has one amplitude: the largest that keeps the expected bead and PZT within `limits`
    /// at every frequency. Low lines therefore get less than from a stepped sine.
    pub fn log_sweep(
        lines_hz: &[f64],
        expected: Expected<'_>,
        limits: ExcitationLimits,
        period_s: f64,
        seconds_at_1_hz: f64,
    ) -> Self {
        const SWEEP_S: f64 = 4.0;
        let mut lines: Vec<f64> = lines_hz
            .iter()
            .map(|f| (f * SWEEP_S).round().max(1.0) / SWEEP_S)
            .collect();
        lines.sort_by(f64::total_cmp);
        lines.dedup();
        let lowest = lines.first().copied().unwrap_or(1.0);
        let highest = lines.last().copied().unwrap_or(lowest);
        // The sweep extends a quarter of an octave beyond the outer lines, to pass them at full amplitude.
        let nyquist_hz = 0.5 / period_s;
        let (from_hz, to_hz) = (0.84 * lowest, (1.19 * highest).min(0.96 * nyquist_hz));
        let amplitude_um = (0..=60)
            .map(|i| from_hz * (to_hz / from_hz).powf(f64::from(i) / 60.0))
            .map(|f| {
                let (plant, loop_gain) = expected(f);
                shaped_amplitude_um(f, plant, loop_gain, limits)
            })
            .fold(f64::INFINITY, f64::min);
        let rounds = (2.0 * seconds_at_1_hz / SWEEP_S).round().clamp(4.0, 16.0);
        let segment = PlannedSegment {
            label: format!("sweep {lowest} to {highest} Hz, {rounds} times"),
            signal: Signal::Repeated {
                signal: Box::new(Signal::LogSweep {
                    from_hz,
                    to_hz,
                    duration_s: SWEEP_S,
                    amplitude_um,
                    flat_from_hz: from_hz,
                }),
                period_s: SWEEP_S,
                fade_s: 0.1,
            },
            lines_hz: lines,
            detection_hz: Vec::new(),
            settle_s: SWEEP_S,
            measure_s: rounds * SWEEP_S,
        };
        Self {
            period_s,
            segments: vec![segment],
            lost_frames: 50,
        }
    }

    /// The excitation of the segments `todo` as one table, for a rig that does not stop between them. Each segment settles, is measured
    /// and fades out as in [`Plan::run`], at the requested part of its planned amplitude.
    pub fn schedule(&self, todo: &[Turn]) -> Schedule {
        let mut schedule = Schedule {
            excitation_um: Vec::new(),
            spans: Vec::new(),
        };
        for &Turn { index, part } in todo {
            let Some(segment) = self.segments.get(index) else {
                continue;
            };
            let settle = rows(segment.settle_s, self.period_s);
            let total = settle + rows(segment.measure_s, self.period_s);
            schedule.spans.push(Span {
                index,
                start: schedule.excitation_um.len(),
                settle,
                rows: total,
            });
            let release = rows(RELEASE_S, self.period_s);
            let value = |k: usize| part * segment.signal.value_um(k as f64 * self.period_s);
            schedule.excitation_um.extend((0..total).map(value));
            schedule
                .excitation_um
                .extend((0..release).map(|k| fade_out(k, release) * value(total + k)));
        }
        schedule
    }

    /// Ticks in all.
    pub fn ticks(&self) -> usize {
        self.segments
            .iter()
            .map(|s| {
                rows(s.settle_s, self.period_s)
                    + rows(s.measure_s, self.period_s)
                    + rows(RELEASE_S, self.period_s)
            })
            .sum()
    }

    /// Runs the segments from index `first` on; calls `progress` with the ticks done so far.
    ///
    /// # Errors
    /// [`Stopped`] with the finished segments and the cause.
    pub fn run<B: Bench>(
        &self,
        bench: &mut B,
        first: usize,
        mut progress: impl FnMut(usize),
    ) -> Result<Vec<RecordedSegment>, Stopped<B::Error>> {
        let mut done = Vec::new();
        let mut ticks = 0;
        for (index, segment) in self.segments.iter().enumerate().skip(first) {
            let settle = rows(segment.settle_s, self.period_s);
            let total = settle + rows(segment.measure_s, self.period_s);
            let mut record = RecordedSegment {
                index,
                from: settle,
                age_s: None,
                input: Vec::with_capacity(total),
                output: Vec::with_capacity(total),
            };
            let mut missing = 0usize;
            for k in 0..total {
                let row = match bench.tick(segment.signal.value_um(k as f64 * self.period_s)) {
                    Ok(row) => row,
                    Err(error) => {
                        return Err(Stopped {
                            done,
                            cause: Cause::Rig(error),
                        });
                    }
                };
                record.input.push(row.command_um);
                record.output.push(row.bead_um.unwrap_or(f64::NAN));
                missing = if row.bead_um.is_some() {
                    0
                } else {
                    missing + 1
                };
                if missing >= self.lost_frames {
                    let error = IdentError::BeadLost {
                        segment: index,
                        segments: self.segments.len(),
                        frames: missing,
                    };
                    return Err(Stopped {
                        done,
                        cause: Cause::BeadLost(error),
                    });
                }
                ticks += 1;
                if ticks % 256 == 0 {
                    progress(ticks);
                }
            }
            // Fade out: in closed loop the excitation balances the controller's share; dropping it at once would throw the bead out of
            // view.
            let release = rows(RELEASE_S, self.period_s);
            for k in 0..release {
                let excitation_um = fade_out(k, release)
                    * segment.signal.value_um((total + k) as f64 * self.period_s);
                if let Err(error) = bench.tick(excitation_um) {
                    return Err(Stopped {
                        done,
                        cause: Cause::Rig(error),
                    });
                }
                ticks += 1;
            }
            done.push(record);
        }
        Ok(done)
    }

    /// The driven stretch of a record, and the settings of its blocks; `None`: nothing was driven.
    fn driven<'a>(
        &'a self,
        record: &'a RecordedSegment,
        settings: &Settings,
    ) -> Option<(DrivenStretch<'a>, Settings)> {
        let planned = &self.segments[record.index];
        let segment = DrivenStretch {
            input: &record.input,
            output: &record.output,
            from: record.from,
            to: record.input.len(),
            period_s: self.period_s,
            lines_hz: &planned.lines_hz,
            detection_hz: &planned.detection_hz,
        };
        let settings = Settings {
            block_s: planned.signal.repeats_s(),
            ..*settings
        };
        (!planned.lines_hz.is_empty()).then_some((segment, settings))
    }

    /// Measures the response at every driven line of the recorded segments, weighted by the scatter of each line. Each point records
    /// how much older its frames were than [`common_age_s`]: a free-running camera clock drifts through the loop's grid in a minute, so
    /// the age differs between segments.
    ///
    /// # Errors
    /// Those of [`measure`].
    pub fn analyse(
        &self,
        records: &[RecordedSegment],
        settings: &Settings,
    ) -> Result<Measured, IdentError> {
        let mut segments = Vec::new();
        let common_s = common_age_s(records);
        for record in records {
            let Some((segment, settings)) = self.driven(record, settings) else {
                continue;
            };
            let mut response = measure(&segment, &settings)?;
            if let (Some(age_s), Some(common_s)) = (record.age_s, common_s) {
                for point in &mut response.points {
                    point.later_s = age_s - common_s;
                }
            }
            segments.push(response);
        }
        Ok(Measured {
            points: by_frequency(&segments),
            noise: None,
            segments,
        })
    }

    /// The same, with the noise of the record: what is left of it when a plant that fits the lines has taken off its response to the
    /// command. It weights the points, if it describes the scatter of the lines. `two_lags`: as for [`crate::summary::summarise`].
    ///
    /// # Errors
    /// Those of [`measure`].
    pub fn analyse_with_noise(
        &self,
        records: &[RecordedSegment],
        settings: &Settings,
        sampling: Sampling,
        two_lags: bool,
    ) -> Result<Measured, IdentError> {
        let mut measured = self.analyse(records, settings)?;
        let Ok(model) = plant_of(&measured.points, sampling, two_lags) else {
            // Too few lines for a plant: each is weighted by its own scatter.
            return Ok(measured);
        };
        let lines_hz = measured.points.iter().map(|p| p.frequency_hz);
        let lowest_hz = lines_hz.fold(f64::INFINITY, f64::min);
        let mut octaves = Vec::new();
        let driven = records.iter().filter_map(|r| self.driven(r, settings));
        for ((segment, settings), response) in driven.zip(&mut measured.segments) {
            let later_s = response.points.first().map_or(0.0, |p| p.later_s);
            let rest = Rest::of(&segment, &model, later_s, sampling);
            let of_plant = |hz| later(&model, later_s).sampled_response(hz, sampling);
            measure_by_rest(
                &mut response.points,
                &segment,
                &settings,
                &rest.rows,
                of_plant,
            );
            for point in &mut response.points {
                point.velocity_changes = rest.velocity_changes;
            }
            octaves.extend(rest.octaves(&segment, lowest_hz));
        }
        measured.points = by_frequency(&measured.segments);
        measured.noise = apply_noise_model(&octaves, &mut measured.points, self.period_s);
        Ok(measured)
    }
}

/// The points of all segments in order of frequency.
fn by_frequency(segments: &[SegmentResponse]) -> Vec<FrequencyPoint> {
    let points = segments.iter().flat_map(|s| s.points.iter().cloned());
    let mut points: Vec<FrequencyPoint> = points.collect();
    points.sort_by(|a, b| a.frequency_hz.total_cmp(&b.frequency_hz));
    points
}

/// Second and third harmonic of a line after folding, unless they fall on the line, zero or half the rate.
fn harmonics_to_watch(frequency_hz: f64, rate_hz: f64) -> Vec<f64> {
    let mut out: Vec<f64> = Vec::new();
    for h in [2.0, 3.0] {
        let folded = fold(h * frequency_hz, rate_hz);
        let free = |g: f64| (folded - g).abs() > 0.8 * frequency_hz.min(5.0);
        if free(frequency_hz) && free(0.0) && free(0.5 * rate_hz) && out.iter().all(|&g| free(g)) {
            out.push(folded);
        }
    }
    out
}

fn rows(seconds: f64, period_s: f64) -> usize {
    (seconds / period_s).round() as usize
}

/// Share of the excitation in row `k` of `release` rows of fading out.
fn fade_out(k: usize, release: usize) -> f64 {
    0.5 + 0.5 * (std::f64::consts::PI * (k + 1) as f64 / release as f64).cos()
}

#[cfg(test)]
#[path = "experiment_tests.rs"]
mod tests;
