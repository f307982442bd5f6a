//! Learning over cycles: for a periodic reference, the harmonics of the error are driven to zero by a feed-forward.
//!
//! Each harmonic `h` of the addition `u_L = sum_h Re(theta_h e^(j 2 pi h phase))` follows
//! `theta_h -= rate 2 e e^(-j 2 pi h phase) / T_h`, where `e` is the error at the time of the exposure and `T_h` the
//! response of the bead to the addition in the closed loop (adaptive feed-forward cancellation; in the mean over a cycle
//! this is iterative learning with the inverse as its filter). It converges where the relative uncertainty of `T_h` is
//! below 1: a harmonic whose response is not known so well is refused. The error is that at the exposure's own time
//! stamp, so neither a wrong gain nor a wrong delay of the loop's model remains in the result; a time stamp that is
//! itself wrong cannot be told from a lag of the bead and does remain.
//!
//! Start: two cycles of watching, in which nothing is learned. Freeze: without a fix, and for some ticks after it is
//! back, nothing is learned; the addition goes on. Retreat: when the error grows past that of the start, the best table
//! so far comes back and the rate is halved; the third retreat ends the learning.

mod beside;
mod table;

use crate::error::{BuildError, check};
use crate::uncertainty::Uncertainty;
use serde::{Deserialize, Serialize};
use std::f64::consts::TAU;

pub use beside::CycleLearning;
pub use table::{LearnedHarmonic, LearnedTable};

/// Harmonics that a learner holds.
pub const HARMONICS: usize = 8;

/// Largest relative uncertainty of a response that is learned on: below 1 by a margin.
pub const MOST_UNCERTAIN: f64 = 0.95;

/// Highest frequency learned, as a part of the sampling frequency.
pub const HIGHEST_PART: f64 = 0.35;

/// Response of the bead to an addition to the command, in the closed loop, at one harmonic.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HarmonicResponse {
    /// Which harmonic: 1 is the reference's own frequency.
    pub harmonic: u32,
    /// Real part, um of bead per um of PZT.
    pub re_um_per_um: f64,
    /// Imaginary part, um of bead per um of PZT.
    pub im_um_per_um: f64,
    /// Bound on `|T_true / T - 1|`.
    pub relative_uncertainty: f64,
}

/// How a learner learns.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LearnConfig {
    /// Part of the error taken off per cycle at first.
    pub rate_per_cycle: f64,
    /// The same in the end: it falls as 1/cycles, so that noise is averaged out.
    pub least_rate_per_cycle: f64,
    /// Bound on the rate per tick: above it the adaptation would outrun the loop.
    pub most_rate_per_tick: f64,
    /// Cycles after which the rate begins to fall.
    pub fast_cycles: f64,
    /// Cycles watched before anything is learned.
    pub watch_cycles: f64,
    /// Largest addition, um of PZT.
    pub most_um: f64,
    /// Growth of the RMS error over that of the start that makes the learner retreat.
    pub retreat_growth: f64,
    /// Ticks without learning after the bead was lost.
    pub settle_ticks: u32,
    /// Exposure of a frame, s; at most 4 ticks. A fix is the mean over it of a path whose velocity changes with each
    /// command, and is compared with the mean of the reference's path: at 300 Hz the two differ from the positions at the
    /// middle by a fifth of the amplitude.
    pub exposure_s: f64,
}

impl Default for LearnConfig {
    fn default() -> Self {
        Self {
            rate_per_cycle: 0.5,
            least_rate_per_cycle: 0.03,
            most_rate_per_tick: 0.03,
            fast_cycles: 10.0,
            watch_cycles: 2.0,
            most_um: 20.0,
            retreat_growth: 1.5,
            settle_ticks: 20,
            exposure_s: 0.0,
        }
    }
}

/// A learner that cannot be.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum LearnError {
    /// A value of the configuration.
    #[error(transparent)]
    Value(#[from] BuildError),
    /// No harmonic passes the convergence test.
    #[error(
        "learning at {frequency_hz} Hz would not be sure to converge: the loop's response to an addition is uncertain by {uncertainty:.2} of itself, and must be by less than {most}; identify the plant, or choose a lower frequency or another controller"
    )]
    NotConvergent {
        /// Frequency of the reference, Hz.
        frequency_hz: f64,
        /// Smallest relative uncertainty of its harmonics.
        uncertainty: f64,
        /// Bound.
        most: f64,
    },
    /// A table of another frequency.
    #[error(
        "the learned table is for {table_hz} Hz, the reference has {frequency_hz} Hz: learn again"
    )]
    OtherFrequency {
        /// Of the table, Hz.
        table_hz: f64,
        /// Of the reference, Hz.
        frequency_hz: f64,
    },
    /// A table with a harmonic that cannot be.
    #[error(
        "the learned table has harmonic {harmonic}: must be 1 to {HARMONICS}, below {highest_hz} Hz"
    )]
    Harmonic {
        /// Found.
        harmonic: u32,
        /// Highest frequency, Hz.
        highest_hz: f64,
    },
}

/// A learner for one periodic reference. Immutable; the state is apart and `Copy`.
#[derive(Debug, Clone, PartialEq)]
pub struct Learner {
    config: LearnConfig,
    frequency_hz: f64,
    /// Cycles per tick.
    advance: f64,
    exposure_ticks: f64,
    window_ticks: u32,
    responses: Vec<HarmonicResponse>,
    refused: Vec<HarmonicResponse>,
    margins: Option<Uncertainty>,
}

/// State of a [`Learner`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LearnerState {
    theta: [[f64; 2]; HARMONICS],
    kept: [[f64; 2]; HARMONICS],
    /// Cycles with learning so far.
    cycles: f64,
    /// Mean square of the error over the first window, um^2.
    first_um2: Option<f64>,
    best_um2: f64,
    last_um2: Option<f64>,
    sum_um2: f64,
    ticks: u32,
    watched: f64,
    pause: u32,
    slow: f64,
    retreats: u32,
}

/// Retreats after which the learning ends.
const MOST_RETREATS: u32 = 3;
/// Errors below this are noise and no reason to retreat, um.
const NOISE_UM: f64 = 0.1;
/// Shortest window over which an error counts, ticks.
const WINDOW_TICKS: f64 = 60.0;

impl Learner {
    /// A learner for a reference of `frequency_hz`, with the closed loop's response at each harmonic. Harmonics that do
    /// not pass the convergence test are left out, see [`Learner::refused`].
    ///
    /// # Errors
    /// A value out of range; no harmonic left.
    pub fn new(
        config: LearnConfig,
        frequency_hz: f64,
        sample_time_s: f64,
        responses: &[HarmonicResponse],
    ) -> Result<Self, LearnError> {
        let c = &config;
        let unit = |key, value: f64| check(key, "", value, value > 0.0 && value <= 1.0, "0 to 1");
        unit("rate_per_cycle", c.rate_per_cycle)?;
        unit("least_rate_per_cycle", c.least_rate_per_cycle)?;
        unit("most_rate_per_tick", c.most_rate_per_tick)?;
        let positive = |key, unit, value: f64| check(key, unit, value, value > 0.0, "positive");
        positive("fast_cycles", "cycles", c.fast_cycles)?;
        positive("watch_cycles", "cycles", c.watch_cycles)?;
        positive("most_um", "um", c.most_um)?;
        check(
            "retreat_growth",
            "",
            c.retreat_growth,
            c.retreat_growth > 1.0,
            "above 1",
        )?;
        check(
            "exposure_s",
            "s",
            c.exposure_s,
            (0.0..=4.0 * sample_time_s).contains(&c.exposure_s),
            "0 to 4 ticks",
        )?;
        let highest_hz = HIGHEST_PART / sample_time_s;
        check(
            "frequency_hz",
            "Hz",
            frequency_hz,
            frequency_hz > 0.0 && frequency_hz <= highest_hz,
            "above 0 and at most 0.35 of the sampling frequency",
        )?;
        let usable = |r: &&HarmonicResponse| {
            let size = r.re_um_per_um.hypot(r.im_um_per_um);
            r.relative_uncertainty < MOST_UNCERTAIN && size.is_finite() && size > 1e-6
        };
        let known = |r: &&HarmonicResponse| {
            (1..=HARMONICS as u32).contains(&r.harmonic)
                && f64::from(r.harmonic) * frequency_hz <= highest_hz
        };
        let kept: Vec<_> = responses
            .iter()
            .filter(known)
            .filter(usable)
            .copied()
            .collect();
        let refused: Vec<_> = responses
            .iter()
            .filter(|r| !(known(r) && usable(r)))
            .copied()
            .collect();
        if kept.is_empty() {
            return Err(LearnError::NotConvergent {
                frequency_hz,
                uncertainty: refused
                    .iter()
                    .map(|r| r.relative_uncertainty)
                    .fold(f64::INFINITY, f64::min),
                most: MOST_UNCERTAIN,
            });
        }
        let advance = frequency_hz * sample_time_s;
        Ok(Self {
            config,
            frequency_hz,
            advance,
            exposure_ticks: config.exposure_s / sample_time_s,
            window_ticks: ((WINDOW_TICKS * advance).ceil().max(2.0) / advance).round() as u32,
            responses: kept,
            refused,
            margins: None,
        })
    }

    /// The same learner, whose tables say by which margins its responses' uncertainty was computed.
    pub fn with_margins(mut self, margins: Option<Uncertainty>) -> Self {
        self.margins = margins;
        self
    }

    /// Harmonics that are not learned because the response is not known well enough.
    pub fn refused(&self) -> &[HarmonicResponse] {
        &self.refused
    }

    /// Frequency of the reference, Hz.
    pub fn frequency_hz(&self) -> f64 {
        self.frequency_hz
    }

    /// Nothing learned yet.
    pub fn start(&self) -> LearnerState {
        LearnerState {
            theta: [[0.0; 2]; HARMONICS],
            kept: [[0.0; 2]; HARMONICS],
            cycles: 0.0,
            first_um2: None,
            best_um2: f64::INFINITY,
            last_um2: None,
            sum_um2: 0.0,
            ticks: 0,
            watched: 0.0,
            pause: 0,
            slow: 1.0,
            retreats: 0,
        }
    }

    /// Goes on from a table: at the low rate, its addition in force from the first cycle.
    ///
    /// # Errors
    /// A table of another frequency, a harmonic or a number that cannot be.
    pub fn resume(&self, table: &LearnedTable) -> Result<LearnerState, LearnError> {
        if ((table.frequency_hz / self.frequency_hz) - 1.0).abs() > 1e-6
            || table.frequency_hz.is_nan()
        {
            return Err(LearnError::OtherFrequency {
                table_hz: table.frequency_hz,
                frequency_hz: self.frequency_hz,
            });
        }
        let mut state = self.start();
        let sampling_hz = self.frequency_hz / self.advance;
        for h in &table.harmonics {
            let slot = (h.harmonic as usize)
                .checked_sub(1)
                .and_then(|i| state.theta.get_mut(i))
                .filter(|_| f64::from(h.harmonic) * self.frequency_hz <= HIGHEST_PART * sampling_hz)
                .ok_or(LearnError::Harmonic {
                    harmonic: h.harmonic,
                    highest_hz: HIGHEST_PART * sampling_hz,
                })?;
            let most = self.config.most_um;
            check(
                "cos_um",
                "um",
                h.cos_um,
                h.cos_um.abs() <= most,
                "at most most_um",
            )?;
            check(
                "sin_um",
                "um",
                h.sin_um,
                h.sin_um.abs() <= most,
                "at most most_um",
            )?;
            *slot = [h.cos_um, -h.sin_um];
        }
        state.kept = state.theta;
        state.cycles = if table.cycles >= 0.0 {
            table.cycles
        } else {
            0.0
        };
        Ok(state)
    }

    /// What has been learned.
    pub fn table(&self, state: &LearnerState) -> LearnedTable {
        let rms = |ms: Option<f64>| ms.map(f64::sqrt);
        LearnedTable {
            frequency_hz: self.frequency_hz,
            cycles: state.cycles,
            retreats: state.retreats,
            error_before_um: rms(state.first_um2),
            error_after_um: rms(state.last_um2),
            margins: self.margins,
            harmonics: (1u32..)
                .zip(&state.theta)
                .filter(|(_, t)| t[0] != 0.0 || t[1] != 0.0)
                .map(|(harmonic, t)| LearnedHarmonic {
                    harmonic,
                    cos_um: t[0],
                    sin_um: -t[1],
                })
                .collect(),
        }
    }

    /// The addition at a phase of the reference (in cycles), um of PZT.
    pub fn addition_um(&self, state: &LearnerState, phase: f64) -> f64 {
        let most = self.config.most_um;
        let sum: f64 = self
            .responses
            .iter()
            .map(|r| {
                let (sin, cos) = (TAU * (phase * f64::from(r.harmonic)).fract()).sin_cos();
                state
                    .theta
                    .get(r.harmonic as usize - 1)
                    .map_or(0.0, |t| t[0] * cos - t[1] * sin)
            })
            .sum();
        sum.clamp(-most, most)
    }

    /// Learns from the error (bead less reference, um) at the phase (in cycles) at which the frame was exposed; `None`:
    /// no fix that could be learned from in this tick.
    pub fn learn(&self, state: &mut LearnerState, error: Option<(f64, f64)>) {
        let c = &self.config;
        let Some((phase, error_um)) = error.filter(|(p, e)| p.is_finite() && e.abs() < 1e3) else {
            state.pause = c.settle_ticks;
            state.sum_um2 = 0.0;
            state.ticks = 0;
            return;
        };
        if state.pause > 0 {
            state.pause -= 1;
            return;
        }
        state.sum_um2 += error_um * error_um;
        state.ticks += 1;
        if state.ticks >= self.window_ticks {
            let mean_um2 = state.sum_um2 / f64::from(state.ticks);
            state.sum_um2 = 0.0;
            state.ticks = 0;
            self.judge(state, mean_um2);
        }
        if state.retreats >= MOST_RETREATS {
            return;
        }
        if state.watched < c.watch_cycles {
            state.watched += self.advance;
            return;
        }
        state.cycles += self.advance;
        let fall = (c.fast_cycles / state.cycles.max(c.fast_cycles)).min(1.0);
        let per_cycle = (c.rate_per_cycle * fall).max(c.least_rate_per_cycle) * state.slow;
        let per_tick = (per_cycle * self.advance).min(c.most_rate_per_tick);
        for r in &self.responses {
            let (sin, cos) = (TAU * (phase * f64::from(r.harmonic)).fract()).sin_cos();
            // 2 e exp(-j h phase) / T
            let (re, im) = (2.0 * error_um * cos, -2.0 * error_um * sin);
            let size2 = r.re_um_per_um * r.re_um_per_um + r.im_um_per_um * r.im_um_per_um;
            let rate = per_tick / (1.0 + r.relative_uncertainty) / size2;
            if let Some(t) = state.theta.get_mut(r.harmonic as usize - 1) {
                t[0] -= rate * (re * r.re_um_per_um + im * r.im_um_per_um);
                t[1] -= rate * (im * r.re_um_per_um - re * r.im_um_per_um);
                for part in t {
                    *part = part.clamp(-c.most_um, c.most_um);
                }
            }
        }
    }

    /// The end of a window of whole cycles.
    fn judge(&self, state: &mut LearnerState, mean_um2: f64) {
        state.last_um2 = Some(mean_um2);
        let first_um2 = *state.first_um2.get_or_insert(mean_um2);
        let limit = first_um2.max(NOISE_UM * NOISE_UM) * self.config.retreat_growth.powi(2);
        if mean_um2 > limit && state.retreats < MOST_RETREATS {
            state.theta = state.kept;
            state.slow *= 0.5;
            state.retreats += 1;
            state.pause = self.window_ticks;
        } else if mean_um2 < state.best_um2 {
            state.best_um2 = mean_um2;
            state.kept = state.theta;
        }
    }
}
