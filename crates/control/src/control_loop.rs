//! One tick of the loop: estimate, control law, limits.

use crate::error::BuildError;
use crate::estimator::{Estimate, Estimator, EstimatorState, Fix};
use crate::feedforward::FeedForwardState;
use crate::law::{ControlLaw, FAR_UM, LawInput, LawOutput};
use crate::learning::Driven;
use crate::limits::Limits;
use crate::loop_io::{LoopFlags, LoopInput, LoopOutput, LoopParts, Measurement, Mode};
use crate::path::{Path, PathState};
use crate::plant_estimate::{AdaptState, Adaptation, Adapter, TickOutcome};
use crate::tuning::Tuning;
use cellpos_numeric::statistics::student_t_quantile;

/// State of a loop whose law has the state `S`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LoopState<S> {
    /// Estimator.
    pub estimator: EstimatorState,
    /// Control law.
    pub law: S,
    /// Command of the previous tick, um.
    pub previous_um: f64,
    /// Learned part of it, which the estimator does not see, um.
    pub hidden_um: f64,
    /// Feed-forward of the previous tick, um from neutral in the units of the law.
    pub forward_um: f64,
    /// Path of the reference.
    pub path: PathState,
    /// Estimate of the plant and the tuning in force, where the loop adapts.
    pub adapt: Option<AdaptState>,
    /// Gain over the model's that divides the feed-forward, if the loop does not adapt and the gain was measured before.
    pub measured_gain: Option<f64>,
}

/// Estimator, control law and limits. Immutable; the state is apart.
///
/// ```
/// use cellpos_control::*;
/// let model = LoopModel::eq6(2e-3);
/// let control = ControlLoop::new(LoopParts {
///     model,
///     estimator: EstimatorConfig::default(),
///     controller: PiLaw::new(Pi::new(0.46, 19.5), model.sample_time_s)?,
///     limits: Limits::default(),
/// })?;
/// let mut state = control.start(20.0, 20.0);
/// let fix = Measurement { position_um: 1.0, variance_um2: 4e-4, age_samples: 0, offset_samples: 0.0 };
/// let out = control.step(&mut state, &LoopInput { measurement: Some(fix), ..LoopInput::default() });
/// assert!(out.command_um < 20.0, "the bead is beyond the reference: pull");
/// # Ok::<(), BuildError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ControlLoop<L> {
    parts: LoopParts<L>,
    path: Path,
    estimator: Estimator,
    adapter: Option<Adapter>,
}

/// A tick between estimate and command.
struct Tick<'a> {
    law: LawInput<'a>,
    /// The law decides; otherwise the mode does.
    controls: bool,
    /// The fix that came.
    fix: Option<Fix>,
    /// The measurement or the reference was not a number that a position can be.
    not_finite: bool,
}

impl<L: ControlLaw> ControlLoop<L> {
    /// Builds a loop.
    ///
    /// # Errors
    /// [`BuildError`] naming the parameter.
    pub fn new(parts: LoopParts<L>) -> Result<Self, BuildError> {
        parts.limits.validate()?;
        let (config, model) = (parts.estimator, parts.model);
        let adapter = (config.adapts())
            .then(|| Adapter::new(config, model))
            .transpose()?;
        Ok(Self {
            estimator: Estimator::new(config, model)?,
            path: Path::new(&model, &parts.limits)?,
            adapter,
            parts,
        })
    }

    /// What it was built from.
    pub fn parts(&self) -> &LoopParts<L> {
        &self.parts
    }

    /// Its estimator.
    pub fn estimator(&self) -> &Estimator {
        &self.estimator
    }

    /// A state at rest at a command, with a first value of neutral (both um). If no actuator reaches that neutral, it is the command.
    pub fn start(&self, command_um: f64, neutral_um: f64) -> LoopState<L::State> {
        let command = self.parts.limits.nearest(command_um);
        let neutral = if neutral_um.abs() <= FAR_UM {
            neutral_um
        } else {
            command
        };
        LoopState {
            estimator: self.estimator.start(command, neutral),
            law: self.parts.controller.start(command),
            previous_um: command,
            hidden_um: 0.0,
            forward_um: 0.0,
            path: PathState::default(),
            adapt: self.adapter.map(|adapter| adapter.start(command)),
            measured_gain: None,
        }
    }

    /// What is known of the plant, and the tuning in force; `None` where the loop does not adapt.
    pub fn adaptation(&self, state: &LoopState<L::State>) -> Option<Adaptation> {
        let adapter = self.adapter.as_ref()?;
        Some(adapter.adaptation(state.adapt.as_ref()?))
    }

    /// The gain over the model's was measured before the loop is closed, with a standard deviation of `dof` degrees of freedom: the estimate
    /// begins there. The feed-forward of a loop that does not adapt is divided by the gain in the 95 % interval nearest to the model's.
    pub fn start_estimate(&self, state: &mut LoopState<L::State>, gain: f64, sd: f64, dof: f64) {
        if !(gain.is_finite() && sd > 0.0 && dof >= 1.0) {
            return;
        }
        if state.adapt.is_none() {
            let half = sd * student_t_quantile(0.975, dof);
            state.measured_gain = (gain > half).then(|| 1.0_f64.clamp(gain - half, gain + half));
        } else if dof > 2.0 {
            // A normal distribution with the variance of Student's; with two degrees of freedom or fewer that is infinite.
            let sd = sd * (dof / (dof - 2.0)).sqrt();
            self.change_estimate(state, |_, adapt| adapt.tell(gain, sd));
        }
    }

    /// Displacement at which the bead rests, um of PZT.
    pub fn neutral_um(&self, state: &LoopState<L::State>) -> f64 {
        state.estimator.neutral_um / self.tuning(state).gain
    }

    /// Variance of that if the zero flow walks as fast as the estimator is made for, um^2.
    pub fn neutral_variance_um2(&self, state: &LoopState<L::State>) -> f64 {
        state.estimator.covariance_um2[2] / self.tuning(state).gain.powi(2)
    }

    /// The columns of adaptation after a tick.
    pub(crate) fn record_adaptation(&self, state: &LoopState<L::State>, out: &mut [f32]) {
        if let (Some(adapter), Some(adapt)) = (&self.adapter, &state.adapt) {
            adapter.record(adapt, out);
        }
    }

    fn tuning(&self, state: &LoopState<L::State>) -> Tuning {
        match (&self.adapter, &state.adapt) {
            (Some(adapter), Some(adapt)) => adapter.tuning(adapt),
            _ => Tuning::default(),
        }
    }

    /// The estimator of the delay in force.
    fn estimator_of(&self, state: &LoopState<L::State>) -> &Estimator {
        match (&self.adapter, &state.adapt) {
            (Some(adapter), Some(adapt)) => adapter.estimator(adapt),
            _ => &self.estimator,
        }
    }

    /// Changes the estimate of the plant. Where the tuning changes, estimated position and command stay continuous.
    fn change_estimate(
        &self,
        state: &mut LoopState<L::State>,
        change: impl FnOnce(&Adapter, &mut AdaptState),
    ) {
        let (before, from) = (self.tuning(state), self.estimator_of(state));
        let (Some(adapter), Some(adapt)) = (&self.adapter, &mut state.adapt) else {
            return;
        };
        change(adapter, adapt);
        let (now, to) = (adapter.tuning(adapt), adapter.estimator(adapt));
        let stated = self.parts.estimator.gain_uncertainty;
        adapter.inform(adapt, stated, &mut state.estimator);
        if from.model() != to.model() {
            from.retime(&mut state.estimator, to);
        }
        let ratio = now.gain / before.gain;
        if ratio != 1.0 {
            to.rescale(&mut state.estimator, ratio);
            self.parts.controller.rescale(&mut state.law, ratio);
        }
    }

    fn fix(&self, measurement: &Measurement) -> Option<Fix> {
        let Measurement {
            position_um,
            variance_um2,
            age_samples,
            offset_samples,
        } = *measurement;
        let stated = variance_um2.is_finite() && variance_um2 > 0.0;
        let assumed = self.parts.estimator.fix_noise_um.powi(2);
        (position_um.abs() < FAR_UM).then_some(Fix {
            position_um,
            variance_um2: if stated {
                variance_um2.clamp(1e-8, 1e6)
            } else {
                assumed
            },
            age: usize::from(age_samples),
            offset: (Some(offset_samples).filter(|part| part.abs() <= 0.5)).unwrap_or(0.0),
        })
    }

    /// One tick.
    pub fn step(&self, state: &mut LoopState<L::State>, input: &LoopInput) -> LoopOutput {
        let law = &self.parts.controller;
        let stood_um = self.take_in_force(state, input);
        self.shift(state, input.zero_flow_shift_um);
        let tick = self.estimate(state, input);
        let gain = tick.law.tuning.gain;
        let mut decided = if tick.controls {
            law.step(&mut state.law, &tick.law)
        } else {
            LawOutput::wish(match input.mode {
                Mode::Park => self.parts.limits.park_um * gain,
                Mode::Direct(displacement_um) => displacement_um * gain,
                Mode::Run | Mode::Freeze => tick.law.estimate.neutral_um,
            })
        };
        let driven = driven(input, &tick, state.measured_gain);
        // What the law asks for on its own.
        let own_um = decided.wish_um;
        decided.wish_um += driven.feed_forward_um;
        // The part that cancels a line in the flow is hidden from the estimator like the learned part: the bead shows neither.
        let (cancel_um, dither_um) = match (&self.adapter, &state.adapt) {
            (Some(adapter), Some(adapt)) if tick.controls => {
                (adapter.cancel_um(adapt), adapter.dither_um(adapt))
            }
            _ => (0.0, 0.0),
        };
        let (excitation_um, learned_um) = if tick.controls {
            // What a feed-forward divided by another gain is more than the law's own.
            let over = 1.0 / driven.feed_forward_gain - 1.0 / gain;
            let learned_um = input.learned_um + over * driven.feed_forward_um + cancel_um;
            let usable = learned_um.is_finite();
            (input.excitation_um, if usable { learned_um } else { 0.0 })
        } else {
            (0.0, 0.0)
        };
        let added_um = excitation_um + dither_um + learned_um;
        let mut output = self.limit(state, input, &tick, &decided, added_um);
        let change_um = driven.feed_forward_um - state.forward_um;
        state.forward_um = driven.feed_forward_um;
        let limited = output.flags.range_limited || output.flags.slew_limited;
        output.dither_um = if limited { 0.0 } else { dither_um };
        output.cancel_um = cancel_um;
        output.driven = Driven {
            jump_um: self.parts.model.feedthrough * change_um,
            limited,
            ..driven
        };
        if tick.controls {
            // The excitation is no saturation: an integrator must not be pulled along with it.
            // Nor does what never reached the actuator wind it up.
            let stood_um = stood_um.unwrap_or(output.command_um - added_um) * gain;
            let applied_um = stood_um - driven.feed_forward_um;
            law.applied(&mut state.law, &tick.law, own_um, applied_um);
        } else {
            law.follow(&mut state.law, &tick.law, output.command_um * gain);
        }
        // What is learned makes the bead follow the reference as the model does, so the estimator is not told of it.
        self.estimator.push(
            &mut state.estimator,
            (output.command_um - learned_um) * gain,
        );
        state.previous_um = output.command_um;
        state.hidden_um = learned_um;
        if state.adapt.is_some() {
            let estimate = &tick.law.estimate;
            let told = TickOutcome {
                fix: tick.fix,
                command_um: output.command_um,
                chosen_um: if tick.controls {
                    input.excitation_um + driven.feed_forward_um / gain
                } else {
                    0.0
                },
                cancel_um,
                free: tick.controls && !estimate.stuck && !output.flags.not_finite,
                stepped: estimate.stepped,
            };
            self.change_estimate(state, |adapter, adapt| adapter.step(adapt, &told));
        }
        output
    }

    /// Takes in a known move of the zero flow. The plant depends on the distance of the PZT from it at each time, so the past commands shift
    /// along. The command itself does not: the slew limit counts from the PZT's displacement.
    fn shift(&self, state: &mut LoopState<L::State>, by_um: f64) {
        if by_um == 0.0 || !by_um.is_finite() {
            return;
        }
        let scaled_um = by_um * self.tuning(state).gain;
        state.estimator.neutral_um += scaled_um;
        let history = state.estimator.history_um.iter_mut();
        history.for_each(|um| *um += scaled_um);
        self.parts.controller.shift(&mut state.law, scaled_um);
    }

    /// Replaces the commands that did not reach the actuator by the displacement that it had. Returns it, um.
    fn take_in_force(&self, state: &mut LoopState<L::State>, input: &LoopInput) -> Option<f64> {
        let stood = input
            .in_force
            .filter(|stood| stood.displacement_um.is_finite())?;
        let scaled_um = stood.displacement_um * self.tuning(state).gain;
        let (before_um, before_ticks) = stood.before;
        let before_um = before_um * self.tuning(state).gain;
        let mut history = state.estimator.history_um.iter_mut();
        (history.by_ref().take(stood.ticks)).for_each(|um| *um = scaled_um);
        history.take(before_ticks).for_each(|um| *um = before_um);
        state.previous_um = stood.displacement_um;
        state.hidden_um = 0.0;
        Some(stood.displacement_um)
    }

    /// A skipped tick: the command was held and the bead moved on. The estimator follows. Integrator and feed-forward are kept, so that a
    /// step in progress continues.
    pub fn skip(&self, state: &mut LoopState<L::State>) {
        self.estimator_of(state).step(&mut state.estimator, None);
        // What the estimator was told of the command; a learned part of it is held as well.
        let held_um = state.estimator.history_um[0];
        self.estimator.push(&mut state.estimator, held_um);
        self.parts.controller.skip(&mut state.law);
        if let (Some(adapter), Some(adapt)) = (&self.adapter, &mut state.adapt) {
            adapter.skip(adapt, state.previous_um);
        }
    }

    /// Returns to an earlier zero flow (um of PZT, and its variance, um^2) and discards the estimate since then. The bead is expected at its
    /// last seen position. Otherwise the wrong zero flow would carry the prediction away, and the command would jump when the bead is
    /// seen again.
    pub fn rest_at(&self, state: &mut LoopState<L::State>, zero_flow_um: f64, variance_um2: f64) {
        if zero_flow_um.is_finite() && variance_um2 >= 0.0 {
            let gain = self.tuning(state).gain;
            let scaled_um = self.parts.limits.nearest(zero_flow_um) * gain;
            let scaled_um2 = variance_um2 * gain * gain;
            self.estimator_of(state)
                .rest_at(&mut state.estimator, scaled_um, scaled_um2);
        }
    }

    /// Estimate and reference of a tick.
    fn estimate<'a>(&self, state: &mut LoopState<L::State>, input: &LoopInput<'a>) -> Tick<'a> {
        let fix = input.measurement.as_ref().and_then(|m| self.fix(m));
        let tuning = self.tuning(state);
        let estimator = self.estimator_of(state);
        let before_um = state.estimator.neutral_um;
        let mut seen = fix;
        if let (Some(adapter), Some(adapt)) = (&self.adapter, &mut state.adapt) {
            adapter.begin(adapt, input.late_samples);
            seen = fix.map(|fix| adapter.without_lines(adapt, fix));
        }
        let mut estimate: Estimate = estimator.step(&mut state.estimator, seen);
        let Limits {
            low_um, high_um, ..
        } = self.parts.limits;
        let (low, high) = (low_um * tuning.gain, high_um * tuning.gain);
        state.estimator.neutral_um = state.estimator.neutral_um.clamp(low, high);
        estimate.neutral_um = state.estimator.neutral_um;
        estimate.now.n = state.estimator.neutral_um;
        if estimate.stepped {
            // An integral learns a flow slowly; one that stepped is known at once.
            let stepped_um = estimate.neutral_um - before_um;
            (self.parts.controller).shift(&mut state.law, stepped_um);
        }
        // Nor is the loop to undo the dither.
        let mut dithered_um = 0.0;
        if let (Some(adapter), Some(adapt)) = (&self.adapter, &state.adapt) {
            let made = adapter.dithered(adapt);
            estimate.now.q -= made.q;
            estimate.now.last_um -= made.last_um;
            for (mode, made) in estimate.now.modes.iter_mut().zip(made.modes) {
                *mode -= made;
            }
            let at = fix.as_ref().filter(|_| estimate.fresh);
            dithered_um = adapter.dither_seen_um(adapt, at);
        }
        // What a PI controller sees: the fix itself where there is one, else what the model says it would be.
        let bead_um = match seen {
            Some(seen) if estimate.fresh => seen.position_um,
            _ => estimate.predicted_measurement_um,
        } - dithered_um;
        let reference_ok = input.reference_um.abs() < FAR_UM;
        let controls = input.mode == Mode::Run && reference_ok && estimate.seen;
        let mut law = LawInput {
            reference_um: if reference_ok {
                input.reference_um
            } else {
                bead_um
            },
            preview_um: input.preview_um,
            bead_um,
            fed_um: 0.0,
            on_path: FeedForwardState::default(),
            feed_forward_um: 0.0,
            estimate,
            previous_um: (state.previous_um - state.hidden_um) * tuning.gain,
            tuning,
            solver: input.solver,
        };
        if controls {
            let offset = (fix.as_ref().filter(|_| estimate.fresh)).map_or(0.0, |fix| fix.offset);
            let model = self.estimator_of(state).model();
            let exposure_ticks = self.parts.estimator.exposure_ms * 1e-3 / model.sample_time_s;
            let age_ticks = model.delay_samples() + offset;
            self.path
                .meet(&mut state.path, &mut law, age_ticks, exposure_ticks);
        } else {
            Path::rest(&mut state.path, law.reference_um);
        }
        Tick {
            controls,
            fix,
            not_finite: !reference_ok || (input.measurement.is_some() && fix.is_none()),
            law,
        }
    }

    /// Applies the limits and fills in the output of the tick.
    fn limit(
        &self,
        state: &LoopState<L::State>,
        input: &LoopInput,
        tick: &Tick,
        decided: &LawOutput,
        added_um: f64,
    ) -> LoopOutput {
        let estimate = &tick.law.estimate;
        // From the law's units to those of the PZT.
        let gain = tick.law.tuning.gain;
        let neutral_um = estimate.neutral_um / gain;
        let requested_um = decided.wish_um / gain + added_um;
        let mut wanted_um = requested_um;
        let most = estimate.authority_um / gain;
        if most.is_finite() && input.mode == Mode::Run {
            wanted_um = wanted_um.clamp(neutral_um - most, neutral_um + most);
        }
        let sample_s = self.parts.model.sample_time_s;
        let limited = self.parts.limits.apply(
            wanted_um,
            state.previous_um,
            input
                .slew_time_s
                .map_or(sample_s, |since_s| since_s.clamp(0.0, sample_s)),
        );
        LoopOutput {
            command_um: limited.command_um,
            requested_um,
            dither_um: 0.0,
            cancel_um: 0.0,
            estimate_um: estimate.position_um,
            estimate_sd_um: estimate.position_sd_um,
            predicted_measurement_um: estimate.predicted_measurement_um,
            neutral_um,
            innovation_um: estimate.innovation_um,
            driven: Driven::default(),
            flags: LoopFlags {
                range_limited: limited.range,
                slew_limited: limited.slew,
                not_finite: limited.not_finite || tick.not_finite,
                coasting: estimate.coasting,
                gated: estimate.gated,
                stuck: estimate.stuck,
            },
            solver: decided.solver,
        }
    }
}

/// The command that moves the bead along the reference in a tick.
fn driven(input: &LoopInput, tick: &Tick, measured_gain: Option<f64>) -> Driven {
    let gain = tick.law.tuning.gain;
    let asked = input.feed_forward_gain;
    Driven {
        feed_forward_um: tick.law.feed_forward_um,
        jump_um: 0.0,
        feed_forward_gain: asked
            .or(measured_gain)
            .filter(|gain| (0.1..=10.0).contains(gain))
            .unwrap_or(gain),
        gain,
        limited: false,
    }
}
