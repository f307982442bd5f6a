//! What a loop is built from, what a tick of it is given, and what it gives.

use crate::estimator::EstimatorConfig;
use crate::law::{SolverReport, SolverTerms};
use crate::learning::Driven;
use crate::limits::Limits;
use crate::loop_model::LoopModel;

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

/// The displacement that stood at the actuator, where it is known to be another than what was commanded: the line was silent,
/// the board held, or its limits said otherwise.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InForce {
    /// Displacement, um.
    pub displacement_um: f64,
    /// Ticks up to the one before this for which it stood.
    pub ticks: usize,
    /// The displacement before that, um, and its ticks; 0: what was commanded.
    pub before: (f64, usize),
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
    /// Gain over the design's that the law's feed-forward is divided by, where it is not to be that in force: what was
    /// learned is right beside this one.
    pub feed_forward_gain: Option<f64>,
    /// Time since the previous command, s, where it is shorter than a tick: the slew limit holds by the clock.
    pub slew_time_s: Option<f64>,
    /// What stood at the actuator instead of the last commands; `None`: they did. Estimator, law and slew limit go on from it.
    pub in_force: Option<InForce>,
    /// By how much the zero flow moves with this tick through something that is known, such as a second actuator, um of PZT:
    /// estimator, law and command go along.
    pub zero_flow_shift_um: f64,
    /// How long an optimising controller may take.
    pub solver: SolverTerms,
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

/// What a tick gives.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LoopOutput {
    /// The command: finite, within range, within slew of the previous one, um.
    pub command_um: f64,
    /// The controller's wish before the limits, um.
    pub requested_um: f64,
    /// Bead position now (just before the command takes effect), um.
    pub estimate_um: f64,
    /// Standard deviation of that estimate, um.
    pub estimate_sd_um: f64,
    /// Predicted (or, with a measurement, filtered) position at the nominal time of this tick's measurement, um.
    pub predicted_measurement_um: f64,
    /// PZT displacement at which the bead rests, um.
    pub neutral_um: f64,
    /// Measurement less its prediction, um; 0 without measurement.
    pub innovation_um: f64,
    /// What moves the bead along the reference, for learning.
    pub driven: Driven,
    /// What happened.
    pub flags: LoopFlags,
    /// The optimiser's account.
    pub solver: SolverReport,
}

/// Everything that a loop with the law `L` is built from.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LoopParts<L> {
    /// The plant.
    pub model: LoopModel,
    /// Estimator.
    pub estimator: EstimatorConfig,
    /// Control law: one of this crate by its configuration, or any [`crate::ControlLaw`].
    pub controller: L,
    /// Limits of the command.
    pub limits: Limits,
}

impl<L> LoopParts<L> {
    /// The same with another law.
    pub fn with<M>(self, controller: M) -> LoopParts<M> {
        LoopParts {
            model: self.model,
            estimator: self.estimator,
            controller,
            limits: self.limits,
        }
    }
}
