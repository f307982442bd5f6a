//! The parts of a loop, and the input and output of one tick.

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
    /// Rest of its age by the time stamp, ticks, -1/2 to 1/2; positive: older.
    pub offset_samples: f64,
}

/// Mode of the loop.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Mode {
    /// Control the bead.
    #[default]
    Run,
    /// Stop the bead: slew to the running estimate of neutral.
    Freeze,
    /// Make the hardware safe: slew to the park displacement. The bead is lost.
    Park,
    /// Open loop: this PZT displacement, um, within the limits. The estimator keeps running.
    Direct(f64),
}

/// A displacement of the actuator that is known to differ from the command: the line was silent, the board held, or the board's
/// limits were narrower.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InForce {
    /// Displacement, um.
    pub displacement_um: f64,
    /// Ticks for which it was in force, up to the previous one.
    pub ticks: usize,
    /// The displacement before that, um, and its ticks; 0 ticks: the commands were obeyed.
    pub before: (f64, usize),
}

/// Input of a tick.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct LoopInput<'a> {
    /// The newest bead position, if there is one.
    pub measurement: Option<Measurement>,
    /// Reference of this tick, um of bead.
    pub reference_um: f64,
    /// References of the coming ticks, the next one first; may be empty.
    pub preview_um: &'a [f64],
    /// Mode.
    pub mode: Mode,
    /// Added to the controller's wish in [`Mode::Run`], um of PZT: excitation for identification in closed loop.
    pub excitation_um: f64,
    /// A learned correction of the feed-forward, added in [`Mode::Run`], um of PZT. The estimator does not see it: it
    /// makes up for the difference between plant and model along the reference.
    pub learned_um: f64,
    /// Gain, relative to the design's, that divides the law's feed-forward; `None`: the gain in force. A learned correction holds only
    /// with the gain at which it was learned.
    pub feed_forward_gain: Option<f64>,
    /// Time since the previous command, s, if it is shorter than a tick: the slew limit holds by the clock.
    pub slew_time_s: Option<f64>,
    /// Displacement that replaced the last commands; `None`: they were obeyed. Estimator, law and slew limit continue from it.
    pub in_force: Option<InForce>,
    /// Known shift of the zero flow in this tick, such as by a second actuator, um of PZT. Estimator, law and command shift with it.
    pub zero_flow_shift_um: f64,
    /// Unevenness of the ticks: time by which this one, and its command, comes later than the ticks before it say, samples.
    pub late_samples: f64,
    /// How long an optimising controller may take.
    pub solver: SolverTerms,
}

/// Events of a tick.
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

/// Output of a tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LoopOutput {
    /// The command: finite, within range, within slew of the previous one, um.
    pub command_um: f64,
    /// The controller's wish before the limits, um.
    pub requested_um: f64,
    /// Part of the command that was drawn at random to learn the gain (dither), um; 0 where a limit changed the command.
    pub dither_um: f64,
    /// Part of the command that cancels a periodic flow, um: the bead shows neither.
    pub cancel_um: f64,
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
    /// The part of the command that moves the bead along the reference, for learning.
    pub driven: Driven,
    /// Events of the tick.
    pub flags: LoopFlags,
    /// Status and cost of the optimiser.
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
