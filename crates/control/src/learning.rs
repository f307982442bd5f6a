//! Learning over cycles: for a periodic reference, the harmonics of the error are driven to zero by a feed-forward.
//!
//! Each harmonic `h` of the addition `u_L = sum_h Re(theta_h e^(j 2 pi h phase))` is estimated, not descended to. While the
//! addition is steady the error at the harmonic is `d + T theta` with the response `T` of the closed loop, and noise; a
//! stretch of ticks gives its phasor `r` with the variance that the noise of the stretch leaves it (`learning/evidence.rs`). Then
//! `theta -= K r / T` with Kalman's `K = P / (P + R)`: nearly 1 while what is there is far above the noise, falling as 1/cycles
//! after that, `P` growing with each correction by what `T` is uncertain. The error is that at the exposure's own time stamp,
//! so neither a wrong gain nor a wrong delay of the loop's model remains in the result; a time stamp that is itself wrong cannot
//! be told from a lag of the bead and does remain. It converges where the relative uncertainty of `T` is below 1: a
//! harmonic whose response is not known so well is refused.
//!
//! **Beside adaptation.** What is right for the plant is the sum of feed-forward and addition, and does not change when the
//! loop's idea of the gain does. From the first correction on the feed-forward is divided by the gain that was then in force
//! ([`LearnerState::feed_forward_gain`]); before that adaptation has it, and what it moved meanwhile is reckoned with. `T` is in
//! proportion to the gain in force.
//!
//! **Whether it pays.** A harmonic is begun with where its error is surely more than noise, and given up where the error
//! that it saves is no longer above the variance that it brings.
//!
//! **Guard.** Without a fix, for some ticks after, and where the command meets its limits, nothing is learned; the addition
//! goes on; where two stretches in a row meet the limits it is taken back. When the error of a cycle grows past that of the start, the addition is taken back and learning begins anew; the third time
//! it ends.

mod beside;
mod config;
mod evidence;
mod line;
mod table;

use crate::error::check;
use crate::estimator::planned_gap;
use crate::uncertainty::Uncertainty;
use evidence::{ErrorNoise, Evidence, turn};
use line::Line;
use nalgebra::Complex;

pub use beside::CycleLearning;
pub use config::{HARMONICS, HarmonicResponse, LearnConfig, LearnError};
pub use evidence::Driven;
pub use table::{LearnedHarmonic, LearnedTable};

/// Largest relative uncertainty of a response that is learned on: below 1 by a margin.
pub const MOST_UNCERTAIN: f64 = 0.95;

/// Highest frequency learned, as a part of the sampling frequency.
pub const HIGHEST_PART: f64 = 0.35;

/// A learner for one periodic reference. Immutable; the state is apart and `Copy`.
#[derive(Debug, Clone, PartialEq)]
pub struct Learner {
    config: LearnConfig,
    frequency_hz: f64,
    /// Cycles per tick, and from fix to fix.
    advance: f64,
    fix_advance: f64,
    /// Ticks in a row that may be without a fix.
    planned_gap: u32,
    exposure_ticks: f64,
    /// Fixes of the guard's cycle.
    guard_ticks: u32,
    /// Ticks over which a change of the addition comes in.
    ramp_ticks: u32,
    responses: Vec<HarmonicResponse>,
    refused: Vec<HarmonicResponse>,
    margins: Option<Uncertainty>,
}

/// State of a [`Learner`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LearnerState {
    lines: [Line; HARMONICS],
    evidence: Evidence,
    noise: ErrorNoise,
    /// Gain that the feed-forward is divided by while anything is learned.
    feed_forward_gain: Option<f64>,
    /// Ticks since the addition changed, and of the stretch at which it is looked at next.
    since_change: u32,
    next_look: u32,
    /// Length of the stretches, cycles.
    stretch: f64,
    /// Cycles with learning so far.
    cycles: f64,
    /// Mean square of the error over the first cycles of the guard and over the last, um^2.
    first_um2: Option<f64>,
    last_um2: Option<f64>,
    sum_um2: f64,
    ticks: u32,
    pause: u32,
    /// Stretches in a row in which the command met its limits while something learned was in force.
    limited: u32,
    /// Ticks in a row without a fix.
    silent: u32,
    retreats: u32,
    /// Retreats of late, and the cycle of the last.
    in_row: u32,
    retreat_cycle: f64,
}

impl LearnerState {
    /// Gain that the feed-forward is to be divided by in the place of that in force; `None` while nothing is learned. See
    /// [`crate::LoopInput::feed_forward_gain`].
    pub fn feed_forward_gain(&self) -> Option<f64> {
        self.feed_forward_gain
    }
}

/// Retreats after which the learning ends, if they follow one another within this number of cycles.
const MOST_RETREATS: u32 = 3;
const FORGIVEN_CYCLES: f64 = 200.0;
/// Errors below this are noise and no reason to retreat, um.
const NOISE_UM: f64 = 0.1;
/// Shortest time over which the guard looks, ticks.
const GUARD_TICKS: f64 = 20.0;
/// Stretches in a row that limits may spoil before the learned part is removed.
const MOST_LIMITED: u32 = 2;
/// Growth of the stretches.
const LONGER: f64 = 1.5;

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
        config.validate(sample_time_s)?;
        let highest_hz = HIGHEST_PART / (sample_time_s * config.ticks_per_fix);
        check(
            "frequency_hz",
            "Hz",
            frequency_hz,
            frequency_hz > 0.0 && frequency_hz <= highest_hz,
            "above 0 and at most 0.35 of the camera's rate",
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
        let fix_advance = advance * config.ticks_per_fix;
        Ok(Self {
            config,
            frequency_hz,
            advance,
            fix_advance,
            planned_gap: planned_gap(config.ticks_per_fix),
            exposure_ticks: config.exposure_s / sample_time_s,
            guard_ticks: ((GUARD_TICKS * fix_advance).ceil() / fix_advance).round() as u32,
            ramp_ticks: (1.0 / advance).ceil().clamp(4.0, 20.0) as u32,
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

    /// Nothing learned yet.
    pub fn start(&self) -> LearnerState {
        LearnerState {
            lines: [Line::default(); HARMONICS],
            evidence: Evidence::default(),
            noise: ErrorNoise::default(),
            feed_forward_gain: None,
            since_change: u32::MAX,
            next_look: self.fixes_of(self.config.watch_cycles),
            stretch: self.config.watch_cycles,
            cycles: 0.0,
            first_um2: None,
            last_um2: None,
            sum_um2: 0.0,
            ticks: 0,
            pause: 0,
            limited: 0,
            silent: 0,
            retreats: 0,
            in_row: 0,
            retreat_cycle: 0.0,
        }
    }

    /// Fixes of this number of cycles; at least those that are watched.
    fn fixes_of(&self, cycles: f64) -> u32 {
        let least = f64::from(self.config.watch_ticks) * self.fix_advance;
        (cycles.max(least.ceil()) / self.fix_advance)
            .round()
            .min(1e9) as u32
    }

    fn harmonics(&self) -> impl Iterator<Item = u32> + '_ {
        self.responses.iter().map(|response| response.harmonic)
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
        let sampling_hz = self.frequency_hz / self.fix_advance;
        for h in &table.harmonics {
            let line = (h.harmonic as usize)
                .checked_sub(1)
                .and_then(|i| state.lines.get_mut(i))
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
            let theta = Complex::new(h.cos_um, -h.sin_um);
            let response = self.responses.iter().find(|r| r.harmonic == h.harmonic);
            *line = Line::of_another_run(theta, response);
            let gain = table.feed_forward_gain.unwrap_or(1.0);
            let usable = (0.1..=10.0).contains(&gain);
            check("feed_forward_gain", "", gain, usable, "0.1 to 10")?;
            state.feed_forward_gain = Some(gain);
        }
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
            feed_forward_gain: state.feed_forward_gain,
            harmonics: (1u32..)
                .zip(&state.lines)
                .filter(|(_, line)| line.active)
                .map(|(harmonic, line)| LearnedHarmonic {
                    harmonic,
                    cos_um: line.theta.re,
                    sin_um: -line.theta.im,
                })
                .collect(),
        }
    }

    /// The addition at a phase of the reference (in cycles), um of PZT.
    pub fn addition_um(&self, state: &LearnerState, phase: f64) -> f64 {
        let most = self.config.most_um;
        let sum: f64 = self
            .harmonics()
            .filter_map(|h| Some((h, state.lines.get(h as usize - 1)?)))
            .map(|(h, line)| {
                let turn = turn(h, phase);
                let part = self.part(state);
                let theta = line.from + (line.theta - line.from) * part;
                theta.re * turn.re + theta.im * turn.im
            })
            .sum();
        sum.clamp(-most, most)
    }

    /// Part of the last change that has come in.
    fn part(&self, state: &LearnerState) -> f64 {
        (f64::from(state.since_change) / f64::from(self.ramp_ticks)).min(1.0)
    }

    /// Learns from the error (bead less reference, um) at the phase (in cycles) at which the frame was exposed; `None`: this tick
    /// has no fix to learn from. `driven` is the part that moves the bead now, at the phase `now`.
    pub fn learn(
        &self,
        state: &mut LearnerState,
        error: Option<(f64, f64)>,
        (now, driven): (f64, &Driven),
    ) {
        let c = &self.config;
        state.since_change = state.since_change.saturating_add(1);
        state.silent = if error.is_some() {
            0
        } else {
            state.silent.saturating_add(1)
        };
        if error.is_none() && state.silent <= self.planned_gap {
            return;
        }
        let Some((phase, error_um)) = error.filter(|(p, e)| p.is_finite() && e.abs() < 1e3) else {
            state.pause = c.settle_ticks;
            (state.sum_um2, state.ticks) = (0.0, 0);
            state.evidence.interrupt();
            return;
        };
        if state.pause > 0 {
            state.pause -= 1;
            return;
        }
        self.guard(state, error_um);
        if state.in_row >= MOST_RETREATS {
            return;
        }
        if state.since_change <= self.ramp_ticks.saturating_add(c.response_ticks) {
            state.evidence.pass(error_um);
            return;
        }
        state.cycles += self.fix_advance;
        state
            .evidence
            .add(self.harmonics(), (phase, error_um), (now, driven));
        if state.evidence.ticks() >= state.next_look {
            self.look(state, driven);
        }
    }

    /// Begins a stretch of this number of cycles.
    fn begin(&self, state: &mut LearnerState, cycles: f64) {
        state.evidence.begin_again();
        state.stretch = cycles.min(self.config.longest_cycles);
        state.next_look = self.fixes_of(state.stretch);
    }

    /// The end of a stretch: what stands out of the noise is corrected.
    fn look(&self, state: &mut LearnerState, driven: &Driven) {
        let evidence = state.evidence;
        // Beyond range or slew the addition does not have its response, and its effect there is not learned.
        let learned = state.lines.iter().any(|line| line.active);
        state.limited = if evidence.is_limited() && learned {
            state.limited + 1
        } else {
            0
        };
        if state.limited >= MOST_LIMITED {
            self.retreat(state);
            return;
        }
        let noise = evidence.noise(self.harmonics(), &state.noise);
        let cycles = f64::from(evidence.ticks()) * self.fix_advance;
        let floor = 1.0 - (1.0 - 1.0 / self.config.longest_cycles.max(2.0)).powf(cycles);
        let (mut learning, mut changed) = (false, false);
        for response in self.responses.iter().filter(|_| !evidence.is_limited()) {
            let Some(line) = state.lines.get_mut(response.harmonic as usize - 1) else {
                continue;
            };
            let before = line.theta;
            let how = (self.fix_advance, floor, self.config.most_um);
            line.correct(response, &evidence, &noise, how, driven);
            line.from = before;
            learning |= line.active;
            changed |= line.theta != before;
        }
        if !evidence.is_limited() {
            state.feed_forward_gain = if learning {
                state.feed_forward_gain.or(Some(driven.feed_forward_gain))
            } else {
                None
            };
        }
        let longest = cycles >= self.config.longest_cycles;
        if changed {
            state.since_change = 0;
        }
        if changed || learning || longest || evidence.is_limited() {
            state.noise = noise;
            self.begin(state, state.stretch * LONGER);
        } else {
            // Not enough data yet: the stretch continues.
            state.next_look = self.fixes_of(cycles * LONGER);
        }
    }

    /// A tick of the guard.
    fn guard(&self, state: &mut LearnerState, error_um: f64) {
        state.sum_um2 += error_um * error_um;
        state.ticks += 1;
        if state.ticks < self.guard_ticks {
            return;
        }
        let mean_um2 = state.sum_um2 / f64::from(state.ticks);
        (state.sum_um2, state.ticks) = (0.0, 0);
        state.last_um2 = Some(mean_um2);
        let first_um2 = *state.first_um2.get_or_insert(mean_um2);
        let limit = first_um2.max(NOISE_UM * NOISE_UM) * self.config.retreat_growth.powi(2);
        let learned = state.lines.iter().any(|line| line.active);
        if mean_um2 > limit && learned && state.in_row < MOST_RETREATS {
            self.retreat(state);
        }
    }

    /// Removes the addition, and learns again unless that was in vain.
    fn retreat(&self, state: &mut LearnerState) {
        state.limited = 0;
        if state.cycles - state.retreat_cycle > FORGIVEN_CYCLES {
            state.in_row = 0;
        }
        state.retreats += 1;
        state.in_row += 1;
        state.retreat_cycle = state.cycles;
        for line in &mut state.lines {
            *line = Line {
                from: line.theta,
                ..Line::default()
            };
        }
        state.feed_forward_gain = None;
        state.since_change = 0;
        self.begin(state, self.config.watch_cycles);
        state.pause = self.guard_ticks;
    }
}
