//! The estimate of the plant's gain and delay while the loop runs, and the tuning that follows it.
//!
//! In a closed loop the command answers the disturbance. Fixes and commands alone cannot tell a disturbance of the right colour from a
//! change of the gain. So the loop always moves the bead a little, at random ([`dither`]). The part of the fixes that correlates with
//! this motion gives the plant's gain, whatever the disturbance. The dither is an instrument in the sense of instrumental variables,
//! and so is a reference. The regression is in [`evidence`]. A model driven by the commands gives its inputs ([`motion`]). One filter
//! whitens all series: it makes white noise of Brownian motion, drift and localisation noise ([`whiten`]).
//!
//! **In force.** See [`retuning`]. The law is not designed again. A plant with `g` times the gain is the plant of the design if
//! displacements are counted in units of `1/g`. Estimator, feedback, feed-forward and the plan of MPC stay those of the design, in other
//! units. For each delay there is an estimator; the gains of PI change with it.

mod belief;
mod colour;
mod dither;
mod evidence;
mod learn;
mod lines;
mod motion;
mod retuning;
mod whiten;
mod zero_flow;

use crate::design::bound_rms_um;
use crate::error::BuildError;
use crate::estimator::{Estimator, EstimatorConfig, EstimatorState, Fix, PredictedState};
use crate::exposure::mean;
use crate::feedforward::{FeedForward, FeedForwardState};
use crate::loop_model::LoopModel;
use crate::tuning::Tuning;
use colour::Colour;
use dither::Dither;
use evidence::Evidence;
use lines::{LineSettings, Lines};
use motion::{Alignment, BLOCK, Frame, Motion};
pub use retuning::{AdaptMode, AdaptNews};
use retuning::{DELAYS, INTERVAL, NOMINAL, REPORTED_GAIN, Retuning, TUNINGS};
use serde::Serialize;
use whiten::{Covariance, Track, Whitener};
use zero_flow::{ZeroFlow, ZeroFlowState};

/// Names of the columns that adaptation adds to a law's own in the record.
pub const ADAPT_COLUMNS: [&str; 6] = [
    "adapt_gain",
    "adapt_delay_samples",
    "adapt_gain_estimate",
    "adapt_gain_sd",
    "adapt_mode",
    "adapt_dither_um",
];

/// Largest factor by which the dither is louder where the gain is not known: it costs four times as much then. A gain is known whose
/// interval is no wider than the least change that is reported; in a quiet hold at 1 kHz it comes to that.
const LOUDEST: f64 = 2.0;
const KNOWN: f64 = 0.5 * REPORTED_GAIN / INTERVAL;

/// A flow that moves the bead to and fro at one frequency.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PeriodicFlow {
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// Amplitude of the motion of a bead that nothing holds, um.
    pub amplitude_um: f64,
}

fn those_that_are<S: serde::Serializer>(
    flows: &[Option<PeriodicFlow>],
    to: S,
) -> Result<S::Ok, S::Error> {
    to.collect_seq(flows.iter().flatten())
}

/// Where adaptation stands.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Adaptation {
    /// Gain in force, over the design's.
    pub gain: f64,
    /// Delay in force beyond the design's, samples.
    pub delay_samples: f64,
    /// Estimated gain over the model's, and its standard uncertainty; `None` before there was motion enough.
    pub gain_estimate: Option<[f64; 2]>,
    /// Estimated delay beyond the design's and its standard uncertainty, samples.
    pub delay_estimate_samples: Option<[f64; 2]>,
    /// Where the tuning stands.
    pub mode: AdaptMode,
    /// Periodic flows that the command cancels.
    #[serde(serialize_with = "those_that_are")]
    pub periodic_flows: [Option<PeriodicFlow>; lines::MOST],
    /// Walk of the zero flow, um/sqrt(s); `None` while it is less than twice what the design assumes.
    pub zero_flow_walk_um_per_sqrt_s: Option<f64>,
    /// A change that this tick reports.
    #[serde(skip)]
    pub news: Option<AdaptNews>,
}

/// The estimate of the plant for one model. Immutable; the state is apart and `Copy`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Adapter {
    estimators: [Option<Estimator>; TUNINGS],
    nominal: Estimator,
    whitener: Whitener,
    zero_flow: ZeroFlow,
    /// Whole and fractional samples of the design's delay.
    delay_samples: f64,
    /// Time in which the speed moves the bead as far as the jump does, ticks.
    jump: f64,
    sample_s: f64,
    /// Ticks from one fix to the next, and those in a row that may be without one.
    interval: f64,
    planned_gap: u32,
    exposure_ticks: f64,
    lines: LineSettings,
    forward: FeedForward,
    /// Command for a tick that moves the bead from the middle to a side of the dither, um.
    side_um: f64,
    /// Ticks that this takes, and fixes of a block of evidence.
    move_ticks: u32,
    block: u32,
}

/// State of the estimate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AdaptState {
    /// The model, driven with all commands, and with those that were chosen.
    model: Motion,
    instrument: Motion,
    /// `None` before the series began.
    aligned: Option<Alignment>,
    dither: Dither,
    seen: Option<Track>,
    /// Of the filter of all series, and ticks since the exposure of the last fix that it took.
    covariance: Covariance,
    since_fix: f64,
    /// Ticks in a row without a fix.
    silent: u32,
    evidence: Evidence,
    colour: Colour,
    zero_flow: ZeroFlowState,
    now: learn::Now,
    lines: Lines,
    /// Time by which this tick came later than the ticks before it say, ticks. Lines go on evenly, and so does a camera; a tick does not.
    late: f64,
    /// The model on the path that cancels the lines, its way in this tick, and the command for that, um; `None` while the loop does not
    /// control the bead.
    inverse: Option<FeedForwardState>,
    way_um: f64,
    cancel_um: f64,
    /// The last of these commands, um; the model, driven with them, and its positions in the filter.
    cancelled_um: f64,
    cancelled: Motion,
    cancelled_seen: Track,
    force: Retuning,
    news: Option<AdaptNews>,
}

impl AdaptState {
    /// A gain over the model's that was measured otherwise, with its standard deviation. If it is surely larger than the one in force,
    /// the law is as cautious at once. Its next command, that to the target, may be the largest of the run.
    pub(crate) fn tell(&mut self, gain: f64, sd: f64) {
        self.evidence.tell(gain, sd);
        self.force.caution(gain, sd);
    }
}

/// A tick as the estimate sees it.
pub(crate) struct TickOutcome {
    /// The fix that came, whether or not it was used.
    pub fix: Option<Fix>,
    /// Command that takes effect now, um of PZT.
    pub command_um: f64,
    /// Part of the command that does not depend on the fixes, without the dither, um of PZT.
    pub chosen_um: f64,
    /// Part of the command that cancels the lines in the flow, um of PZT.
    pub cancel_um: f64,
    /// The law decides, and nothing holds the bead.
    pub free: bool,
    /// The flow has just stepped: the fixes tell nothing of the plant.
    pub stepped: bool,
}

impl Adapter {
    /// For a model and the noise of its estimator.
    ///
    /// # Errors
    /// As [`Estimator::new`].
    pub(crate) fn new(config: EstimatorConfig, model: LoopModel) -> Result<Self, BuildError> {
        let ts = model.sample_time_s;
        let move_ticks = dither::move_ticks(ts);
        let zero_flow = ZeroFlow::new(&config, &model)?;
        let hold_um = bound_rms_um(config.diffusion_um2_per_s, 0.0, model.delay_s, ts);
        // Where a lag keeps the plant from moving at once it still gets there, and where it moves at once it may not stay.
        let moves = model.gain_per_s.abs().max(model.fast_gain_per_s().abs()) * ts;
        let jump = model.feedthrough * model.gain_per_s.signum() / moves;
        Ok(Self {
            // Independent of the rest of the error, so that the squares add.
            side_um: (0.02 * config.dither_percent).sqrt() * hold_um / moves,
            move_ticks,
            block: BLOCK * (f64::from(move_ticks) / config.ticks_per_fix).max(1.0) as u32,
            estimators: DELAYS.map(|extra| delayed(config, model, extra)),
            nominal: Estimator::new(config, model)?,
            whitener: zero_flow.of_design(),
            zero_flow,
            lines: LineSettings::new(ts, config.ticks_per_fix, jump),
            forward: FeedForward::new(&model)?,
            delay_samples: model.delay_samples(),
            jump,
            sample_s: ts,
            interval: config.ticks_per_fix,
            planned_gap: config.planned_gap(),
            exposure_ticks: config.exposure_ms * 1e-3 / ts,
        })
    }

    /// Nothing known, the design in force, everything at rest at a command, um.
    pub(crate) fn start(&self, command_um: f64) -> AdaptState {
        AdaptState {
            model: Motion::start(command_um),
            instrument: Motion::start(0.0),
            aligned: None,
            dither: Dither::new(),
            seen: None,
            covariance: self.whitener.settled(),
            since_fix: 0.0,
            silent: 0,
            evidence: Evidence::new(-self.delay_samples, self.whitener.noise_um2),
            colour: Colour::new(self.whitener.noise_um2),
            zero_flow: self.zero_flow.start(),
            now: learn::Now::default(),
            lines: Lines::new(),
            late: 0.0,
            inverse: None,
            way_um: 0.0,
            cancel_um: 0.0,
            cancelled_um: 0.0,
            cancelled: Motion::start(0.0),
            cancelled_seen: Track::default(),
            force: Retuning::default(),
            news: None,
        }
    }

    fn usable(&self) -> [bool; TUNINGS] {
        self.estimators.map(|one| one.is_some())
    }

    /// The estimator of the delay in force.
    pub(crate) fn estimator(&self, state: &AdaptState) -> &Estimator {
        self.estimators
            .get(state.force.member)
            .and_then(Option::as_ref)
            .unwrap_or(&self.nominal)
    }

    /// The tuning in force.
    pub(crate) fn tuning(&self, state: &AdaptState) -> Tuning {
        let design = self.delay_samples + 0.5;
        Tuning {
            gain: state.force.log_gain.exp(),
            delay: (design + DELAYS[state.force.member]) / design,
        }
    }

    /// Tells the estimator what it does not learn itself: how well the gain is known, as a part of `stated`, and how fast the zero flow walks.
    pub(crate) fn inform(&self, state: &AdaptState, stated: f64, estimator: &mut EstimatorState) {
        estimator.gain_doubt = self.gain_doubt(state, stated);
        estimator.beyond_walk_um2_per_s = state.zero_flow.beyond_um2_per_s;
    }

    /// Uncertainty of the gain in force as a part of `stated`: two standard deviations of the estimate, plus its distance from the gain in
    /// force. 1 before the gain was measured.
    fn gain_doubt(&self, state: &AdaptState, stated: f64) -> f64 {
        let sure = state.force.mode != AdaptMode::Learning;
        let Some(found) = state
            .evidence
            .found
            .filter(|found| sure && found.gain > 0.0)
        else {
            return 1.0;
        };
        let off = (found.log_gain - state.force.log_gain).abs();
        ((off + 2.0 * found.log_sd) / stated.max(1e-3)).min(1.0)
    }

    /// What is to be added to the command of this tick, um.
    pub(crate) fn dither_um(&self, state: &AdaptState) -> f64 {
        state.dither.command_um
    }

    /// Part of the command of this tick that cancels the lines, um.
    pub(crate) fn cancel_um(&self, state: &AdaptState) -> f64 {
        state.cancel_um
    }

    /// State of the model that the dither made, in the units of the law: the loop is not to undo it.
    pub(crate) fn dithered(&self, state: &AdaptState) -> PredictedState {
        let gain = state.force.log_gain.exp();
        let at = state.dither.state();
        PredictedState {
            q: gain * at.q,
            n: 0.0,
            modes: at.modes.map(|x| gain * x),
            last_um: gain * at.last_um,
        }
    }

    /// How far the dither moved the bead at the time of a fix, or of one that would come now, um.
    pub(crate) fn dither_seen_um(&self, state: &AdaptState, fix: Option<&Fix>) -> f64 {
        let shown_ago = self.shown_ago(state, fix.map_or(0.0, age_ticks) - state.late);
        let seen = state.dither.motion.seen(shown_ago, self.exposure_ticks);
        state.force.log_gain.exp() * seen.unwrap_or(0.0)
    }

    /// A fix without what the lines do between the ticks, where a held command does not cancel them: no law can.
    pub(crate) fn without_lines(&self, state: &AdaptState, fix: Fix) -> Fix {
        if state.inverse.is_none() {
            return fix;
        }
        let shown_ago = self.shown_ago(state, age_ticks(&fix) - state.late);
        let left = |ago| Some(state.lines.left_um(&self.lines, ago));
        let left_um = mean(shown_ago, self.exposure_ticks, left).unwrap_or(0.0);
        Fix {
            position_um: fix.position_um - state.force.log_gain.exp() * left_um,
            ..fix
        }
    }

    /// Age of the command's motion that a fix of this age shows with the delay in force, ticks.
    fn shown_ago(&self, state: &AdaptState, age: f64) -> f64 {
        self.delay_samples + DELAYS[state.force.member] + age
    }

    /// What the frames show of the lags, as they are aligned.
    fn frame(&self, aligned: &Alignment) -> Frame {
        Frame {
            first: aligned.first(self.delay_samples),
            jump: self.jump,
            exposure: aligned.spread(self.exposure_ticks),
        }
    }

    /// Where it stands.
    pub(crate) fn adaptation(&self, state: &AdaptState) -> Adaptation {
        let found = state.evidence.found;
        let gain = state.force.log_gain.exp();
        Adaptation {
            gain,
            delay_samples: DELAYS[state.force.member],
            gain_estimate: found.map(|f| [f.gain, f.gain_sd]),
            delay_estimate_samples: found.map(|f| [f.delay, f.delay_sd]),
            mode: state.force.mode,
            periodic_flows: (state.lines.cancelled(&self.lines)).map(|line| {
                line.map(|[frequency_hz, amplitude_um]| PeriodicFlow {
                    frequency_hz,
                    amplitude_um: gain * amplitude_um,
                })
            }),
            zero_flow_walk_um_per_sqrt_s: (self.zero_flow.faster(&state.zero_flow))
                .map(|walk| walk / gain),
            news: state.news.map(|news| news.in_ticks(self.interval)),
        }
    }

    /// After the command of a tick: learns from the fix, and moves the tuning where it may. The tuning that it leaves is that
    /// of the next tick.
    pub(crate) fn step(&self, state: &mut AdaptState, tick: &TickOutcome) {
        state.news = None;
        let learns = tick.free && !tick.stepped;
        let learned = self.learn(state, tick.fix.filter(|_| learns));
        let rest_um = tick.command_um - tick.cancel_um;
        let finite = self.drive(state, rest_um, tick.chosen_um)
            && self.drive_cancelled(state, tick.cancel_um);
        state.lines.tick(&self.lines);
        self.hold_against_lines(state, tick.free);
        if !learns {
            state.force.wait();
        }
        if !tick.free {
            state.dither.rest();
        }
        if !finite {
            let force = state.force;
            *state = self.start(tick.command_um);
            state.force = force;
        }
        if learned {
            let found = state.evidence.found;
            state.force.follow(found.as_ref(), &self.usable());
            state.news = state.force.news(found.as_ref());
        } else if state.silent > self.planned_gap {
            state.force.wait();
        }
    }

    /// A tick that never came: the command was held.
    pub(crate) fn skip(&self, state: &mut AdaptState, command_um: f64) {
        state.news = None;
        self.learn(state, None);
        // The command that cancels the lines should have changed; the difference moves the bead.
        self.begin(state, state.late);
        let rest_um = command_um - state.cancel_um;
        let finite = state.model.drive(&self.nominal, rest_um)
            && (state.instrument).drive(&self.nominal, state.dither.given_um)
            && state.dither.hold(&self.nominal)
            && self.drive_cancelled(state, state.cancel_um);
        state.lines.tick(&self.lines);
        if !finite {
            *state = self.start(command_um);
        }
    }

    /// At the start of a tick that is `late` by so many ticks: the command that moves the model opposite to the lines until one tick later.
    ///
    /// The last command was to have done so until one tick after the last tick. If this one is not then, it was in force for longer or
    /// less long. What a new estimate of the lines corrects moves nothing: the law has brought the bead to its reference, wherever it
    /// stands on its way.
    pub(crate) fn begin(&self, state: &mut AdaptState, late: f64) {
        let late = if late.is_finite() { late } else { 0.0 };
        let later = late - state.late;
        state.cancel_um = 0.0;
        if let Some(model) = &mut state.inverse {
            let lines = &state.lines;
            state.way_um = lines.end_um(&self.lines, state.late)
                - lines.end_um(&self.lines, late + 1.0)
                - later * state.way_um;
            let next_um = self.forward.position(model) + state.way_um;
            state.cancel_um = self.forward.step(model, next_um);
        }
        state.late = late;
    }

    /// The model one even tick on with what cancels the lines. The command before it was in force for longer by as much as this tick is late,
    /// so their mean moves the bead as far. Whether all is finite.
    fn drive_cancelled(&self, state: &mut AdaptState, command_um: f64) -> bool {
        let mean_um = command_um - state.late * (command_um - state.cancelled_um);
        state.cancelled_um = command_um;
        state.cancelled.drive(&self.nominal, mean_um)
    }

    /// Whether the lines are cancelled from the next tick on: while the loop controls the bead.
    fn hold_against_lines(&self, state: &mut AdaptState, free: bool) {
        if free {
            state.inverse.get_or_insert(FeedForward::rest(0.0));
        } else {
            (state.inverse, state.way_um) = (None, 0.0);
        }
    }

    /// The models one tick on. Whether all is finite.
    fn drive(&self, state: &mut AdaptState, command_um: f64, chosen_um: f64) -> bool {
        let chosen_um = chosen_um + state.dither.command_um;
        let louder = (state.evidence.found).map_or(LOUDEST, |found| found.log_sd / KNOWN);
        let side_um = self.side_um * louder.clamp(1.0, LOUDEST) * (-state.force.log_gain).exp();
        let dithered = state.dither.tick(&self.nominal, side_um, self.move_ticks);
        let instrument = state.instrument.drive(&self.nominal, chosen_um);
        state.model.drive(&self.nominal, command_um) && dithered && instrument
    }

    /// The values of [`ADAPT_COLUMNS`].
    pub(crate) fn record(&self, state: &AdaptState, out: &mut [f32]) {
        let now = self.adaptation(state);
        let [gain, sd] = now.gain_estimate.unwrap_or([f64::NAN; 2]);
        let values = [now.gain, now.delay_samples, gain, sd];
        for (out, value) in out.iter_mut().zip(values) {
            *out = value as f32;
        }
        if let Some(out) = out.get_mut(values.len()) {
            *out = f32::from(now.mode as u8);
        }
        if let Some(out) = out.get_mut(values.len() + 1) {
            *out = state.dither.given_um as f32;
        }
    }
}

/// The estimator for `extra` more samples of delay; `None` if the delay would be negative.
fn delayed(config: EstimatorConfig, model: LoopModel, extra: f64) -> Option<Estimator> {
    let delay_s = model.delay_s + extra * model.sample_time_s;
    if delay_s < -1e-9 {
        return None;
    }
    Estimator::new(config, LoopModel { delay_s, ..model }).ok()
}

/// Time from the exposure of a fix to the tick, ticks.
fn age_ticks(fix: &Fix) -> f64 {
    fix.age as f64 + fix.offset
}

// The nominal delay is the design's.
const _: () = assert!(DELAYS[NOMINAL] == 0.0);
