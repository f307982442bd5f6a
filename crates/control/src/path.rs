//! The path of the reference: the command that moves the model along it, and the part of the motion that this command causes.
//!
//! The reference is known in advance, so no law has to find the command that follows it: the loop adds that command, and the law corrects
//! the rest. A jump that no preview announced moves the path at once and is left to the law.

use crate::error::BuildError;
use crate::exposure::Past;
use crate::feedforward::{FeedForward, FeedForwardState, Reach};
use crate::law::LawInput;
use crate::limits::Limits;
use crate::loop_model::LoopModel;

/// Part of a tick's slew that a planned move leaves to the correction, um of PZT: two standard deviations of the correction in a hold.
/// Without it the correction comes late, and a jump at 5 kHz takes 3.6 ms instead of 3.
const RESERVE_UM: f64 = 0.1;

/// The path for one model, range and slew.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Path {
    forward: FeedForward,
    reach: Reach,
    feedthrough: f64,
}

/// State of the path.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct PathState {
    /// The model on the path.
    on: FeedForwardState,
    announced_um: Option<f64>,
    /// Motion of the model by the feed-forward since the law took over.
    made: Past,
}

impl Path {
    pub(crate) fn new(model: &LoopModel, limits: &Limits) -> Result<Self, BuildError> {
        Ok(Self {
            forward: FeedForward::new(model)?,
            reach: Reach::of(limits, model.sample_time_s).with_reserve(RESERVE_UM),
            feedthrough: model.feedthrough,
        })
    }

    /// A tick without the law: the path is at the reference.
    pub(crate) fn rest(state: &mut PathState, reference_um: f64) {
        *state = PathState {
            on: FeedForward::rest(reference_um),
            ..PathState::default()
        };
    }

    /// Before the law: the path is brought to the reference of this tick, and the law's input onto the path. Its fix is of an exposure
    /// `age_ticks` old that lasted `exposure_ticks`.
    pub(crate) fn meet(
        &self,
        state: &mut PathState,
        input: &mut LawInput,
        age_ticks: f64,
        exposure_ticks: f64,
    ) {
        let announced_um = state.announced_um;
        self.forward
            .meet_announced(&mut state.on, input.reference_um, announced_um);
        let made_um = state.made.now();
        let seen_um = state.made.seen(age_ticks, exposure_ticks);
        input.reference_um = self.forward.position(&state.on);
        input.bead_um += made_um - seen_um.unwrap_or(made_um);
        input.fed_um = made_um;
        input.on_path = state.on;
        input.feed_forward_um = self.step(state, input);
    }

    /// The command of this tick that moves the model along the path, um from neutral: the law's input gets it.
    fn step(&self, state: &mut PathState, input: &LawInput) -> f64 {
        let reach = self
            .reach
            .about_neutral(input.estimate.neutral_um, input.tuning.gain);
        let before = state.on;
        let next_um = |ahead| input.preview(ahead);
        let command_um = self.forward.within(&before, next_um, &reach);
        self.forward.drive(&mut state.on, command_um);
        let moved_um = self.forward.position(&state.on) - self.forward.position(&before);
        let jump_um = self.feedthrough * (command_um - before.last_um);
        state.made.push(state.made.now() + moved_um, jump_um);
        state.announced_um = input.preview_um.first().copied();
        command_um
    }
}
