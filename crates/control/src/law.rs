//! Control laws: a constant configuration, a separate state, and a step from one tick to the next.
//!
//! A law computes the displacement of the PZT. The loop ([`crate::ControlLoop`]) does the rest. Before the law it estimates. After the law
//! it adds feed-forward, excitation and learned corrections, limits the command to range and slew, and reports the applied command to
//! the law. A law of another crate is a configuration, a state and one method:
//!
//! ```
//! use cellpos_control::*;
//! /// Proportional control about the zero-flow displacement that the estimator gives.
//! #[derive(Debug, Clone)]
//! struct Proportional {
//!     kp_um_per_um: f64,
//! }
//!
//! impl ControlLaw for Proportional {
//!     type State = f64;
//!     fn start(&self, _command_um: f64) -> f64 {
//!         0.0
//!     }
//!     fn step(&self, last_error_um: &mut f64, input: &LawInput) -> LawOutput {
//!         *last_error_um = input.reference_um - input.estimate.position_um;
//!         LawOutput::wish(input.estimate.neutral_um + self.kp_um_per_um * *last_error_um)
//!     }
//!     fn columns(&self) -> &'static [&'static str] {
//!         &["proportional_error_um"]
//!     }
//!     fn record(&self, last_error_um: &f64, out: &mut [f32]) {
//!         out[0] = *last_error_um as f32;
//!     }
//! }
//!
//! let mut controller = Controller::with_law(LoopParts {
//!     model: LoopModel::eq6(2e-3),
//!     estimator: EstimatorConfig::default(),
//!     controller: Proportional { kp_um_per_um: 0.3 },
//!     limits: Limits::default(),
//! })?;
//! controller.start(20.0, 20.0);
//! let fix = Measurement { position_um: 1.0, variance_um2: 4e-4, age_samples: 0, offset_samples: 0.0 };
//! let out = controller.step(&LoopInput { measurement: Some(fix), ..LoopInput::default() });
//! assert!(out.command_um < 20.0, "the bead is beyond the reference: pull");
//! # Ok::<(), BuildError>(())
//! ```

use crate::estimator::Estimate;
use crate::feedforward::FeedForwardState;
use crate::tuning::Tuning;
use std::fmt::Debug;

/// Largest number of a law's columns in the record.
pub const LAW_COLUMNS: usize = 8;

/// Input of a law in a tick.
#[derive(Debug, Clone, Copy)]
pub struct LawInput<'a> {
    /// Where the bead is to be now, um; finite: the reference as far as range and slew let the plant follow it.
    pub reference_um: f64,
    /// References of the coming ticks, the next one first; see [`LawInput::preview`].
    pub preview_um: &'a [f64],
    /// Measured position, um: the fix if it was used, otherwise the model's prediction of it. It belongs to the time of the frame, which is
    /// older than the tick by the delay; only the motion along the reference since then is added.
    pub bead_um: f64,
    /// Distance by which the feed-forward has moved the reference since the law took over, um: it causes no error. The rest of the
    /// reference's motion consists of jumps that were not known in advance.
    pub fed_um: f64,
    /// The model on the reference before this tick's command.
    pub on_path: FeedForwardState,
    /// What the loop adds to the wish in this tick to move the model along the reference, um.
    pub feed_forward_um: f64,
    /// The estimate.
    pub estimate: Estimate,
    /// Command in force before this tick, less what was learned and the model does not know, um.
    pub previous_um: f64,
    /// Gain and delay of the plant over those of the design. Without adaptation both are 1.
    pub tuning: Tuning,
    /// How long an optimiser may take.
    pub solver: SolverTerms,
}

/// Largest position that counts as one, um.
pub(crate) const FAR_UM: f64 = 1e6;

impl LawInput<'_> {
    /// The reference `ahead + 1` ticks from now; the last one known is held.
    pub fn preview(&self, ahead: usize) -> f64 {
        let known = self
            .preview_um
            .get(ahead)
            .or_else(|| self.preview_um.last())
            .copied()
            .unwrap_or(self.reference_um);
        if known.abs() < FAR_UM {
            known
        } else {
            self.reference_um
        }
    }

    /// Nothing is learned of the bead in this tick (no fix was used, or something holds it): an integrator waits.
    pub fn hold(&self) -> bool {
        self.estimate.coasting || self.estimate.stuck
    }
}

/// Output of a law.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LawOutput {
    /// Where the PZT is to be, um, less what moves it along the reference. The loop adds that, and keeps the sum within the limits.
    pub wish_um: f64,
    /// Status and cost of an optimiser.
    pub solver: SolverReport,
}

impl LawOutput {
    /// A wish without an optimiser's account.
    pub fn wish(wish_um: f64) -> Self {
        Self {
            wish_um,
            solver: SolverReport::default(),
        }
    }
}

/// A control law: immutable configuration, a state apart from it.
///
/// `start` and the making of the law may allocate; `step`, `applied`, `follow`, `skip` and `record` run in a tick, so they must
/// neither allocate, block nor panic. Their results must depend on their arguments alone: then a recorded run
/// replays to the bit.
pub trait ControlLaw: Debug + Send + 'static {
    /// State from tick to tick, including workspaces.
    type State: Debug + Send + 'static;

    /// A state at rest at a command, um.
    fn start(&self, command_um: f64) -> Self::State;

    /// A tick that the law decides.
    fn step(&self, state: &mut Self::State, input: &LawInput) -> LawOutput;

    /// Result of this tick's [`ControlLaw::step`], for anti-windup: `applied_um` is the command after the limits, minus everything that the
    /// loop added.
    fn applied(
        &self,
        _state: &mut Self::State,
        _input: &LawInput,
        _wish_um: f64,
        _applied_um: f64,
    ) {
    }

    /// A tick without the law (freeze, park, arming, no bead seen yet), with its command `command_um`. A law with memory follows, so that it
    /// takes over without a bump.
    fn follow(&self, _state: &mut Self::State, _input: &LawInput, _command_um: f64) {}

    /// Multiplies the displacements in the state, but not positions of the bead, by the factor by which the gain in force has changed
    /// between two ticks ([`Tuning::gain`]). The law then continues without a bump.
    fn rescale(&self, _state: &mut Self::State, _ratio: f64) {}

    /// Shifts the displacements in the state with a known move of the zero flow ([`crate::LoopInput::zero_flow_shift_um`]), um in the units of
    /// [`LawInput`]. Displacements relative to the zero flow stay.
    fn shift(&self, _state: &mut Self::State, _by_um: f64) {}

    /// A skipped tick: the command was held.
    fn skip(&self, _state: &mut Self::State) {}

    /// References of the coming ticks that a step can use; the loop itself looks some ticks ahead.
    fn preview_len(&self) -> usize {
        0
    }

    /// Names of its columns in the record, at most [`LAW_COLUMNS`], with the unit in the name and the law's name before it.
    fn columns(&self) -> &'static [&'static str] {
        &[]
    }

    /// Writes their values after a tick; `out` is as long as [`ControlLaw::columns`].
    fn record(&self, _state: &Self::State, _out: &mut [f32]) {}
}

/// How long an optimising controller may take in a tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum SolverTerms {
    /// No limit: the virtual clock.
    #[default]
    Unlimited,
    /// Until then; the time that it took is reported.
    Until(std::time::Instant),
    /// A recorded tick again: it ends as it ended then, after as many iterations. Without this a deadline would not
    /// replay to the bit.
    Recorded(SolverStatus, u8),
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
    /// No plan of this tick (infeasible, or nothing usable): the shifted previous plan was used.
    PreviousPlan = 2,
    /// No plan was left: PI was used.
    FallbackPi = 3,
    /// Out of time or iterations: the best point within the limits that was at hand was used.
    Feasible = 4,
}

impl SolverStatus {
    /// The status of a number in a record; anything unknown counts as not used.
    pub fn from_number(number: u8) -> Self {
        match number {
            1 => Self::Solved,
            2 => Self::PreviousPlan,
            3 => Self::FallbackPi,
            4 => Self::Feasible,
            _ => Self::NotUsed,
        }
    }
}

/// Status and cost of the optimiser in a tick.
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
