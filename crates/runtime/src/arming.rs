//! The check before the loop is closed: is the plant there, with the sign and roughly the gain of the model?
//!
//! The PZT makes a small doublet (up, down, back) about the displacement at which it stood; the bead's frame-to-frame increments are fitted
//! with `drift * time + ratio * increments predicted by the model`. Increments, because Brownian motion makes positions a random walk; a
//! doublet, because it leaves the bead where it was. If the bead is farther from position 0 than the doublet moves it, the first half goes
//! towards 0. A bead at the border of the view stays in it.
//!
//! A frame counts for the time of its exposure, however late it comes. The frame after a missing one counts for the time since the one
//! before. The variance of an increment grows with its time, as Brownian motion's does. Increments near a skipped tick, or near a command
//! that came late or not at all, answer another pulse: they are left out. While the fit cannot decide, or refuses the plant after such a
//! command, the pulse is made again. All pulses are fitted together, until the patience of arming ends.
//!
//! An object that does not move at all may be a bead on the glass. It is rejected, and the pulse tries another object. If no other comes,
//! or none of several moves, the plant is refused.

mod increments;

use crate::life::Refusal;
use cellpos_control::LoopModel;
use cellpos_numeric::statistics::{Z95, student_t_quantile};
use cellpos_numeric::units::Seconds;
use cellpos_plant::{DiscretePlant, PlantError, TransferFunction};
use increments::{Rest, Sums};
use serde::{Deserialize, Serialize};

/// How arming goes. In TOML every key may be left out.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ArmingConfig {
    /// Whether the plant is checked at all; without, the loop is closed as soon as the bead is steadily seen.
    pub check: bool,
    /// Good positions in a row before the pulse.
    pub steady_ticks: u32,
    /// Ticks after which arming ends without a result: without a bead that is steadily seen, or with pulses that leave a doubt.
    pub patience_ticks: u32,
    /// Height of the doublet, um of PZT. One made longer for the plant's lags has the height that moves the bead as far as this one does
    /// without lags.
    pub pulse_um: f64,
    /// Ticks up, and ticks down; more where the plant's lags are longer.
    pub pulse_ticks: u32,
    /// Smallest gain over the model's that is accepted.
    pub lowest_ratio: f64,
    /// Largest gain over the model's that is accepted.
    pub highest_ratio: f64,
}

impl Default for ArmingConfig {
    /// 0.5 um for 10 ms each way: 2 um of bead at 400 /s, against 0.1 um of Brownian motion. The controllers are stable
    /// for 0.5 to 2 times the gain; the interval here is wider by the check's own uncertainty.
    fn default() -> Self {
        Self {
            check: true,
            steady_ticks: 20,
            patience_ticks: 2_000,
            pulse_um: 0.5,
            pulse_ticks: 10,
            lowest_ratio: 0.4,
            highest_ratio: 2.5,
        }
    }
}

/// What the check found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GainCheck {
    /// Measured gain over the model's.
    pub gain_ratio: f64,
    /// Its standard deviation, if the increments of the bead are independent.
    pub sd: f64,
    /// The same with what shook the bead before the pulse: a hum of the pulse's period is part of its response.
    pub shaken_sd: f64,
    /// Degrees of freedom from which that is known.
    pub dof: f64,
    /// Why the plant is refused, if it is.
    pub refusal: Option<Refusal>,
    /// Whether the interval leaves no doubt about the refusal.
    sure: bool,
}

impl GainCheck {
    /// Refused without a gain.
    fn unmeasured(refusal: Option<Refusal>) -> Self {
        Self {
            gain_ratio: f64::NAN,
            sd: f64::NAN,
            shaken_sd: f64::NAN,
            dof: f64::NAN,
            refusal,
            sure: refusal != Some(Refusal::Disturbed),
        }
    }

    /// Half width of the 95 % interval of the gain.
    pub fn ci95(&self) -> f64 {
        if self.sd.is_nan() {
            return f64::NAN;
        }
        self.sd * student_t_quantile(0.975, self.dof)
    }

    /// The same for the gain that is stated.
    pub fn stated95(&self) -> f64 {
        self.ci95().max(Z95 * self.shaken_sd)
    }
}

/// The doublet and its response according to the model, both computed before the run.
#[derive(Debug, Clone, PartialEq)]
pub struct Arming {
    config: ArmingConfig,
    /// Ticks that increments must have covered.
    least: u32,
    /// Ticks in a row without a frame that a steady bead may have.
    most_silent: u32,
    /// Displacement at each tick of the pulse less the one before the pulse, um.
    program_um: Vec<f64>,
    /// Measured position at each tick, um, as the model says.
    positions_um: Vec<f64>,
    /// Ticks until a disturbance is no longer seen in the increments.
    settling_ticks: u32,
}

/// How far the check has come.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ArmingState {
    ticks: u32,
    steady: u32,
    /// Ticks since the last position.
    unseen: u32,
    /// Ticks of the pulses before this one.
    spent: u32,
    /// The check of the last object that did not move, and how many there were.
    unmoved: Option<GainCheck>,
    rejected: u32,
    /// Tick of the pulse; `None` before it.
    pulse: Option<u32>,
    base_um: f64,
    /// Whether the doublet goes down first.
    down_first: bool,
    /// The last position, um, and the tick of the pulse, with its fraction, at which it came or was due.
    last: Option<(f64, f64)>,
    /// Ticks in a row without a frame.
    silent: u32,
    /// Increments of the bead at rest before this pulse, and of all pulses.
    rest: Rest,
    seen: Sums,
    /// Tick of the pulse at which a command last did not come into force when it was due.
    unled_at: Option<u32>,
    /// Whether time has not passed as planned in this pulse.
    disturbed: bool,
}

impl ArmingState {
    /// Sign of the doublet.
    fn way(&self) -> f64 {
        if self.down_first { -1.0 } else { 1.0 }
    }
}

/// Ticks in a row without a frame that a steady bead may have where each tick has one.
const MOST_SILENT: u32 = 3;
/// Objects that are rejected: as many as the tracker remembers. A source that gives positions alone is tried as often.
const MOST_REJECTED: u32 = 8;
/// Ticks without a position after which the PZT goes to where the bead is believed to rest.
const UNSEEN_TICKS: u32 = 50;
/// How far it goes in a tick, um: 100 um/s at 1 kHz.
const SEARCH_UM: f64 = 0.1;

/// A good position.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fix {
    /// The position, um.
    pub position_um: f64,
    /// Its age beyond the camera path, ticks.
    pub late_ticks: f64,
}

/// Input of one tick of arming.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ArmingInput {
    /// The position, if there is a good one.
    pub fix: Option<Fix>,
    /// Whether a new frame came: a camera slower than the loop has none for some ticks.
    pub framed: bool,
    /// Displacement commanded so far, um.
    pub command_um: f64,
    /// Displacement at which the bead is believed to rest, um.
    pub neutral_um: f64,
    /// Whether time did not pass as planned: ticks were skipped, the frame is late, missing or old, the last command was late.
    pub disturbed: bool,
    /// Whether the commands came into force when they were due: no tick was skipped, none came late or was lost.
    pub led: bool,
    /// Periods since the tick before.
    pub steps: u64,
}

/// What to do in this tick of arming.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Step {
    /// Hold this displacement, um.
    Command(f64),
    /// The pulse leaves a doubt; hold this displacement, um, until the bead is steady again.
    Again(f64, GainCheck),
    /// The object in view does not move. Hold this displacement, um, until another one is steady.
    Another(f64, GainCheck),
    /// The check is over.
    Done(GainCheck),
}

impl Arming {
    /// Prepares the pulse for a plant seen through a camera path of `camera_delay`, with one fix in `ticks_per_fix` ticks. `model` is the
    /// plant as the loop sees it. The pulse is longer by the ticks of a fix.
    ///
    /// A pulse that is shorter than the plant's lags measures the gain over the lags, and moves the bead little. Such a pulse is made as
    /// long as the lags, and as high as moves the bead as far as the configured pulse does without lags. Patience grows with the pulse.
    ///
    /// # Errors
    /// The plant cannot be discretised.
    pub fn new(
        config: ArmingConfig,
        plant: &TransferFunction,
        model: &LoopModel,
        camera_delay: Seconds,
        ticks_per_fix: f64,
    ) -> Result<Self, PlantError> {
        let times = ticks_per_fix.ceil().max(1.0) as u32;
        let sample = Seconds(model.sample_time_s);
        let ticks = |seconds: f64| (seconds / sample.value()).ceil().max(0.0) as u32;
        let discrete = DiscretePlant::new(plant, sample, camera_delay)?;
        let rest = ticks(camera_delay.value()) + ticks(2.0 * model.lag_s()).max(4);
        let without_lags = config.pulse_ticks.saturating_mul(times);
        let up = without_lags.max(ticks(model.lag_s()));
        let answer_um = |program_um: &[f64]| -> Vec<f64> {
            let mut state = discrete.state(0.0);
            let answer = program_um.iter().map(|&command_um| {
                let now_um = discrete.output_um(&state);
                discrete.step(&mut state, command_um);
                now_um
            });
            answer.collect()
        };
        let doublet = |height_um: f64| -> Vec<f64> {
            let at = |tick| match tick {
                tick if tick < up => height_um,
                tick if tick < 2 * up => -height_um,
                _ => 0.0,
            };
            (0..2 * up + rest).map(at).collect()
        };
        let mut height_um = config.pulse_um;
        if up > without_lags {
            let reach = |um: &[f64]| um.iter().fold(0.0_f64, |most, um| most.max(um.abs()));
            let area_um_s = config.pulse_um * f64::from(without_lags) * sample.value();
            height_um = (model.gain_per_s * area_um_s).abs() / reach(&answer_um(&doublet(1.0)));
        }
        let program_um = doublet(height_um);
        let config = ArmingConfig {
            patience_ticks: (config.patience_ticks)
                .saturating_mul(up.div_ceil(config.pulse_ticks.max(1))),
            pulse_um: height_um,
            pulse_ticks: up,
            ..config
        };
        Ok(Self {
            config,
            least: up,
            most_silent: MOST_SILENT.saturating_mul(times),
            positions_um: answer_um(&program_um),
            program_um,
            settling_ticks: rest,
        })
    }

    /// One tick.
    ///
    /// While a bead is seen, the PZT is held where it stands, which may be where a person has brought the bead to rest. Where none is
    /// seen (a board that has parked flings it away, and the next one too) the PZT goes to the believed rest, so that one can stay.
    /// Each bead that passes tells the estimator the flow, and so moves that belief to where it would have stood still. The tracker takes
    /// a bead that moves less than some 2 px a frame for one: 200 um/s at 0.1 um/px, which is a zero flow 0.5 um off.
    pub fn step(&self, state: &mut ArmingState, input: &ArmingInput) -> Step {
        let ArmingInput {
            fix,
            command_um,
            neutral_um,
            ..
        } = *input;
        let steps = u32::try_from(input.steps).unwrap_or(u32::MAX);
        state.ticks = state.ticks.saturating_add(steps);
        state.unseen = match fix {
            Some(_) => 0,
            None => state.unseen.saturating_add(steps),
        };
        state.silent = if input.framed { 0 } else { state.silent + 1 };
        let Some(pulse) = state.pulse else {
            if let Some(fix) = fix {
                state.steady += 1;
                self.rest(state, &fix);
            } else if input.framed || state.silent > self.most_silent {
                (state.steady, state.last, state.rest) = (0, None, Rest::default());
            }
            if state.steady >= self.config.steady_ticks {
                if !self.config.check {
                    return Step::Done(GainCheck::unmeasured(None));
                }
                state.pulse = Some(0);
                state.last = fix.map(|fix| (-fix.late_ticks, fix.position_um));
                state.base_um = command_um;
                let reach_um = self.positions_um.iter().copied().fold(0.0, f64::max);
                state.down_first = fix.is_some_and(|fix| fix.position_um > reach_um);
                let first_um = self.program_um.first().copied().unwrap_or(0.0);
                return Step::Command(command_um + state.way() * first_um);
            }
            if state.ticks > self.config.patience_ticks {
                let none = GainCheck::unmeasured(Some(Refusal::NoBead));
                return Step::Done(state.unmoved.unwrap_or(none));
            }
            if state.unseen <= UNSEEN_TICKS || !neutral_um.is_finite() {
                return Step::Command(command_um);
            }
            let away_um = neutral_um - command_um;
            return Step::Command(command_um + away_um.clamp(-SEARCH_UM, SEARCH_UM));
        };
        let tick = pulse + 1;
        state.pulse = Some(tick);
        state.disturbed |= input.disturbed;
        if !input.led {
            state.unled_at = Some(tick);
        }
        self.take(state, input, tick);
        match self.program_um.get(tick as usize) {
            Some(offset_um) => Step::Command(state.base_um + state.way() * offset_um),
            None => {
                let verdict = self.judge(state);
                let doubtful = !verdict.sure || state.unled_at.is_some();
                let spent = state.spent.saturating_add(tick);
                let unmoved = verdict.refusal == Some(Refusal::NoResponse) && !doubtful;
                let base_um = state.base_um;
                if unmoved && state.rejected < MOST_REJECTED {
                    *state = ArmingState {
                        unmoved: Some(verdict),
                        rejected: state.rejected + 1,
                        ..ArmingState::default()
                    };
                    return Step::Another(base_um, verdict);
                }
                if verdict.refusal.is_none() || !doubtful || spent > self.config.patience_ticks {
                    return Step::Done(verdict);
                }
                *state = ArmingState {
                    spent,
                    seen: state.seen,
                    unmoved: state.unmoved,
                    rejected: state.rejected,
                    ..ArmingState::default()
                };
                Step::Again(base_um, verdict)
            }
        }
    }

    /// A position before the pulse.
    fn rest(&self, state: &mut ArmingState, fix: &Fix) {
        let now = f64::from(state.ticks) - fix.late_ticks;
        let last = state.last.replace((now, fix.position_um));
        if let Some((from, before_um)) = last.filter(|(from, _)| *from < now) {
            let up = f64::from(self.config.pulse_ticks);
            let waves = [now, now + 0.5 * up].map(|at| {
                let is_first = (at / up).rem_euclid(2.0) < 1.0;
                if is_first { 1.0 } else { -1.0 }
            });
            let y = (fix.position_um - before_um) / (now - from).sqrt();
            state.rest.add(waves, y);
        }
    }

    /// The position of a tick of the pulse.
    fn take(&self, state: &mut ArmingState, input: &ArmingInput, tick: u32) {
        let Some(fix) = input.fix else {
            if input.framed {
                // What comes next may be another bead.
                state.last = None;
            }
            return;
        };
        let now = f64::from(tick) - fix.late_ticks;
        let last = state.last.replace((now, fix.position_um));
        let Some((from, before_um)) = last.filter(|(from, _)| *from < now) else {
            return;
        };
        let unled = (state.unled_at).is_some_and(|at| f64::from(at + self.settling_ticks) > from);
        if !unled {
            let expected_um = self.expected_um(now) - self.expected_um(from);
            (state.seen).add(
                now - from,
                state.way() * expected_um,
                fix.position_um - before_um,
            );
        }
    }

    /// The position that the model expects at a tick of the pulse and its fraction, less the one before the pulse, um.
    fn expected_um(&self, tick: f64) -> f64 {
        let at = |tick: usize| {
            let last = self.positions_um.last();
            (self.positions_um.get(tick).or(last)).map_or(0.0, |um| *um)
        };
        let whole = tick.max(0.0).floor();
        let (before_um, after_um) = (at(whole as usize), at(whole as usize + 1));
        before_um + (tick.max(0.0) - whole) * (after_um - before_um)
    }

    /// What the pulses tell, by the increments that nothing disturbed.
    fn judge(&self, state: &ArmingState) -> GainCheck {
        self.fitted(&state.seen, &state.rest).unwrap_or_else(|| {
            GainCheck::unmeasured(Some(if state.disturbed {
                Refusal::Disturbed
            } else {
                Refusal::LostInPulse
            }))
        })
    }

    /// Straight-line fit of increments; `None` if there are too few.
    fn fitted(&self, s: &Sums, rest: &Rest) -> Option<GainCheck> {
        // Half of a pulse must have been seen, or the ratio means nothing.
        if s.ticks < f64::from(self.least) || s.count < 3.0 {
            return None;
        }
        let sxx = s.xx - s.x * s.x / s.ticks;
        let sxy = s.xy - s.x * s.y / s.ticks;
        let syy = s.yy - s.y * s.y / s.ticks;
        if sxx.is_nan() || sxx <= 0.0 {
            return None;
        }
        let gain_ratio = sxy / sxx;
        let dof = s.count - 2.0;
        let sd = (((syy - gain_ratio * sxy) / dof).max(0.0) / sxx).sqrt();
        let mut found = GainCheck {
            gain_ratio,
            sd,
            shaken_sd: sd.max((rest.variance() / sxx).sqrt()),
            dof,
            refusal: None,
            sure: true,
        };
        let ci95 = found.ci95();
        let accepted = self.config.lowest_ratio..=self.config.highest_ratio;
        let (low, high) = (gain_ratio - ci95, gain_ratio + ci95);
        let outside = high < *accepted.start() || low > *accepted.end();
        (found.refusal, found.sure) = if gain_ratio.abs() <= 2.0 * ci95 {
            (Some(Refusal::NoResponse), outside)
        } else if gain_ratio < 0.0 {
            (Some(Refusal::WrongSign), true)
        } else if !accepted.contains(&gain_ratio) {
            (Some(Refusal::WrongGain), outside)
        } else {
            (None, true)
        };
        Some(found)
    }
}

#[cfg(test)]
#[path = "arming_tests.rs"]
mod tests;
