//! One tick of the loop as a pure function of what came in: life cycle, freshness, arming, control, limits, account.
//!
//! # The loop contract
//! 1. A tick starts on the arrival of a frame; a timer stands in when frames stop.
//! 2. The measurement ring is drained: the newest is kept, the rest counted.
//! 3. The age of the newest is checked by frame id AND mid-exposure time stamp.
//! 4. Estimate. 5. Controller. 6. Finite, range, slew.
//! 7. The command goes into the actuator ring.
//! 8. The tick's record goes into the recorder ring (full: dropped, counted, the sequence number runs on).
//!
//! Steps 3 to 6 are [`Core::step`]; the drivers ([`crate::live`], [`crate::virtual_run`]) do the rest around it. The
//! core knows no clock and no device: its input is [`TickInput`], so that the same code runs in real time, on a
//! virtual clock, and in a replay of a recorded run, to the bit. A step allocates nothing, takes no lock, makes no
//! system call, formats nothing and logs nothing.
//!
//! Late means that a command was handed over later than the tick's start plus its budget; the driver finds out and
//! tells the core with the next tick. Late ticks are counted, never made up for. N late or stale ticks in a row latch
//! [`Life::Safe`].

use crate::arming::{Arming, ArmingConfig, ArmingState, Step};
use crate::guide::{Guide, GuideInput, GuideOutput, Stage};
use crate::learners::Learners;
use crate::life::{EventKind, Events, FreezeReason, Life, Request, SafeReason};
use crate::tick::Tick;
pub use crate::tick::{Action, Counts, TickInput, TickOutput};
use crate::tick_record::{TickFlags, TickRecord};
pub use crate::timing::{CoreError, Timing};
use cellpos_control::{
    Controller, CycleLearning, LoopConfig, LoopInput, LoopOutput, LoopState,
    Measurement as LoopMeasurement, Mode, PlantMonitor, PlantMonitorState, SolverStatus,
    SolverTerms,
};
use cellpos_link::{BoardState, Fault};
use cellpos_plant::TransferFunction;
use cellpos_rig::BoardReport;
use cellpos_units::Seconds;
use cellpos_vision::Decision;
use std::ops::Range;

#[derive(Debug, Clone, Copy, PartialEq)]
struct State {
    seq: u64,
    counts: Counts,
    life: Life,
    safe_reason: Option<SafeReason>,
    last_time_ns: i64,
    control: LoopState,
    arming: ArmingState,
    /// Tick at which the loop was closed.
    running_since: u64,
    last_frame: Option<(u64, i64)>,
    stale_in_a_row: u32,
    late_in_a_row: u32,
    refused_in_a_row: u32,
    /// Ticks in a row without a position that was used.
    missing: u32,
    frames_silent: bool,
    coasting_since: Option<u64>,
    frozen: Option<(FreezeReason, u64)>,
    stuck_since: Option<u64>,
    saturated_since: Option<u64>,
    board: Option<BoardReport>,
    board_heard_ns: i64,
    parked_at: Option<u64>,
    plant: PlantMonitorState,
    stage: Stage,
}

/// The loop, ready to tick.
#[derive(Debug)]
pub struct Core<R> {
    controller: Controller,
    guide: R,
    timing: Timing,
    arming: Arming,
    sample_s: f64,
    preview_um: Vec<f64>,
    learners: Learners,
    late_solver_ns: Vec<Range<i64>>,
    monitor: PlantMonitor,
    state: State,
}

impl<R: Guide> Core<R> {
    /// Builds the loop for a board that is armed and stands at `displacement_um`, with `neutral_um` as the first belief
    /// of the displacement at which the bead rests.
    ///
    /// # Errors
    /// A value that cannot be, named.
    pub fn new(
        config: LoopConfig,
        guide: R,
        timing: Timing,
        arming: ArmingConfig,
        plant: &TransferFunction,
        displacement_um: f64,
        neutral_um: f64,
    ) -> Result<Self, CoreError> {
        timing.validate()?;
        let controller = Controller::new(config)?;
        let sample_s = timing.period_us * 1e-6;
        let arming = Arming::new(
            arming,
            plant,
            Seconds(sample_s),
            Seconds(timing.camera_delay_ms * 1e-3),
        )?;
        let monitor = PlantMonitor::new(config.estimator, config.model)?;
        let control = controller.start(displacement_um, neutral_um);
        Ok(Self {
            preview_um: vec![0.0; controller.preview_len()],
            controller,
            guide,
            timing,
            arming,
            sample_s,
            learners: Learners::default(),
            late_solver_ns: Vec::new(),
            monitor,
            state: State {
                plant: monitor.start(displacement_um),
                seq: 0,
                counts: Counts::default(),
                life: Life::Armed,
                safe_reason: None,
                last_time_ns: 0,
                control,
                arming: ArmingState::default(),
                running_since: 0,
                last_frame: None,
                stale_in_a_row: 0,
                late_in_a_row: 0,
                refused_in_a_row: 0,
                missing: 0,
                frames_silent: false,
                coasting_since: None,
                frozen: None,
                stuck_since: None,
                saturated_since: None,
                board: None,
                board_heard_ns: 0,
                parked_at: None,
                stage: Stage::None,
            },
        })
    }

    /// The same loop with learning over the cycles of its guide's only periodic motion.
    #[must_use]
    pub fn with_learning(self, learning: CycleLearning) -> Self {
        self.with_learners(Learners::new(vec![Some(learning)]))
    }

    /// The same loop with learning over the cycles of its guide's periodic motions.
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

    /// What is being learned over cycles.
    pub fn learners(&self) -> &Learners {
        &self.learners
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

    /// Time since the loop was closed, s; `None` when it is not.
    pub fn running_for_s(&self) -> Option<f64> {
        (self.state.life == Life::Running)
            .then(|| self.state.seq.saturating_sub(self.state.running_since) as f64 * self.sample_s)
    }

    /// Who says where the bead is to be.
    pub fn guide(&self) -> &R {
        &self.guide
    }

    /// One tick.
    pub fn step(&mut self, input: &TickInput) -> TickOutput {
        let mut tick = Tick {
            seq: self.state.seq,
            time_ns: input.time_ns,
            flags: TickFlags::default(),
            events: Events::default(),
        };
        if tick.seq == 0 {
            tick.event(EventKind::Armed);
            self.state.board_heard_ns = input.time_ns;
        } else {
            self.catch_up(input.time_ns, &mut tick);
        }
        self.state.last_time_ns = input.time_ns;
        let fix = self.check_frame(input, &mut tick);
        self.check_driver(input, &mut tick);
        self.check_board(input, &mut tick);
        match input.request {
            Request::Park => self.latch(SafeReason::Operator, &mut tick),
            Request::Freeze | Request::Pause => self.freeze(FreezeReason::Operator, &mut tick),
            Request::None | Request::Skip => {
                if input.request == Request::Skip {
                    tick.event(EventKind::StepSkipped);
                }
                if matches!(self.state.frozen, Some((FreezeReason::Operator, _))) {
                    self.thaw(&mut tick);
                }
            }
        }
        let mode = self.advance_life(fix.map(|fix| fix.position_um), &mut tick);
        let (output, guided) = self.control(fix, input, mode, &mut tick);
        if output.requested_um.is_nan() {
            self.latch(SafeReason::NotFinite, &mut tick);
        }
        self.account(&output, &mut tick);
        let action = self.action(&output, tick.seq);
        self.count(input, &output, tick.flags);
        let record = self.record(input, &output, &guided, tick.flags);
        self.state.seq += 1;
        TickOutput {
            action,
            record,
            events: tick.events,
        }
    }

    /// Accounts for ticks that never came: the last command was held, the bead moved on.
    fn catch_up(&mut self, time_ns: i64, tick: &mut Tick) {
        const MOST: i64 = 100;
        let period = self.timing.period_ns();
        let skipped = (time_ns - self.state.last_time_ns + period / 2) / period - 1;
        if skipped <= 0 {
            return;
        }
        tick.event(EventKind::TicksSkipped {
            count: skipped as u64,
        });
        self.state.counts.skipped += skipped as u64;
        for _ in 0..skipped.min(MOST) {
            self.controller.skip(&mut self.state.control);
            let control = &self.state.control;
            let (neutral_um, held_um) =
                (control.estimator.neutral_um, control.previous_command_um());
            self.monitor
                .step(&mut self.state.plant, None, neutral_um, held_um);
        }
    }

    /// Freshness by id and by time stamp; gives the measurement that may be controlled on.
    fn check_frame(&mut self, input: &TickInput, tick: &mut Tick) -> Option<LoopMeasurement> {
        let Some(m) = &input.measurement else {
            tick.flags.set(TickFlags::TIMER);
            self.state.frames_silent = true;
            return None;
        };
        self.state.frames_silent = false;
        let age_ns = input.time_ns - m.mid_exposure_ns;
        let mut stale = false;
        if let Some((last_id, last_exposure_ns)) = self.state.last_frame {
            if m.frame_id <= last_id {
                tick.flags.set(TickFlags::DOUBLED_FRAME);
                tick.event(EventKind::FrameRepeated {
                    frame_id: m.frame_id,
                });
                stale = true;
            } else {
                let expected = m.frame_id - last_id;
                let arrived = u64::from(input.drained.max(1));
                if arrived > expected {
                    // More frames than ids: some came twice, or one of them is older than the last tick's.
                    tick.flags.set(TickFlags::DOUBLED_FRAME);
                    tick.event(EventKind::FrameRepeated {
                        frame_id: m.frame_id,
                    });
                }
                let missing = expected.saturating_sub(arrived);
                if missing > 0 {
                    tick.flags.set(TickFlags::DROPPED_FRAME);
                    tick.event(EventKind::FramesDropped { count: missing });
                    self.state.counts.frames_lost += missing;
                }
                if m.mid_exposure_ns <= last_exposure_ns {
                    tick.event(EventKind::FrameStale {
                        age_ms: age_ns as f64 * 1e-6,
                    });
                    stale = true;
                }
            }
        }
        if !stale && age_ns > Timing::ms_to_ns(self.timing.oldest_ms) {
            tick.event(EventKind::FrameStale {
                age_ms: age_ns as f64 * 1e-6,
            });
            stale = true;
        }
        if stale {
            tick.flags.set(TickFlags::STALE);
            self.state.stale_in_a_row += 1;
            if self.state.stale_in_a_row >= self.timing.faults_in_a_row {
                self.latch(SafeReason::StaleFrames, tick);
            }
            return None;
        }
        self.state.stale_in_a_row = 0;
        self.state.last_frame = Some((m.frame_id, m.mid_exposure_ns));
        if !m.is_usable() {
            tick.flags.set(TickFlags::LOST);
            return None;
        }
        if matches!(m.track, Some((_, Decision::Reacquired))) {
            tick.event(EventKind::BeadReacquired {
                position_um: m.position_um,
            });
            self.state.counts.reacquired += 1;
        }
        let beyond_ns = age_ns - Timing::ms_to_ns(self.timing.camera_delay_ms);
        let period = self.timing.period_ns();
        let age_samples =
            ((beyond_ns + period / 2).max(0) / period).min(i64::from(u16::MAX)) as u16;
        Some(LoopMeasurement {
            position_um: m.position_um,
            variance_um2: m.variance_um2,
            age_samples,
            offset_samples: (beyond_ns - i64::from(age_samples) * period) as f64 / period as f64,
        })
    }

    /// What the driver says of the previous tick.
    fn check_driver(&mut self, input: &TickInput, tick: &mut Tick) {
        match input.previous_late_ns {
            Some(compute_ns) => {
                tick.event(EventKind::LateTick {
                    compute_us: f64::from(compute_ns) * 1e-3,
                });
                self.state.late_in_a_row += 1;
                if self.state.late_in_a_row >= self.timing.faults_in_a_row {
                    self.latch(SafeReason::LateTicks, tick);
                }
            }
            None => self.state.late_in_a_row = 0,
        }
        if input.previous_refused {
            self.state.refused_in_a_row += 1;
            if self.state.refused_in_a_row >= self.timing.faults_in_a_row {
                self.latch(SafeReason::ActuatorRingFull, tick);
            }
        } else {
            self.state.refused_in_a_row = 0;
        }
    }

    /// What the board says, or its silence.
    fn check_board(&mut self, input: &TickInput, tick: &mut Tick) {
        if let Some(report) = input.board {
            tick.flags.set(TickFlags::BOARD_HEARD);
            self.state.board_heard_ns = input.time_ns;
            let before = self.state.board.replace(report);
            let unchanged = |b: BoardReport| b.state == report.state && b.fault == report.fault;
            if !before.is_some_and(unchanged) {
                tick.event(EventKind::BoardChanged {
                    state: report.state,
                    fault: report.fault,
                });
            }
            let damaged = report
                .bad_frames
                .saturating_sub(before.map_or(0, |b| b.bad_frames));
            if damaged > 0 {
                tick.event(EventKind::LinkGarbage { count: damaged });
            }
            if !matches!(report.state, BoardState::Armed | BoardState::Running) {
                self.latch(SafeReason::Board, tick);
            }
        } else if input.time_ns - self.state.board_heard_ns
            > Timing::ms_to_ns(self.timing.board_silence_ms)
        {
            self.latch(SafeReason::LinkLost, tick);
        }
    }

    /// Life cycle; gives what the controller is to do.
    fn advance_life(&mut self, position_um: Option<f64>, tick: &mut Tick) -> Mode {
        if self.state.life == Life::Armed {
            let held = self.state.control.previous_command_um();
            let neutral_um = self.state.control.estimator.neutral_um;
            let arming = &mut self.state.arming;
            match self.arming.step(arming, position_um, held, neutral_um) {
                Step::Command(command_um) => return Mode::Direct(command_um),
                Step::Done(verdict) => match verdict.refusal {
                    Some(refusal) => {
                        tick.event(EventKind::ArmingRefused {
                            refusal,
                            gain_ratio: verdict.gain_ratio,
                            ci95: verdict.ci95,
                        });
                        self.latch(SafeReason::ArmingRefused, tick);
                    }
                    None => {
                        if verdict.gain_ratio.is_finite() {
                            tick.event(EventKind::ArmingPassed {
                                gain_ratio: verdict.gain_ratio,
                                ci95: verdict.ci95,
                            });
                        }
                        tick.event(EventKind::Running);
                        self.state.life = Life::Running;
                        self.state.running_since = tick.seq;
                        self.state.missing = 0;
                    }
                },
            }
        }
        if self.state.life == Life::Running {
            let cause = if self.state.frames_silent {
                (FreezeReason::CameraStalled, SafeReason::CameraLost)
            } else {
                (FreezeReason::BeadLost, SafeReason::BeadLost)
            };
            if self.state.missing >= self.timing.lost_ticks {
                self.latch(cause.1, tick);
            } else if self.state.missing >= self.timing.coast_ticks {
                self.freeze(cause.0, tick);
            } else if self.state.missing == 0
                && matches!(self.state.frozen, Some((reason, _)) if reason != FreezeReason::Operator)
            {
                self.thaw(tick);
            }
        }
        match (self.state.life, self.state.frozen) {
            (Life::Running, None) => Mode::Run,
            (Life::Running, Some(_)) => {
                tick.flags.set(TickFlags::FREEZE);
                Mode::Freeze
            }
            _ => Mode::Park,
        }
    }

    fn control(
        &mut self,
        fix: Option<LoopMeasurement>,
        input: &TickInput,
        mode: Mode,
        tick: &mut Tick,
    ) -> (LoopOutput, GuideOutput) {
        let running = self.state.life == Life::Running;
        let since = if running {
            self.state.seq - self.state.running_since
        } else {
            0
        };
        let length_um = input.measurement.map(|m| m.length_um);
        let told = GuideInput {
            running,
            frozen: mode == Mode::Freeze,
            skip: running && input.request == Request::Skip,
            tick: since,
            sample_s: self.sample_s,
            position_um: fix.map(|fix| fix.position_um),
            age_ticks: fix.map_or(0, |fix| fix.age_samples),
            length_um: length_um.filter(|um| fix.is_some() && um.is_finite()),
        };
        let guided = self.guide.step(&told, &mut self.preview_um);
        if guided.stage != self.state.stage {
            self.state.stage = guided.stage;
            if guided.stage != Stage::None {
                tick.event(EventKind::Script {
                    stage: guided.stage,
                });
            }
        }
        let given = LoopInput {
            measurement: fix,
            reference_um: guided.reference_um,
            preview_um: &self.preview_um,
            mode,
            solver: self.solver_terms(input),
            learned_um: self.learners.addition_um(
                guided.motion,
                guided.phase.filter(|_| mode == Mode::Run),
                guided.reference_um,
            ),
            excitation_um: self.guide.excitation_um(),
        };
        let output = self.controller.step(&mut self.state.control, &given);
        let nominal = self.timing.camera_delay_ms * 1e-3 / self.sample_s;
        let used = fix.filter(|_| !output.flags.coasting && !output.flags.stuck);
        self.learners.learn(used.map(|fix| {
            let age = nominal + f64::from(fix.age_samples) + fix.offset_samples;
            (fix.position_um, age)
        }));
        self.watch_plant(fix, &output, tick);
        (output, guided)
    }

    fn solver_terms(&self, input: &TickInput) -> SolverTerms {
        let late = |span: &Range<i64>| span.contains(&input.time_ns);
        if self.late_solver_ns.iter().any(late) {
            SolverTerms::Recorded(SolverStatus::PreviousPlan)
        } else {
            input.solver
        }
    }

    /// Gain and lag of the plant from its motion; their changes are events.
    fn watch_plant(&mut self, fix: Option<LoopMeasurement>, output: &LoopOutput, tick: &mut Tick) {
        // Increments are those of one tick only between frames that are on time.
        let on_time = fix.filter(|fix| fix.age_samples == 0 && fix.offset_samples.abs() < 0.2);
        let before = self.monitor.verdict(&self.state.plant);
        let verdict = self.monitor.step(
            &mut self.state.plant,
            on_time.map(|fix| fix.position_um),
            output.neutral_um,
            output.command_um,
        );
        if verdict != before && self.state.life == Life::Running {
            let estimate = self.monitor.estimate(&self.state.plant);
            tick.event(EventKind::PlantChanged {
                verdict,
                gain_ratio: estimate.map_or(f64::NAN, |e| e.gain_ratio),
                lag_ms: estimate.map_or(f64::NAN, |e| e.lag_ms),
            });
        }
    }

    /// Flags and events that follow from the controller's output.
    fn account(&mut self, output: &LoopOutput, tick: &mut Tick) {
        let flags = output.flags;
        for (set, mask) in [
            (flags.range_limited, TickFlags::RANGE_LIMITED),
            (flags.slew_limited, TickFlags::SLEW_LIMITED),
            (flags.not_finite, TickFlags::NOT_FINITE),
            (flags.coasting, TickFlags::COASTING),
            (flags.gated, TickFlags::GATED),
        ] {
            if set {
                tick.flags.set(mask);
            }
        }
        self.state.missing = if flags.coasting {
            self.state.missing.saturating_add(1)
        } else {
            0
        };
        if self.state.life != Life::Running {
            return;
        }
        /// A gap shorter than this is the daily bread of a camera and no event of its own.
        const WORTH_AN_EVENT: u32 = 3;
        let coasts = self.state.missing >= WORTH_AN_EVENT
            || (self.state.coasting_since.is_some() && self.state.missing > 0);
        tick.span(
            &mut self.state.coasting_since,
            coasts,
            self.timing.period_us,
            EventKind::CoastingStarted,
            |lasted_ms| EventKind::CoastingEnded { lasted_ms },
        );
        tick.span(
            &mut self.state.stuck_since,
            flags.stuck,
            self.timing.period_us,
            EventKind::StuckStarted,
            |lasted_ms| EventKind::StuckEnded { lasted_ms },
        );
        tick.span(
            &mut self.state.saturated_since,
            flags.range_limited,
            self.timing.period_us,
            EventKind::SaturationStarted,
            |lasted_ms| EventKind::SaturationEnded { lasted_ms },
        );
    }

    fn action(&mut self, output: &LoopOutput, seq: u64) -> Action {
        /// Ticks after which an order to park that the board has not confirmed is given again.
        const REPEAT: u64 = 10;
        if self.state.life != Life::Safe {
            return Action::Command {
                command_um: output.command_um,
                neutral_um: output.neutral_um,
            };
        }
        let confirmed = self
            .state
            .board
            .is_some_and(|b| matches!(b.state, BoardState::Safe | BoardState::Disarmed));
        match self.state.parked_at {
            Some(at) if confirmed || seq < at + REPEAT => Action::None,
            _ => {
                self.state.parked_at = Some(seq);
                Action::Park
            }
        }
    }

    fn count(&mut self, input: &TickInput, output: &LoopOutput, flags: TickFlags) {
        let counts = &mut self.state.counts;
        counts.ticks += 1;
        counts.superseded += u64::from(input.drained.saturating_sub(1));
        counts.late += u64::from(input.previous_late_ns.is_some());
        counts.refused += u64::from(input.previous_refused);
        match output.solver.status {
            SolverStatus::PreviousPlan => counts.plans_reused += 1,
            SolverStatus::FallbackPi => counts.solver_fallbacks += 1,
            SolverStatus::NotUsed | SolverStatus::Solved => {}
        }
        for (mask, counter) in [
            (TickFlags::TIMER, &mut counts.timer),
            (TickFlags::STALE, &mut counts.stale),
            (TickFlags::LOST, &mut counts.fixes_lost),
            (TickFlags::GATED, &mut counts.gated),
            (TickFlags::COASTING, &mut counts.coasted),
            (TickFlags::FREEZE, &mut counts.frozen),
            (TickFlags::RANGE_LIMITED, &mut counts.range_limited),
            (TickFlags::SLEW_LIMITED, &mut counts.slew_limited),
        ] {
            *counter += u64::from(flags.has(mask));
        }
    }

    fn latch(&mut self, reason: SafeReason, tick: &mut Tick) {
        if self.state.life != Life::Safe {
            self.state.life = Life::Safe;
            self.state.safe_reason = Some(reason);
            self.state.frozen = None;
            tick.event(EventKind::SafeLatched { reason });
        }
    }

    fn freeze(&mut self, reason: FreezeReason, tick: &mut Tick) {
        if self.state.life == Life::Running && self.state.frozen.is_none() {
            self.state.frozen = Some((reason, tick.seq));
            tick.event(EventKind::FreezeStarted { reason });
        }
    }

    fn thaw(&mut self, tick: &mut Tick) {
        if let Some((_, since)) = self.state.frozen.take() {
            tick.event(EventKind::FreezeEnded {
                lasted_ms: (tick.seq - since) as f64 * self.timing.period_us * 1e-3,
            });
        }
    }

    fn record(
        &self,
        input: &TickInput,
        output: &LoopOutput,
        guided: &GuideOutput,
        flags: TickFlags,
    ) -> TickRecord {
        let m = input.measurement;
        let (last_id, last_exposure) = self.state.last_frame.unwrap_or((0, 0));
        TickRecord {
            seq: self.state.seq,
            time_ns: input.time_ns,
            frame_id: m.map_or(last_id, |m| m.frame_id),
            mid_exposure_ns: m.map_or(last_exposure, |m| m.mid_exposure_ns),
            measured_um: m.map_or(f64::NAN, |m| m.position_um),
            variance_um2: m.map_or(f64::NAN, |m| m.variance_um2),
            verdict: m.map_or(255, |m| m.verdict as u8),
            track: m
                .and_then(|m| m.track)
                .map_or(255, |(state, _)| state as u8),
            decision: m
                .and_then(|m| m.track)
                .map_or(255, |(_, decision)| decision as u8),
            target_um: guided.reference_um,
            plan_ns: guided.plan_ns,
            stage: guided.stage as u8,
            length_um: m.map_or(f64::NAN, |m| m.length_um),
            estimate_um: output.estimate_um,
            neutral_um: output.neutral_um,
            requested_um: output.requested_um,
            command_um: output.command_um,
            applied_um: self.state.board.map_or(f64::NAN, |b| b.applied_um),
            true_um: m.map_or(f64::NAN, |m| m.true_um),
            life: self.state.life as u8,
            request: input.request as u8,
            board: self.state.board.map_or(255, |b| b.state as u8),
            board_fault: self
                .state
                .board
                .map_or(Fault::None as u8, |b| b.fault as u8),
            flags,
            drained: input.drained.min(255) as u8,
            wake_ns: 0,
            compute_ns: 0,
            solver_status: output.solver.status as u8,
            solver_iterations: output.solver.iterations.min(255) as u8,
            solver_active: output.solver.active.min(255) as u8,
            solver_ns: output.solver.solve_ns,
            controller_state: self.controller.control_loop().pack(&self.state.control),
        }
    }
}
