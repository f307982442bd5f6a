//! One tick of the loop: estimate, controller, limits.

use crate::error::BuildError;
use crate::estimator::{Estimate, Estimator, Fix};
use crate::feedback::{DEVIATION, Feedback, deviation};
use crate::feedforward::{FeedForward, FeedForwardState};
use crate::limits::Limits;
use crate::loop_io::{
    ControllerConfig, LoopConfig, LoopFlags, LoopInput, LoopOutput, Measurement, Mode, SolverReport,
};
use crate::mpc::{HORIZON, MpcWorkspace};
use crate::pi::{PiState, PiStep};
use crate::state::{LoopState, STATE_LEN};

#[derive(Debug, Clone, Copy, PartialEq)]
enum Law {
    Pi,
    State(Feedback),
}

/// A tick between estimate and limits: what a control law decides on.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Prepared {
    pub estimate: Estimate,
    fix_ok: bool,
    reference_ok: bool,
    pub reference_um: f64,
    bead_um: f64,
    /// The law is to decide; otherwise the mode does.
    pub controls: bool,
    pi: PiState,
    proportional_um: f64,
    /// Deviation from the model on the reference.
    pub deviation: [f64; DEVIATION],
    /// Feed-forward displacement from neutral, um.
    pub feed_forward_um: f64,
    /// Model on the reference, before and after this tick's feed-forward.
    pub on_reference: FeedForwardState,
    next_on_reference: FeedForwardState,
}

impl Prepared {
    /// Replaces the feed-forward by one within limits, and the model on the reference by one that follows it.
    pub(crate) fn set_feed_forward(&mut self, displacement_um: f64, next: FeedForwardState) {
        self.feed_forward_um = displacement_um;
        self.next_on_reference = next;
    }

    fn hold(&self) -> bool {
        self.estimate.coasting || self.estimate.stuck
    }
}

/// A loop without workspace: estimator, controller and limits. Immutable; the state is apart and `Copy`.
///
/// ```
/// use cellpos_control::*;
/// let config = LoopConfig {
///     model: LoopModel::eq6(2e-3),
///     estimator: EstimatorConfig::default(),
///     controller: ControllerConfig::Pi(Pi::new(0.46, 19.5)),
///     limits: Limits::default(),
/// };
/// let control = ControlLoop::new(config)?;
/// let mut state = control.start(20.0, 20.0);
/// let fix = Measurement { position_um: 1.0, variance_um2: 4e-4, age_samples: 0, offset_samples: 0.0 };
/// let out = control.step(&mut state, &LoopInput { measurement: Some(fix), ..LoopInput::default() });
/// assert!(out.command_um < 20.0, "the bead is beyond the reference: pull");
/// # Ok::<(), BuildError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ControlLoop {
    config: LoopConfig,
    estimator: Estimator,
    law: Law,
    pi: PiStep,
    pub(crate) forward: FeedForward,
}

/// Largest position that counts as one, um.
const FAR_UM: f64 = 1e6;

impl ControlLoop {
    /// Builds a loop.
    ///
    /// # Errors
    /// [`BuildError`] naming the parameter.
    pub fn new(config: LoopConfig) -> Result<Self, BuildError> {
        config.limits.validate()?;
        let estimator = Estimator::new(config.estimator, config.model)?;
        let pi = config.controller.pi();
        pi.validate()?;
        let law = match config.controller {
            ControllerConfig::Pi(_) => Law::Pi,
            ControllerConfig::Lqg(lqg) => Law::State(lqg.feedback(&config.model)?),
            ControllerConfig::Mpc(mpc, _) => Law::State(mpc.feedback(&config.model)?),
        };
        let ts = config.model.sample_time_s;
        let forward = FeedForward::new(&config.model);
        Ok(Self {
            config,
            estimator,
            law,
            pi: PiStep::new(pi, ts),
            forward,
        })
    }

    /// What it was built from.
    pub fn config(&self) -> &LoopConfig {
        &self.config
    }

    /// Its estimator.
    pub fn estimator(&self) -> &Estimator {
        &self.estimator
    }

    /// A state at rest at a command, with a first belief of neutral (both um).
    pub fn start(&self, command_um: f64, neutral_um: f64) -> LoopState {
        let command = self.config.limits.to_grid(command_um);
        let neutral = if neutral_um.is_finite() {
            neutral_um
        } else {
            command
        };
        LoopState {
            estimator: self.estimator.start(command, neutral),
            learned_um: 0.0,
            pi: PiState {
                integral_um: command,
                lead_um: 0.0,
            },
            feed_forward: FeedForwardState::default(),
        }
    }

    /// The state as 16 numbers, for the records.
    pub fn pack(&self, state: &LoopState) -> [f64; STATE_LEN] {
        state.pack(&self.config.limits, self.law != Law::Pi)
    }

    /// The state of [`ControlLoop::pack`].
    pub fn unpack(&self, packed: &[f64; STATE_LEN]) -> LoopState {
        LoopState::unpack(packed, &self.config.limits, self.law != Law::Pi)
    }

    fn fix(&self, measurement: &Measurement) -> Option<Fix> {
        let Measurement {
            position_um,
            variance_um2,
            age_samples,
            offset_samples,
        } = *measurement;
        let stated = variance_um2.is_finite() && variance_um2 > 0.0;
        let assumed = self.config.estimator.fix_noise_um.powi(2);
        (position_um.abs() < FAR_UM).then_some(Fix {
            position_um,
            variance_um2: if stated {
                variance_um2.clamp(1e-8, 1e6)
            } else {
                assumed
            },
            age: usize::from(age_samples),
            offset: if offset_samples.abs() <= 0.5 {
                offset_samples
            } else {
                0.0
            },
        })
    }

    /// One tick. Under [`ControllerConfig::Mpc`] this is its law without constraints: the constrained one needs the
    /// workspace of a [`Controller`].
    pub fn step(&self, state: &mut LoopState, input: &LoopInput) -> LoopOutput {
        let prepared = self.prepare(state, input);
        let wish_um = match &self.law {
            Law::Pi => self.pi_wish(&prepared),
            Law::State(feedback) => {
                prepared.estimate.neutral_um
                    + prepared.feed_forward_um
                    + feedback.correction(&prepared.deviation)
            }
        };
        self.finish(state, input, &prepared, wish_um, SolverReport::default())
    }

    /// A tick that never came: the command was held and the bead moved on. The estimator follows; integrator and
    /// feed-forward stay where they are, so that a step in progress goes on as it was.
    pub fn skip(&self, state: &mut LoopState) {
        self.estimator.step(&mut state.estimator, None);
        // What the estimator was told of the command; a learned part of it is held as well.
        let held_um = state.estimator.history_um[0];
        self.estimator.push(&mut state.estimator, held_um);
    }

    /// Estimate, reference and feed-forward of a tick.
    pub(crate) fn prepare(&self, state: &mut LoopState, input: &LoopInput) -> Prepared {
        let fix = input.measurement.as_ref().and_then(|m| self.fix(m));
        let mut estimate = self.estimator.step(&mut state.estimator, fix);
        let Limits {
            low_um, high_um, ..
        } = self.config.limits;
        state.estimator.neutral_um = state.estimator.neutral_um.clamp(low_um, high_um);
        estimate.neutral_um = state.estimator.neutral_um;
        estimate.now.n = state.estimator.neutral_um;
        // What a PI controller sees: the fix itself where there is one, else what the model says it would be.
        let bead_um = match fix {
            Some(fix) if estimate.fresh => fix.position_um,
            _ => estimate.predicted_measurement_um,
        };
        let reference_ok = input.reference_um.abs() < FAR_UM;
        let controls = input.mode == Mode::Run && reference_ok && estimate.seen;
        let reference_um = if reference_ok {
            input.reference_um
        } else {
            bead_um
        };
        let mut pi = state.pi;
        // While something else decides, PI follows as if the reference were where the bead is: the way from there to
        // the reference is then a step like any other once PI takes over, not an offset for the integrator alone.
        let followed_um = if controls { reference_um } else { bead_um };
        let proportional_um = self.pi.proportional(&mut pi, followed_um, bead_um);
        let mut on_reference = state.feed_forward;
        if controls {
            self.forward.meet(&mut on_reference, reference_um);
        } else {
            on_reference = FeedForward::rest(reference_um);
        }
        if !on_reference.is_sound() {
            on_reference = FeedForward::rest(reference_um);
        }
        let mut next_on_reference = on_reference;
        let next_um = self.preview(input, reference_um, 0);
        let feed_forward_um = self.forward.step(&mut next_on_reference, next_um);
        Prepared {
            estimate,
            fix_ok: fix.is_some(),
            reference_ok,
            reference_um,
            bead_um,
            controls,
            pi,
            proportional_um,
            deviation: deviation(&estimate.now, &on_reference),
            feed_forward_um,
            on_reference,
            next_on_reference,
        }
    }

    /// The reference `ahead + 1` ticks from now; the last one known is held.
    pub(crate) fn preview(&self, input: &LoopInput, reference_um: f64, ahead: usize) -> f64 {
        let known = input
            .preview_um
            .get(ahead)
            .or_else(|| input.preview_um.last())
            .copied()
            .unwrap_or(reference_um);
        if known.abs() < FAR_UM {
            known
        } else {
            reference_um
        }
    }

    /// What PI asks for, um.
    pub(crate) fn pi_wish(&self, p: &Prepared) -> f64 {
        p.proportional_um
            + self
                .pi
                .integral(&p.pi, p.reference_um - p.bead_um, p.hold())
    }

    /// Mode, limits, anti-windup and the history of commands.
    pub(crate) fn finish(
        &self,
        state: &mut LoopState,
        input: &LoopInput,
        prepared: &Prepared,
        wish_um: f64,
        solver: SolverReport,
    ) -> LoopOutput {
        let requested_um = match input.mode {
            Mode::Park => self.config.limits.park_um,
            Mode::Direct(displacement_um) => displacement_um,
            _ if prepared.controls => wish_um,
            _ => prepared.estimate.neutral_um,
        };
        let (excitation_um, learned_um) = if prepared.controls {
            (
                input.excitation_um,
                self.config.limits.to_steps(input.learned_um),
            )
        } else {
            (0.0, 0.0)
        };
        let added_um = excitation_um + learned_um;
        let output = self.limit(state, input, prepared, requested_um + added_um, solver);
        let mut pi = prepared.pi;
        if prepared.controls && self.law == Law::Pi {
            self.pi.integrate(
                &mut pi,
                prepared.reference_um - prepared.bead_um,
                requested_um,
                // The excitation is no saturation: the integrator must not be pulled along with it.
                output.command_um - added_um,
                prepared.hold(),
            );
        } else {
            self.pi.track(
                &mut pi,
                prepared.proportional_um,
                output.command_um - learned_um,
            );
        }
        let sound = pi.integral_um.abs() < FAR_UM && pi.lead_um.abs() < FAR_UM;
        state.pi = if sound {
            pi
        } else {
            PiState {
                integral_um: output.command_um,
                lead_um: 0.0,
            }
        };
        if self.law != Law::Pi {
            state.pi.lead_um = 0.0;
            state.feed_forward = if prepared.controls {
                prepared.next_on_reference
            } else {
                FeedForward::rest(prepared.reference_um)
            };
        }
        // With a feed-forward of its own the loop asks for what moves the model along the reference; what is learned makes
        // the bead do the same, so the estimator is not told of it. PI has none: there the learned part is what moves the
        // bead, and an estimator that does not know of it refuses fixes and takes the bead for stuck.
        let hidden_um = if self.law == Law::Pi { 0.0 } else { learned_um };
        self.estimator
            .push(&mut state.estimator, output.command_um - hidden_um);
        state.learned_um = hidden_um;
        output
    }

    /// The limits and the account of the tick.
    fn limit(
        &self,
        state: &LoopState,
        input: &LoopInput,
        prepared: &Prepared,
        requested_um: f64,
        solver: SolverReport,
    ) -> LoopOutput {
        let estimate = &prepared.estimate;
        let mut wanted_um = requested_um;
        let most = estimate.authority_um;
        if most.is_finite() && input.mode == Mode::Run {
            wanted_um = wanted_um.clamp(estimate.neutral_um - most, estimate.neutral_um + most);
        }
        let limited = self.config.limits.apply(
            wanted_um,
            state.previous_command_um(),
            self.config.model.sample_time_s,
        );
        let refused = input.measurement.is_some() && !prepared.fix_ok;
        LoopOutput {
            command_um: limited.command_um,
            requested_um,
            estimate_um: estimate.position_um,
            predicted_measurement_um: estimate.predicted_measurement_um,
            neutral_um: estimate.neutral_um,
            innovation_um: estimate.innovation_um,
            flags: LoopFlags {
                range_limited: limited.range,
                slew_limited: limited.slew,
                not_finite: limited.not_finite || !prepared.reference_ok || refused,
                coasting: estimate.coasting,
                gated: estimate.gated,
                stuck: estimate.stuck,
            },
            solver,
        }
    }
}

/// A loop of any kind, with the workspace of an optimiser where it needs one. What the runtime holds.
#[derive(Debug)]
pub struct Controller {
    control: ControlLoop,
    mpc: Option<Box<MpcWorkspace>>,
}

impl Controller {
    /// Builds a controller; allocates whatever its steps will need.
    ///
    /// # Errors
    /// [`BuildError`] naming the parameter.
    pub fn new(config: LoopConfig) -> Result<Self, BuildError> {
        let control = ControlLoop::new(config)?;
        let mpc = match config.controller {
            ControllerConfig::Mpc(mpc, _) => Some(Box::new(MpcWorkspace::new(
                &mpc,
                &config.model,
                &config.limits,
            )?)),
            _ => None,
        };
        Ok(Self { control, mpc })
    }

    /// The loop.
    pub fn control_loop(&self) -> &ControlLoop {
        &self.control
    }

    /// A state at rest: see [`ControlLoop::start`].
    pub fn start(&self, command_um: f64, neutral_um: f64) -> LoopState {
        self.control.start(command_um, neutral_um)
    }

    /// References of the coming ticks that a step can use.
    pub fn preview_len(&self) -> usize {
        match self.control.config.controller {
            ControllerConfig::Pi(_) => 0,
            ControllerConfig::Lqg(_) => 1,
            ControllerConfig::Mpc(..) => HORIZON,
        }
    }

    /// A tick that never came, see [`ControlLoop::skip`].
    pub fn skip(&self, state: &mut LoopState) {
        self.control.skip(state);
    }

    /// One tick.
    pub fn step(&mut self, state: &mut LoopState, input: &LoopInput) -> LoopOutput {
        let Some(mpc) = &mut self.mpc else {
            return self.control.step(state, input);
        };
        let mut prepared = self.control.prepare(state, input);
        if !prepared.controls || prepared.estimate.stuck {
            mpc.forget();
            let wish_um = self.control.pi_wish(&prepared);
            return self
                .control
                .finish(state, input, &prepared, wish_um, SolverReport::default());
        }
        let previous_um = state.previous_command_um() - state.learned_um;
        let (plan_um, report) = mpc.plan(&self.control, input, &mut prepared, previous_um);
        let wish_um = plan_um.unwrap_or_else(|| self.control.pi_wish(&prepared));
        self.control
            .finish(state, input, &prepared, wish_um, report)
    }
}
