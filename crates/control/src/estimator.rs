//! Kalman filter of the bead with input delay, per-fix variance, missing and late measurements, and an innovation gate.
//!
//! State: integrator position `q` and neutral `n` with their covariance; the fast modes are known functions of the
//! commands. The filter stands at the time of the newest measurement it has used; the present is predicted from there
//! through the commands since. A missing measurement just leaves the filter where it is (for up to
//! three ticks), so a late one is used at the time at which its frame was exposed, exactly.
//!
//! Brownian motion drives `q` with variance `2 D Ts` per tick, neutral is a random walk, and a relative uncertainty of
//! the gain widens the covariance in proportion to the motion it predicts.

mod config;
mod covariance;
mod exposure;
mod flow_step;
mod retune;
mod stuck;
mod transition;
mod uncertainty;

use crate::error::BuildError;
use crate::loop_model::{LoopModel, MODES};
use covariance::{advanced, at_rest};
use transition::Transition;

pub use config::EstimatorConfig;
pub(crate) use config::planned_gap;
pub use covariance::ZERO_FLOW_WALK_UM_PER_SQRT_S;
pub use flow_step::{RecentFixes, flow_step_log_density};
pub use stuck::StillBead;
pub use transition::PredictedState;

/// Past commands held: a delay of up to 15 samples, which is 3 ms at 5 kHz.
pub const HISTORY: usize = 16;

/// Ticks by which a frame may be late and still be used at its own time.
const LONGEST_LAG: usize = 3;

/// Delay that a model may lack: a bead in fast motion is that many ticks of it away from where it is expected, and is still
/// the same bead.
const GATE_LAG_TICKS: f64 = 1.0;

/// Ticks after a bead came free for which its speed stays bounded.
const RELEASED_TICKS: u8 = 50;

/// Weight of a fix in the average position of a stuck bead.
const STUCK_AVERAGE: f64 = 0.05;

/// What the variance per tick that a wrong gain may cause keeps of itself from tick to tick: it halves in 8 ticks.
const SPREAD_KEPT: f64 = 0.917_004_043_204_671_2;

/// Variance that a wrong gain may cause below which it is none, um^2.
const LEAST_SPREAD_UM2: f64 = 1e-6;

/// State of the estimator.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EstimatorState {
    /// Integrator part of the position at the filter's time, um.
    pub integrator_um: f64,
    /// Neutral at the filter's time, um.
    pub neutral_um: f64,
    /// Covariance: position-position, position-neutral, neutral-neutral, um^2. It gives the gains, for a zero flow that may walk fast.
    pub covariance_um2: [f64; 3],
    /// Covariance of the errors that these gains leave on a rig whose zero flow walks as usual, um^2.
    pub stated_um2: [f64; 3],
    /// Fast modes at the filter's time, um s.
    pub modes: [f64; MODES],
    /// Commands of the previous ticks, newest first, um.
    pub history_um: [f64; HISTORY],
    /// Evidence that the bead is stuck, natural logarithm of the odds, 0 or more.
    pub stuck_evidence: f64,
    /// Whether the bead stays where it is, or walks.
    pub still: StillBead,
    /// Variance per tick that a wrong gain may cause, um^2.
    pub spread_um2: f64,
    /// Part of the stated uncertainty of the gain that is left; 1 where nothing more is known of it.
    pub gain_doubt: f64,
    /// By how much the square of the walk of the zero flow is above that of the configuration, um^2/s; 0 where nothing more is known of it.
    pub beyond_walk_um2_per_s: f64,
    /// Ticks by which the filter's time lies behind the nominal delay.
    pub lag: u8,
    /// Refused measurements in a row.
    pub gated: u8,
    /// Ticks since the newest measurement that was used.
    pub ticks_since_fix: u8,
    /// What the last fixes say of a step of the flow.
    pub recent: RecentFixes,
    /// Ticks for which a step of the flow that was granted counts as new.
    pub stepped_ticks: u8,
    /// A measurement has been used.
    pub seen: bool,
    /// The bead is taken for stuck.
    pub stuck: bool,
    /// Ticks for which the speed of a bead that came free stays bounded.
    pub released_ticks: u8,
}

/// What the estimator knows after a measurement (or its absence).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate {
    /// Bead position now, just before the command takes effect, um.
    pub position_um: f64,
    /// Standard deviation of that position, um.
    pub position_sd_um: f64,
    /// Neutral: the PZT displacement at which the bead rests, um.
    pub neutral_um: f64,
    /// What this tick's measurement shows by the model, um.
    pub predicted_measurement_um: f64,
    /// Measurement less its prediction, um.
    pub innovation_um: f64,
    /// The measurement was used, at its nominal time.
    pub fresh: bool,
    /// No measurement was used.
    pub coasting: bool,
    /// The measurement was refused by the innovation gate.
    pub gated: bool,
    /// A step of the flow was granted within the last ticks: what is seen in them says nothing of gain and delay.
    pub stepped: bool,
    /// A measurement has been used at some time.
    pub seen: bool,
    /// The bead is taken for stuck.
    pub stuck: bool,
    /// Largest distance of the command from neutral, um; infinite unless the bead is stuck or has just come free.
    pub authority_um: f64,
    /// The present as a state, for state feedback.
    pub now: PredictedState,
}

/// A fix as the estimator takes it: finite and within reason.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Fix {
    pub position_um: f64,
    pub variance_um2: f64,
    pub age: usize,
    /// Its time stamp beyond that, ticks: positive for older.
    pub offset: f64,
}

/// A Kalman filter for one model and sample time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimator {
    config: EstimatorConfig,
    model: LoopModel,
    tick: Transition,
    /// From the last whole tick before a nominal measurement to that measurement.
    part: Transition,
    /// Whole ticks of delay, rounded up.
    delay_ticks: usize,
    longest_lag: usize,
}

impl Estimator {
    /// Builds the filter.
    ///
    /// # Errors
    /// A value out of range, or a delay that needs more than [`HISTORY`] past commands.
    pub fn new(config: EstimatorConfig, model: LoopModel) -> Result<Self, BuildError> {
        model.validate()?;
        config.validate(model.sample_time_s)?;
        let samples = model.delay_samples();
        let delay_ticks = (samples - 1e-9).ceil().max(0.0) as usize;
        if delay_ticks + 1 > HISTORY {
            return Err(BuildError::DelayTooLong {
                delay_ms: model.delay_s * 1e3,
                longest_ms: (HISTORY - 1) as f64 * model.sample_time_s * 1e3,
            });
        }
        let part = (delay_ticks as f64 - samples).max(0.0);
        Ok(Self {
            config,
            model,
            tick: Transition::new(&model, 1.0),
            part: Transition::new(&model, if part < 1e-9 { 0.0 } else { part }),
            delay_ticks,
            longest_lag: LONGEST_LAG.min(HISTORY - 1 - delay_ticks),
        })
    }

    /// The plant it was built for.
    pub fn model(&self) -> &LoopModel {
        &self.model
    }

    /// A state at rest: every past command was `command_um`, neutral is believed to be `neutral_um`, no bead seen.
    pub fn start(&self, command_um: f64, neutral_um: f64) -> EstimatorState {
        EstimatorState {
            integrator_um: 0.0,
            neutral_um,
            covariance_um2: [1e4, 0.0, self.config.neutral_initial_um.powi(2)],
            stated_um2: [1e4, 0.0, self.config.neutral_initial_um.powi(2)],
            modes: [0.0; MODES],
            history_um: [command_um; HISTORY],
            stuck_evidence: 0.0,
            still: StillBead::default(),
            spread_um2: 0.0,
            gain_doubt: 1.0,
            beyond_walk_um2_per_s: 0.0,
            lag: 0,
            gated: 0,
            ticks_since_fix: 0,
            recent: RecentFixes::default(),
            stepped_ticks: 0,
            seen: false,
            stuck: false,
            released_ticks: 0,
        }
    }

    /// Position from the state at one time, um.
    pub(crate) fn position(&self, m: &PredictedState) -> f64 {
        let modes: f64 = m
            .modes
            .iter()
            .zip(&self.model.modes)
            .map(|(x, mode)| mode.residue_per_s * x)
            .sum();
        m.q + modes + self.model.feedthrough * (m.last_um - m.n)
    }

    /// The command that was in force `ticks_ago` (1: that of the previous tick).
    fn command(state: &EstimatorState, ticks_ago: usize) -> f64 {
        let last = state.history_um[HISTORY - 1];
        state
            .history_um
            .get(ticks_ago.saturating_sub(1))
            .copied()
            .unwrap_or(last)
    }

    fn filter_state(&self, state: &EstimatorState) -> PredictedState {
        self.filter_state_at(state, self.delay_ticks + usize::from(state.lag))
    }

    /// The filter's state where its newest command is `back` ticks back.
    fn filter_state_at(&self, state: &EstimatorState, back: usize) -> PredictedState {
        PredictedState {
            q: state.integrator_um,
            n: state.neutral_um,
            modes: state.modes,
            // Nothing of the PZT's motion reaches a stuck bead.
            last_um: if state.stuck {
                state.neutral_um
            } else {
                Self::command(state, back + 1)
            },
        }
    }

    /// Moves the filter one tick towards the present. Returns the motion that the model predicts for that tick, um.
    fn advance_filter(&self, state: &mut EstimatorState) -> f64 {
        let back = self.delay_ticks + usize::from(state.lag);
        let command = Self::command(state, back.max(1));
        let m = self.filter_state(state);
        let motion = self.tick.gain * (command - m.n);
        let ts = self.model.sample_time_s;
        let beyond_um2 = state.beyond_walk_um2_per_s * ts;
        let neutral_walk_um2 = self.config.neutral_walk_um_per_sqrt_s.powi(2) * ts + beyond_um2;
        let stated_walk_um2 = ZERO_FLOW_WALK_UM_PER_SQRT_S.powi(2) * ts + beyond_um2;
        state.lag = state.lag.saturating_sub(1);
        if state.stuck {
            state.modes = [0.0; MODES];
            state.covariance_um2 = at_rest(state.covariance_um2, neutral_walk_um2);
            state.stated_um2 = at_rest(state.stated_um2, stated_walk_um2);
            return motion;
        }
        let next = self.tick.advance(&m, command);
        state.integrator_um = next.q;
        state.modes = next.modes;
        let g = self.tick.gain;
        let unsure = self.config.gain_uncertainty * state.gain_doubt;
        let spread = unsure * self.net_motion(state, back, m.n);
        // It rises at once and falls slowly, so that it follows the crests: a filter whose gain rose and fell within each
        // cycle of a motion would rectify the innovations of that cycle into a false neutral.
        let crest = (SPREAD_KEPT * state.spread_um2).max(spread * spread);
        state.spread_um2 = if crest > LEAST_SPREAD_UM2 { crest } else { 0.0 };
        let walk_um2 = 2.0 * self.config.diffusion_um2_per_s * ts + state.spread_um2;
        state.covariance_um2 = advanced(state.covariance_um2, g, walk_um2, neutral_walk_um2);
        state.stated_um2 = advanced(state.stated_um2, g, walk_um2, stated_walk_um2);
        motion
    }

    /// From the filter's time to that of its measurement.
    fn at_measurement(&self, m: &PredictedState, command_um: f64, stuck: bool) -> PredictedState {
        if self.part.fraction == 0.0 || stuck {
            *m
        } else {
            self.part.advance(m, command_um)
        }
    }

    /// From the filter's time to that of a fix, by its time stamp.
    fn part_of(&self, fix: &Fix) -> Transition {
        /// Differences below this are the noise of time stamps, ticks.
        const SAME: f64 = 1e-3;
        if fix.offset.abs() < SAME {
            self.part
        } else {
            Transition::new(&self.model, self.part.fraction - fix.offset)
        }
    }

    /// One tick: time moves on, the measurement (if any) is used, the present is predicted.
    pub(crate) fn step(&self, state: &mut EstimatorState, fix: Option<Fix>) -> Estimate {
        state.lag = state.lag.saturating_add(1);
        state.ticks_since_fix = state.ticks_since_fix.saturating_add(1);
        state.released_ticks = state.released_ticks.saturating_sub(1);
        state.stepped_ticks = state.stepped_ticks.saturating_sub(1);
        let was_stuck = state.stuck;
        let mut innovation_um = 0.0;
        let (mut used, mut fresh, mut gated) = (false, false, false);
        match fix {
            Some(fix) if fix.age <= usize::from(state.lag) && fix.age <= self.longest_lag => {
                let steps = usize::from(state.lag) - fix.age;
                let motion_um: f64 = (0..steps).map(|_| self.advance_filter(state)).sum();
                let (accepted, innovation) = self.update(state, &fix, motion_um);
                innovation_um = innovation;
                gated = !accepted;
                used = accepted;
                fresh = accepted && fix.age == 0;
            }
            _ => {
                while usize::from(state.lag) > self.longest_lag {
                    self.advance_filter(state);
                }
            }
        }
        if used {
            state.ticks_since_fix = 0;
        }
        if was_stuck && !state.stuck {
            state.released_ticks = RELEASED_TICKS;
        }
        let mut m = self.filter_state(state);
        let mut predicted = m;
        let back = self.delay_ticks + usize::from(state.lag);
        for ticks_ago in (1..=back).rev() {
            if ticks_ago == self.delay_ticks {
                predicted = m;
            }
            let command = Self::command(state, ticks_ago);
            if !state.stuck {
                m = self.tick.advance(&m, command);
            }
        }
        if self.delay_ticks == 0 {
            predicted = m;
        }
        let predicted = self.at_measurement(
            &predicted,
            Self::command(state, self.delay_ticks),
            state.stuck,
        );
        Estimate {
            position_um: self.position(&m),
            position_sd_um: self.present_sd_um(state, back),
            neutral_um: state.neutral_um,
            predicted_measurement_um: self.position(&predicted),
            innovation_um,
            fresh,
            coasting: !used,
            gated,
            stepped: state.stepped_ticks > 0,
            seen: state.seen,
            stuck: state.stuck,
            authority_um: self.authority_um(state),
            now: m,
        }
    }

    /// Uses a fix at the filter's time. Returns whether it was accepted, and the innovation.
    fn update(&self, state: &mut EstimatorState, fix: &Fix, motion_um: f64) -> (bool, f64) {
        let from = self.filter_state(state);
        let part = self.part_of(fix);
        // An exposure before the filter's time lies in the tick of the command before.
        let back = self.delay_ticks + usize::from(state.lag);
        let command = Self::command(state, if part.fraction < 0.0 { back + 1 } else { back });
        let at = if part.fraction == 0.0 || state.stuck {
            from
        } else {
            part.advance(&from, command)
        };
        let predicted = self.position(&at) + self.exposed_um(state, part.fraction, back);
        let innovation = fix.position_um - predicted;
        if !state.seen {
            self.place(state, innovation, fix.variance_um2);
            return (true, 0.0);
        }
        let [p11, p12, p22] = state.covariance_um2;
        let h = -part.gain;
        let (ph1, ph2) = (p11 + h * p12, p12 + h * p22);
        // Between the filter's time and that of the exposure the bead went its Brownian way, which no command tells.
        let apart_s = fix.offset.abs() * self.model.sample_time_s;
        let walk_um2 = 2.0 * self.config.diffusion_um2_per_s * apart_s;
        let spread = ph1 + h * ph2 + walk_um2 + fix.variance_um2;
        // A stuck bead that comes free may move far in a frame.
        let widest = if state.stuck { 10.0 } else { 1.0 };
        let floor_um = self.config.gate_floor_um + GATE_LAG_TICKS * self.fastest_motion(state);
        let gate = widest * (self.config.gate_sigma * spread.sqrt()).max(floor_um);
        let beyond = innovation.abs() > gate;
        if beyond {
            state.gated = state.gated.saturating_add(1);
            if state.gated <= self.config.gate_most {
                return (false, innovation);
            }
            state.stuck_evidence = 0.0;
            state.stuck = false;
        }
        state.gated = 0;
        if let Some(step) = self.flow_step(state, [innovation, motion_um], spread, fix) {
            let left_um = self.grant_step(state, &step, h, innovation);
            self.correct(state, h, left_um, walk_um2, fix.variance_um2);
            return (true, innovation);
        }
        if beyond {
            self.place(state, innovation, fix.variance_um2);
            return (true, innovation);
        }
        let was_stuck = state.stuck;
        self.weigh_stuck(state, innovation, motion_um, fix);
        if state.stuck {
            // The position is a constant to be averaged; it says nothing of neutral while something holds the bead.
            if was_stuck {
                state.integrator_um += STUCK_AVERAGE * innovation;
            } else {
                state.integrator_um = fix.position_um;
            }
            state.modes = [0.0; MODES];
            state.covariance_um2 = [fix.variance_um2, 0.0, p22];
            state.stated_um2 = [fix.variance_um2, 0.0, state.stated_um2[2]];
            return (true, innovation);
        }
        if was_stuck {
            self.place(state, innovation, fix.variance_um2);
            state.doubt_neutral();
            return (true, innovation);
        }
        self.correct(state, h, innovation, walk_um2, fix.variance_um2);
        (true, innovation)
    }

    /// Takes the position from the fix alone, keeping neutral.
    fn place(&self, state: &mut EstimatorState, innovation_um: f64, variance_um2: f64) {
        state.integrator_um += innovation_um;
        for covariance_um2 in [&mut state.covariance_um2, &mut state.stated_um2] {
            (covariance_um2[0], covariance_um2[1]) = (variance_um2, 0.0);
        }
        state.recent.forget();
        state.gated = 0;
        state.seen = true;
    }

    /// Whole ticks of delay, rounded up.
    pub(crate) fn delay_ticks(&self) -> usize {
        self.delay_ticks
    }

    /// The state one tick later.
    pub(crate) fn tick_state(&self, m: &PredictedState, command_um: f64) -> PredictedState {
        self.tick.advance(m, command_um)
    }

    /// The position that a measurement made at the filter's time `m` shows, um; `command_um` is in force after `m`.
    pub(crate) fn position_measured(&self, m: &PredictedState, command_um: f64) -> f64 {
        self.position(&self.at_measurement(m, command_um, false))
    }

    /// Change of a measurement per change of neutral, um/um.
    pub(crate) fn neutral_sensitivity(&self) -> f64 {
        -self.part.gain
    }

    /// Hands the command of this tick to the history.
    pub(crate) fn push(&self, state: &mut EstimatorState, command_um: f64) {
        state.history_um.copy_within(0..HISTORY - 1, 1);
        state.history_um[0] = command_um;
    }
}
