//! What a loop is built from, what a tick of it is given, and what it gives.

use crate::error::BuildError;
use crate::estimator::EstimatorConfig;
use crate::feedback::Lqg;
use crate::limits::Limits;
use crate::linear::LinearLaw;
use crate::loop_model::LoopModel;
use crate::mpc::Mpc;
use crate::pi::Pi;

/// A bead position from vision.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measurement {
    /// Position along the channel, um.
    pub position_um: f64,
    /// Variance of the position, um^2; 0 where vision states none.
    pub variance_um2: f64,
    /// Whole ticks by which the frame is older than the nominal delay (0: on time).
    pub age_samples: u16,
    /// What its time stamp says beyond that, ticks, -1/2 to 1/2; positive: older still.
    pub offset_samples: f64,
}

/// What the loop is to do.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Mode {
    /// Control the bead.
    #[default]
    Run,
    /// Stop the bead: slew to the running estimate of neutral.
    Freeze,
    /// Make the hardware safe: slew to the park displacement. The bead is lost.
    Park,
    /// Open loop: this PZT displacement, um, within the limits. The estimator goes on.
    Direct(f64),
}

/// What a tick is given.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct LoopInput<'a> {
    /// The newest bead position, if there is one.
    pub measurement: Option<Measurement>,
    /// Reference of this tick, um of bead.
    pub reference_um: f64,
    /// References of the coming ticks, the next one first; may be empty.
    pub preview_um: &'a [f64],
    /// What to do.
    pub mode: Mode,
    /// Added to the controller's wish in [`Mode::Run`], um of PZT: excitation for identification in closed loop.
    pub excitation_um: f64,
    /// A learned correction of the feed-forward, added in [`Mode::Run`], um of PZT. The estimator is not told of it:
    /// it is what the plant needs beyond what the model says, so that with it the model is right along the reference.
    pub learned_um: f64,
    /// How long an optimising controller may take.
    pub solver: SolverTerms,
}

/// How long an optimising controller may take in a tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum SolverTerms {
    /// As long as it needs: the virtual clock.
    #[default]
    Unlimited,
    /// Until then; the time that it took is reported.
    Until(std::time::Instant),
    /// A recorded tick again: it ends as it ended then. Without this a deadline would not replay to the bit.
    Recorded(SolverStatus),
}

/// What happened in a tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct LoopFlags {
    /// The request was outside the range.
    pub range_limited: bool,
    /// The request was further away than one tick's slew.
    pub slew_limited: bool,
    /// The request, the reference or the measurement was not a finite number.
    pub not_finite: bool,
    /// No measurement was used: the estimate is a prediction.
    pub coasting: bool,
    /// The measurement was refused by the innovation gate.
    pub gated: bool,
    /// The bead does not follow the PZT and is taken for stuck.
    pub stuck: bool,
}

/// How the optimiser of a tick ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[repr(u8)]
pub enum SolverStatus {
    /// The controller does not optimise.
    #[default]
    NotUsed = 0,
    /// Solved.
    Solved = 1,
    /// Out of time or iterations: the shifted previous plan was used.
    PreviousPlan = 2,
    /// No plan was left: PI was used.
    FallbackPi = 3,
}

impl SolverStatus {
    /// The status of a number in a record; anything unknown counts as not used.
    pub fn from_number(number: u8) -> Self {
        match number {
            1 => Self::Solved,
            2 => Self::PreviousPlan,
            3 => Self::FallbackPi,
            _ => Self::NotUsed,
        }
    }
}

/// Account of the optimiser of a tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SolverReport {
    /// How it ended.
    pub status: SolverStatus,
    /// Iterations.
    pub iterations: u16,
    /// Constraints active at the solution.
    pub active: u16,
    /// Time it took, ns; 0 where no deadline was set.
    pub solve_ns: u32,
}

/// What a tick gives.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LoopOutput {
    /// The command: finite, within range, within slew of the previous one, um.
    pub command_um: f64,
    /// The controller's wish before the limits, um.
    pub requested_um: f64,
    /// Bead position now (just before the command takes effect), um.
    pub estimate_um: f64,
    /// Predicted (or, with a measurement, filtered) position at the nominal time of this tick's measurement, um.
    pub predicted_measurement_um: f64,
    /// PZT displacement at which the bead rests, um.
    pub neutral_um: f64,
    /// Measurement less its prediction, um; 0 without measurement.
    pub innovation_um: f64,
    /// What happened.
    pub flags: LoopFlags,
    /// The optimiser's account.
    pub solver: SolverReport,
}

/// Which control law.
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
    pub(crate) fn pi(&self) -> Pi {
        match self {
            Self::Pi(pi) | Self::Mpc(_, pi) => *pi,
            Self::Lqg(_) => Pi::new(0.0, 0.0),
        }
    }

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

/// Everything that a loop is built from.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LoopConfig {
    /// The plant.
    pub model: LoopModel,
    /// Estimator.
    pub estimator: EstimatorConfig,
    /// Control law.
    pub controller: ControllerConfig,
    /// Limits of the command.
    pub limits: Limits,
}
