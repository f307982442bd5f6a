//! A loop with any law behind one type, and the laws of this crate by their configuration.

use crate::control_loop::{ControlLoop, LoopState};
use crate::error::BuildError;
use crate::estimator::EstimatorConfig;
use crate::feedforward::BRAKING_TICKS;
use crate::law::{ControlLaw, LAW_COLUMNS};
use crate::linear::LinearLaw;
use crate::loop_io::{LoopInput, LoopOutput, LoopParts};
use crate::loop_model::LoopModel;
use crate::lqg::{Lqg, LqgLaw};
use crate::mpc::{Mpc, MpcLaw};
use crate::pi::{Pi, PiLaw};
use crate::plant_estimate::{ADAPT_COLUMNS, Adaptation};

/// Which control law of this crate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum ControllerConfig {
    /// PI, with or without lead.
    Pi(Pi),
    /// State feedback on the estimate, with feed-forward of the previewed reference.
    Lqg(Lqg),
    /// Model predictive control under the limits, with preview; PI as the last fallback.
    Mpc(Mpc, Pi),
}

impl ControllerConfig {
    /// The feedback part without limits.
    ///
    /// # Errors
    /// [`BuildError`] naming the parameter, or a Riccati equation without solution.
    pub fn linear(
        &self,
        estimator: &EstimatorConfig,
        model: &LoopModel,
    ) -> Result<LinearLaw, BuildError> {
        match self {
            Self::Pi(pi) => Ok(LinearLaw::Pi {
                pi: *pi,
                sample_time_s: model.sample_time_s,
            }),
            Self::Lqg(lqg) => lqg.feedback(model)?.linear(estimator, model),
            Self::Mpc(mpc, _) => mpc.feedback(model)?.linear(estimator, model),
        }
    }
}

/// Everything that a loop with a law of this crate is built from.
pub type LoopConfig = LoopParts<ControllerConfig>;

/// A loop and its state, whatever the law.
trait AnyLoop: std::fmt::Debug + Send {
    fn start(&mut self, command_um: f64, neutral_um: f64);
    fn step(&mut self, input: &LoopInput) -> LoopOutput;
    fn skip(&mut self);
    fn rest_at(&mut self, zero_flow_um: f64, variance_um2: f64);
    fn start_estimate(&mut self, gain: f64, sd: f64, dof: f64);
    fn previous_command_um(&self) -> f64;
    fn neutral_um(&self) -> f64;
    fn neutral_variance_um2(&self) -> f64;
    fn adaptation(&self) -> Option<Adaptation>;
    fn record(&self, out: &mut [f32; LAW_COLUMNS]);
}

/// [`AnyLoop`] for one law.
#[derive(Debug)]
struct Running<L: ControlLaw> {
    control: ControlLoop<L>,
    state: LoopState<L::State>,
    columns: usize,
}

impl<L: ControlLaw> AnyLoop for Running<L> {
    fn start(&mut self, command_um: f64, neutral_um: f64) {
        self.state = self.control.start(command_um, neutral_um);
    }

    fn step(&mut self, input: &LoopInput) -> LoopOutput {
        self.control.step(&mut self.state, input)
    }

    fn skip(&mut self) {
        self.control.skip(&mut self.state);
    }

    fn rest_at(&mut self, zero_flow_um: f64, variance_um2: f64) {
        self.control
            .rest_at(&mut self.state, zero_flow_um, variance_um2);
    }

    fn start_estimate(&mut self, gain: f64, sd: f64, dof: f64) {
        self.control.start_estimate(&mut self.state, gain, sd, dof);
    }

    fn previous_command_um(&self) -> f64 {
        self.state.previous_um
    }

    fn neutral_um(&self) -> f64 {
        self.control.neutral_um(&self.state)
    }

    fn neutral_variance_um2(&self) -> f64 {
        self.control.neutral_variance_um2(&self.state)
    }

    fn adaptation(&self) -> Option<Adaptation> {
        self.control.adaptation(&self.state)
    }

    fn record(&self, out: &mut [f32; LAW_COLUMNS]) {
        if let Some((own, rest)) = out.split_at_mut_checked(self.columns) {
            let law = &self.control.parts().controller;
            law.record(&self.state.law, own);
            self.control.record_adaptation(&self.state, rest);
        }
    }
}

/// A loop of any kind and its state. What the runtime holds; a step allocates nothing.
#[derive(Debug)]
pub struct Controller {
    running: Box<dyn AnyLoop>,
    settings: LoopParts<()>,
    preview_len: usize,
    columns: Vec<&'static str>,
}

impl Controller {
    /// A controller with a law of this crate.
    ///
    /// # Errors
    /// [`BuildError`] naming the parameter.
    pub fn new(config: LoopConfig) -> Result<Self, BuildError> {
        let model = &config.model;
        match config.controller {
            ControllerConfig::Pi(pi) => {
                Self::with_law(config.with(PiLaw::new(pi, model.sample_time_s)?))
            }
            ControllerConfig::Lqg(lqg) => Self::with_law(config.with(LqgLaw::new(&lqg, model)?)),
            ControllerConfig::Mpc(mpc, pi) => {
                let law = MpcLaw::new(&mpc, pi, model, &config.limits)?;
                Self::with_law(config.with(law))
            }
        }
    }

    /// A controller with any law; see [`ControlLaw`]. It is at rest at the park displacement until
    /// [`Controller::start`].
    ///
    /// # Errors
    /// [`BuildError`] naming the parameter, or a column of the law that no record can have.
    pub fn with_law<L: ControlLaw>(parts: LoopParts<L>) -> Result<Self, BuildError> {
        let law = &parts.controller;
        let own = law.columns();
        let mut columns = own.to_vec();
        if parts.estimator.adapts() {
            columns.extend(ADAPT_COLUMNS);
        }
        check_columns(&columns)?;
        let preview_len = law.preview_len().max(BRAKING_TICKS);
        let settings = LoopParts {
            model: parts.model,
            estimator: parts.estimator,
            controller: (),
            limits: parts.limits,
        };
        let control = ControlLoop::new(parts)?;
        let park_um = settings.limits.park_um;
        let state = control.start(park_um, park_um);
        Ok(Self {
            running: Box::new(Running {
                control,
                state,
                columns: own.len(),
            }),
            settings,
            preview_len,
            columns,
        })
    }

    /// Plant, estimator and limits that it was built from.
    pub fn settings(&self) -> &LoopParts<()> {
        &self.settings
    }

    /// Puts the loop at rest at a command, with a first belief of neutral (both um). May allocate.
    pub fn start(&mut self, command_um: f64, neutral_um: f64) {
        self.running.start(command_um, neutral_um);
    }

    /// Displacement at which the bead rests, as far as it is known, um.
    pub fn neutral_um(&self) -> f64 {
        self.running.neutral_um()
    }

    /// The gain over the model's was measured before the loop is closed; see [`ControlLoop::start_estimate`].
    pub fn start_estimate(&mut self, gain: f64, sd: f64, dof: f64) {
        self.running.start_estimate(gain, sd, dof);
    }

    /// What is known of gain and delay of the plant, and the tuning in force; `None` where the loop does not adapt.
    pub fn adaptation(&self) -> Option<Adaptation> {
        self.running.adaptation()
    }

    /// Command of the previous tick, um.
    pub fn previous_command_um(&self) -> f64 {
        self.running.previous_command_um()
    }

    /// References of the coming ticks that a step can use.
    pub fn preview_len(&self) -> usize {
        self.preview_len
    }

    /// Names of the law's own columns in the record.
    pub fn columns(&self) -> &[&'static str] {
        &self.columns
    }

    /// Values of these columns after a tick; NaN where there is no column.
    pub fn record(&self) -> [f32; LAW_COLUMNS] {
        let mut out = [f32::NAN; LAW_COLUMNS];
        self.running.record(&mut out);
        out
    }

    /// A tick that never came, see [`ControlLoop::skip`].
    pub fn skip(&mut self) {
        self.running.skip();
    }

    /// Variance of [`Controller::neutral_um`], um^2, see [`ControlLoop::neutral_variance_um2`].
    pub fn neutral_variance_um2(&self) -> f64 {
        self.running.neutral_variance_um2()
    }

    /// The PZT is brought to a zero flow that is not the newest estimate, see [`ControlLoop::rest_at`].
    pub fn rest_at(&mut self, zero_flow_um: f64, variance_um2: f64) {
        self.running.rest_at(zero_flow_um, variance_um2);
    }

    /// One tick.
    pub fn step(&mut self, input: &LoopInput) -> LoopOutput {
        self.running.step(input)
    }
}

/// Refuses columns that no record can have.
fn check_columns(columns: &[&'static str]) -> Result<(), BuildError> {
    let fits = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_';
    if columns.len() > LAW_COLUMNS {
        return Err(BuildError::TooManyColumns {
            given: columns.len(),
            most: LAW_COLUMNS,
        });
    }
    for (place, &name) in columns.iter().enumerate() {
        let twice = columns.iter().take(place).any(|other| *other == name);
        if name.is_empty() || !name.chars().all(fits) || twice {
            return Err(BuildError::Column { name });
        }
    }
    Ok(())
}
