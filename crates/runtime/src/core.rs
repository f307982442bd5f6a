//! One tick of the loop as a pure function of what came in: life cycle, freshness, arming, control, limits, account.
//!
//! # The loop contract
//! 0. Time is the clock's: each tick has its number on a [`Grid`] of the period. It advances plan, controller, estimator and learner by the
//!    steps since the tick before: one, or more if ticks were skipped.
//! 1. A tick starts on the arrival of a new frame; a timer replaces frames that stop. A frame that is not new starts none.
//! 2. The measurement ring is drained: the newest is kept, the rest counted.
//! 3. The newest is checked by frame id AND mid-exposure time stamp, see [`cellpos_rig::freshness`].
//! 4. Estimate. 5. Controller. 6. Finite, range, slew.
//! 7. The command goes into the actuator ring.
//! 8. The tick's record goes into the recorder ring (full: dropped, counted, the sequence number runs on).
//!
//! Steps 4 to 6 are [`Core::step`]; the drivers ([`crate::live`], [`crate::virtual_run`]) do the rest around it. The core knows no clock
//! and no device: its input is [`TickInput`]. The same code runs in real time, on a virtual clock, and in a replay of a recorded run, to
//! the bit. A step allocates nothing, takes no lock, makes no system call, formats nothing and logs nothing.
//!
//! Late means that a command was handed over later than the tick's start plus its budget; the driver finds out and
//! tells the core with the next tick. Late ticks are counted, never made up for. N late or stale ticks in a row latch
//! [`Life::Safe`].

mod account;
mod checks;
mod following;
mod in_force;
mod life_cycle;
mod partner;
mod rest;
mod watches;

use crate::arming::{Arming, ArmingConfig, ArmingState};
use crate::grid::{Beat, Grid};
use crate::learners::Learners;
use crate::life::{EventKind, Events, FreezeReason, Life, Request, SafeReason};
use crate::reference::{ReferenceGenerator, ReferenceInput, ReferenceOutput, Stage};
use crate::tick::Tick;
pub use crate::tick::{Action, Counts, TickInput, TickOutput};
use crate::tick_record::TickFlags;
pub use crate::timing::{CoreError, Timing};
use cellpos_control::{
    Controller, CycleLearning, LoopConfig, LoopInput, LoopOutput, Measurement as LoopMeasurement,
    Mode, Partner, SolverStatus, SolverTerms,
};
use cellpos_numeric::units::Seconds;
use cellpos_plant::TransferFunction;
use cellpos_rig::ActuatorReport;
use std::ops::Range;

#[derive(Debug, Clone, Copy, PartialEq)]
struct State {
    seq: u64,
    grid: Option<Grid>,
    /// Number of the last tick on the grid.
    index: u64,
    beat: Beat,
    counts: Counts,
    life: Life,
    safe_reason: Option<SafeReason>,
    last_time_ns: i64,
    arming: ArmingState,
    /// Tick on the grid at which the loop was closed.
    running_since: u64,
    last_frame: Option<(u64, i64)>,
    stale_in_a_row: u32,
    /// Until when frames may be old because this machine stalled, ns.
    caught_up_ns: i64,
    late_in_a_row: u32,
    /// Steps of the grid in a row without a position that was used, and the steps among these that count as a loss.
    blind: u32,
    missing: u32,
    /// Ticks in a row without a frame.
    frameless: u32,
    /// The newest position that was used and the ticks that it is older than the camera path, for those in between.
    newest: Option<(f64, u16)>,
    early_since_ns: Option<i64>,
    near_limit: bool,
    vision_slow_since_ns: Option<i64>,
    coasting_since_ns: Option<i64>,
    frozen: life_cycle::FreezeReasons,
    frozen_since_ns: i64,
    stuck_since_ns: Option<i64>,
    stuck_told: bool,
    saturated_since_ns: Option<i64>,
    board: Option<ActuatorReport>,
    board_heard_ns: i64,
    /// Ticks in a row without a report of the board.
    unheard: u32,
    /// Ticks in a row in which a command was lost, or the board's watchdog held the zero flow.
    unled: u32,
    /// Displacement at the PZT, and the zero flow in the last command, um.
    in_force: in_force::Board,
    told_um: f64,
    following: following::Following,
    pauses: watches::Pauses,
    /// It was found that the bead does not feel the commands.
    clipped: bool,
    /// Where the flow stands still, for a PZT that has to stop without a bead to tell.
    rest: rest::Rest,
    newest_zero_flow: rest::ZeroFlow,
    /// That of the freeze in force, um.
    rest_um: f64,
    /// Frames in a row that were the picture before.
    pictures_repeated: u32,
    parked_at: Option<u64>,
    unrecorded_since_ns: Option<i64>,
    partner: partner::Slow,
    stage: Stage,
}

/// The loop, ready to tick.
#[derive(Debug)]
pub struct Core<R> {
    controller: Controller,
    reference: R,
    timing: Timing,
    arming: Arming,
    sample_s: f64,
    diffusion_um2_per_s: f64,
    /// Ticks in a row that may be without a frame: those between two frames of a slower camera.
    planned_gap: u32,
    preview_um: Vec<f64>,
    learners: Learners,
    late_solver_ns: Vec<Range<i64>>,
    partner: Option<Partner>,
    references: crate::reference_history::ReferenceHistory,
    state: State,
}

impl<R: ReferenceGenerator> Core<R> {
    /// Builds the loop for a board that is armed and stands at `displacement_um`, with `neutral_um` as the first belief
    /// of the displacement at which the bead rests.
    ///
    /// # Errors
    /// A value that cannot be, named.
    pub fn new(
        config: LoopConfig,
        reference: R,
        timing: Timing,
        arming: ArmingConfig,
        plant: &TransferFunction,
        displacement_um: f64,
        neutral_um: f64,
    ) -> Result<Self, CoreError> {
        let controller = Controller::new(config)?;
        let at = [displacement_um, neutral_um];
        Self::with_controller(controller, reference, timing, arming, plant, at)
    }

    /// The same with any controller, so with a control law of another crate ([`Controller::with_law`]); `at_um` is the
    /// board's displacement and the first belief of that at which the bead rests.
    ///
    /// # Errors
    /// A value that cannot be, named.
    pub fn with_controller(
        mut controller: Controller,
        reference: R,
        timing: Timing,
        arming: ArmingConfig,
        plant: &TransferFunction,
        at_um: [f64; 2],
    ) -> Result<Self, CoreError> {
        timing.validate()?;
        let [displacement_um, neutral_um] = at_um;
        let sample_s = timing.period_us * 1e-6;
        let estimator = controller.settings().estimator;
        let arming = Arming::new(
            arming,
            plant,
            &controller.settings().model,
            Seconds(timing.camera_delay_ms * 1e-3),
            estimator.ticks_per_fix,
        )?;
        let settings = controller.settings();
        let following = following::Following::new(
            &settings.estimator,
            &settings.model,
            timing.camera_delay_ms * 1e-3,
        );
        controller.start(displacement_um, neutral_um);
        let zero_flow = rest::ZeroFlow {
            um: neutral_um,
            variance_um2: controller.neutral_variance_um2(),
        };
        Ok(Self {
            preview_um: vec![0.0; controller.preview_len()],
            planned_gap: estimator.planned_gap(),
            controller,
            reference,
            timing,
            arming,
            sample_s,
            diffusion_um2_per_s: estimator.diffusion_um2_per_s,
            learners: Learners::default(),
            late_solver_ns: Vec::new(),
            partner: None,
            references: Default::default(),
            state: State {
                seq: 0,
                grid: None,
                index: 0,
                beat: Beat::default(),
                counts: Counts::default(),
                life: Life::Armed,
                safe_reason: None,
                last_time_ns: 0,
                arming: ArmingState::default(),
                running_since: 0,
                last_frame: None,
                stale_in_a_row: 0,
                caught_up_ns: i64::MIN,
                late_in_a_row: 0,
                blind: 0,
                missing: 0,
                frameless: 0,
                newest: None,
                early_since_ns: None,
                near_limit: false,
                vision_slow_since_ns: None,
                coasting_since_ns: None,
                frozen: Default::default(),
                frozen_since_ns: 0,
                stuck_since_ns: None,
                stuck_told: false,
                saturated_since_ns: None,
                board: None,
                board_heard_ns: 0,
                unheard: 0,
                unled: 0,
                in_force: in_force::Board::new(displacement_um, neutral_um),
                told_um: neutral_um,
                following,
                pauses: Default::default(),
                clipped: false,
                rest: rest::Rest::new(zero_flow),
                newest_zero_flow: zero_flow,
                rest_um: neutral_um,
                pictures_repeated: 0,
                parked_at: None,
                unrecorded_since_ns: None,
                partner: partner::Slow::default(),
                stage: Stage::None,
            },
        })
    }

    /// The same loop with learning over the cycles of its reference generator's only periodic motion.
    #[must_use]
    pub fn with_learning(self, learning: CycleLearning) -> Self {
        self.with_learners(Learners::new(vec![Some(learning)]))
    }

    /// The same loop with learning over the cycles of its reference generator's periodic motions.
    #[must_use]
    pub fn with_learners(mut self, learners: Learners) -> Self {
        self.learners = learners;
        self
    }

    /// The same loop with an optimiser that gives no plan in time in these spans of run time, ns: a fault to be got over.
    #[must_use]
    pub fn with_late_solver(mut self, spans_ns: Vec<Range<i64>>) -> Self {
        self.late_solver_ns = spans_ns;
        self
    }

    /// The controller, for the names of its columns in the record.
    pub fn controller(&self) -> &Controller {
        &self.controller
    }

    /// What is being learned over cycles.
    pub fn learners(&self) -> &Learners {
        &self.learners
    }

    /// Time from frame to frame, ns: a period of the loop, or more where the camera is slower.
    pub fn frame_period_ns(&self) -> i64 {
        let ticks = self.controller.settings().estimator.ticks_per_fix;
        (self.timing.period_ns() as f64 * ticks).round() as i64
    }

    /// Where the run stands.
    pub fn life(&self) -> Life {
        self.state.life
    }

    /// Why Safe was latched, if it was.
    pub fn safe_reason(&self) -> Option<SafeReason> {
        self.state.safe_reason
    }

    /// What went wrong so far.
    pub fn counts(&self) -> &Counts {
        &self.state.counts
    }

    /// The times and counts it was built with.
    pub fn timing(&self) -> &Timing {
        &self.timing
    }

    /// Sequence number of the next tick.
    pub(crate) fn next_seq(&self) -> u64 {
        self.state.seq
    }

    /// Who says where the bead is to be.
    pub fn reference(&self) -> &R {
        &self.reference
    }

    /// Number of the last tick on the clock's grid: the periods since the first one.
    pub fn index(&self) -> u64 {
        self.state.index
    }

    /// From when on the next tick may be made, ns since the start of the run; `None`: at any time, it is the first.
    pub fn opens_ns(&self) -> Option<i64> {
        let next =
            i64::try_from(self.state.index).map_or(i64::MAX, |index| index.saturating_add(1));
        self.state.grid.map(|grid| grid.opens_ns(next))
    }

    /// The same loop after this number of ticks.
    #[cfg(test)]
    pub(crate) fn counted_from(mut self, seq: u64) -> Self {
        self.state.seq = seq;
        self.state.counts.ticks = seq;
        self
    }

    /// One tick. `None`, and nothing done: its time has not come ([`Core::opens_ns`]).
    pub fn step(&mut self, input: &TickInput) -> Option<TickOutput> {
        let period_ns = self.timing.period_ns();
        let first = self.state.grid.is_none();
        let grid = *self
            .state
            .grid
            .get_or_insert_with(|| Grid::new(input.time_ns, period_ns));
        let index = if first {
            0
        } else {
            let last = i64::try_from(self.state.index).unwrap_or(i64::MAX);
            u64::try_from(grid.index_after(last, input.time_ns)?).ok()?
        };
        let (periods, late) = self.state.beat.tick(input.time_ns, period_ns);
        let mut tick = Tick {
            seq: self.state.seq,
            time_ns: input.time_ns,
            index,
            steps: (index - self.state.index).max(1),
            periods,
            late,
            flags: TickFlags::default(),
            events: Events::default(),
            frames_disturbed: false,
            commands_disturbed: false,
        };
        let slew_time_s = if first {
            tick.event(EventKind::Armed);
            self.state.board_heard_ns = input.time_ns;
            self.state.in_force.start(input.time_ns);
            None
        } else {
            self.catch_up(&mut tick);
            let since_ns = input.time_ns - self.state.last_time_ns;
            (since_ns < period_ns).then_some(since_ns as f64 * 1e-9)
        };
        self.state.index = index;
        self.state.last_time_ns = input.time_ns;
        let fix = self.check_frame(input, &mut tick);
        self.check_driver(input, &mut tick);
        self.check_board(input, &mut tick);
        match input.request {
            Request::Park => self.latch(SafeReason::Operator, &mut tick),
            Request::Freeze | Request::Pause => self.freeze(FreezeReason::Operator, &mut tick),
            Request::Unrecorded => self.unrecorded(&mut tick),
            Request::None | Request::Skip => {
                if input.request == Request::Skip {
                    tick.event(EventKind::StepSkipped);
                }
                self.thaw(FreezeReason::Operator, &mut tick);
            }
        }
        let mode = self.advance_life(fix, input.request, &mut tick);
        let moved = self.move_partner(input, mode, &mut tick);
        let (output, generated) =
            self.control(fix, input, mode, (slew_time_s, moved.shift_um), &mut tick);
        if output.requested_um.is_nan() {
            self.latch(SafeReason::NotFinite, &mut tick);
        }
        self.account(input, &output, &mut tick);
        let action = self.action(&output, tick.index);
        self.count(input, &output, tick.flags);
        let record = self.record(input, &output, &generated, tick.flags);
        // Wraps after half a thousand million years, and does not panic then.
        self.state.seq = self.state.seq.wrapping_add(1);
        Some(TickOutput {
            action,
            partner_um: moved.command_um,
            record,
            events: tick.events,
        })
    }

    fn control(
        &mut self,
        fix: Option<LoopMeasurement>,
        input: &TickInput,
        mode: Mode,
        (slew_time_s, zero_flow_shift_um): (Option<f64>, f64),
        tick: &mut Tick,
    ) -> (LoopOutput, ReferenceOutput) {
        let running = self.state.life == Life::Running;
        let since = if running {
            tick.index - self.state.running_since
        } else {
            0
        };
        let length_um = input.measurement.map(|m| m.length_um);
        let newest = self.newest_position(fix, input, tick.steps);
        let told = ReferenceInput {
            running,
            frozen: self.state.frozen.any(),
            skip: running && input.request == Request::Skip,
            tick: since,
            sample_s: self.sample_s,
            position_um: newest.map(|(position_um, _)| position_um),
            age_ticks: newest.map_or(0, |(_, age)| age),
            length_um: length_um.filter(|um| fix.is_some() && um.is_finite()),
            target_um: input.target_um,
        };
        let generated = self.reference.step(&told, &mut self.preview_um);
        if generated.stage != self.state.stage {
            self.state.stage = generated.stage;
            if generated.stage != Stage::None {
                tick.event(EventKind::Script {
                    stage: generated.stage,
                });
            }
        }
        let told_um = self.state.told_um;
        let period_ns = self.timing.period_ns();
        let in_force =
            self.state
                .in_force
                .step(input.time_ns, input.board.as_ref(), told_um, period_ns);
        let given = LoopInput {
            in_force,
            measurement: fix,
            reference_um: generated.reference_um,
            preview_um: &self.preview_um,
            mode,
            slew_time_s,
            late_samples: tick.late,
            solver: self.solver_terms(input),
            learned_um: self.learners.addition_um(
                generated.motion,
                generated.phase.filter(|_| mode == Mode::Run),
                generated.reference_um,
            ),
            feed_forward_gain: self.learners.feed_forward_gain(),
            excitation_um: self.reference.excitation_um(),
            zero_flow_shift_um,
        };
        let output = self.controller.step(&given);
        self.watch_rest(fix, &output, tick.steps);
        self.state.told_um = self.state.rest.zero_flow().um;
        let obeyed = in_force.is_none();
        self.watch_following(fix, generated.reference_um, obeyed, &output, tick);
        let nominal = self.timing.camera_delay_ms * 1e-3 / self.sample_s;
        let used = fix.filter(|_| !output.flags.coasting && !output.flags.stuck);
        let seen = used.map(|fix| {
            let age = nominal + f64::from(fix.age_samples) + fix.offset_samples;
            (fix.position_um, age)
        });
        self.learners.learn(seen, &output.driven);
        if let Some(news) = self.controller.adaptation().and_then(|now| now.news) {
            let ms = |samples: f64| samples * self.sample_s * 1e3;
            tick.event(EventKind::Adapted {
                gain_before: news.gain[0],
                gain: news.gain[1],
                delay_before_ms: ms(news.delay_samples[0]),
                delay_ms: ms(news.delay_samples[1]),
                over_s: news.ticks as f64 * self.sample_s,
            });
        }
        (output, generated)
    }

    fn solver_terms(&self, input: &TickInput) -> SolverTerms {
        let late = |span: &Range<i64>| span.contains(&input.time_ns);
        if self.late_solver_ns.iter().any(late) {
            SolverTerms::Recorded(SolverStatus::PreviousPlan, 0)
        } else {
            input.solver
        }
    }
}
