//! What is checked before anything is decided: ticks that never came, the frame, the driver's account, the board.

use super::Core;
use crate::board_watch::BoardTrouble;
use crate::frames::FrameTally;
use crate::life::{EventKind, FreezeReason, Life, SafeReason};
use crate::reference::{ReferenceGenerator, ReferenceInput};
use crate::tick::{Tick, TickInput};
use crate::tick_record::TickFlags;
use crate::timing::Timing;
use cellpos_control::{Driven, Measurement as LoopMeasurement};
use cellpos_rig::{ActuatorReport, ActuatorState};
use cellpos_vision::Decision;

impl<R: ReferenceGenerator> Core<R> {
    /// Accounts for ticks that never came: the last command was held, the bead moved on, and so did the plan. The bead moves by the time that
    /// passed, the plan by the numbers of the ticks.
    pub(super) fn catch_up(&mut self, tick: &mut Tick) {
        /// A loop that stood still for longer has lost sight of the bead; its board's watchdog has parked the PZT.
        const LONGEST_NS: i64 = 1_000_000_000;
        let most = (LONGEST_NS / self.timing.period_ns()).max(1).unsigned_abs();
        for _ in 1..tick.periods.min(most.saturating_add(1)) {
            self.controller.skip();
            let held_um = self.controller.previous_command_um();
            self.state.following.skip(held_um);
        }
        let skipped = tick.steps - 1;
        if skipped == 0 {
            return;
        }
        tick.commands_disturbed = true;
        tick.event(EventKind::TicksSkipped { count: skipped });
        self.state.counts.skipped += skipped;
        let stalled_ns = skipped.min(most).cast_signed() * self.timing.period_ns();
        self.state.caught_up_ns =
            tick.time_ns + stalled_ns + Timing::ms_to_ns(self.timing.oldest_ms);
        if skipped > most {
            self.latch(SafeReason::Stalled, tick);
        }
        let running = self.state.life == Life::Running;
        for index in tick.index.saturating_sub(skipped.min(most))..tick.index {
            let told = ReferenceInput {
                running,
                frozen: self.state.frozen.any(),
                skip: false,
                tick: if running {
                    index - self.state.running_since
                } else {
                    0
                },
                sample_s: self.sample_s,
                position_um: None,
                age_ticks: 0,
                length_um: None,
                target_um: None,
            };
            let passed = self.reference.step(&told, &mut []);
            let phase = passed.phase.filter(|_| running && !self.state.frozen.any());
            self.learners
                .addition_um(passed.motion, phase, passed.reference_um);
            self.learners.learn(None, &Driven::default());
        }
    }

    /// What came from the camera; gives the measurement that may be controlled on.
    pub(super) fn check_frame(
        &mut self,
        input: &TickInput,
        tick: &mut Tick,
    ) -> Option<LoopMeasurement> {
        self.tell_frames(&input.frames, tick);
        let is_slow = input.slow_vision_ns.is_some();
        if is_slow {
            tick.flags.set(TickFlags::VISION_SLOW);
        }
        let slow = EventKind::VisionSlowStarted {
            vision_ms: f64::from(input.slow_vision_ns.unwrap_or(0)) * 1e-6,
            period_ms: self.frame_period_ns() as f64 * 1e-6,
        };
        tick.span(
            &mut self.state.vision_slow_since_ns,
            is_slow,
            slow,
            |lasted_ms| EventKind::VisionSlowEnded { lasted_ms },
        );
        self.state.frameless = if input.frames.arrived == 0 {
            self.state.frameless.saturating_add(1)
        } else {
            0
        };
        let Some(m) = &input.measurement else {
            tick.flags.set(TickFlags::TIMER);
            if input.frames.refused() > 0 && input.frames.backlog == 0 {
                tick.flags.set(TickFlags::STALE);
                tick.frames_disturbed = true;
                // A stall of this machine makes frames old, not the camera. The camera's path delivers faster than the camera exposes, so
                // these frames have come when the stall is over for as long as it lasted. The last one may still take `oldest_ms`.
                // Nor does slow vision: the camera's frames are right, and each that comes too late is one that is missing. Before the
                // run nothing is held that could be waited for.
                let awaited = is_slow && self.state.life == Life::Running;
                if tick.time_ns >= self.state.caught_up_ns && !awaited {
                    self.state.stale_in_a_row = self.state.stale_in_a_row.saturating_add(1);
                }
                if self.state.stale_in_a_row >= self.timing.faults_in_a_row {
                    let reason = if is_slow {
                        SafeReason::VisionSlow
                    } else {
                        SafeReason::StaleFrames
                    };
                    self.latch(reason, tick);
                }
            }
            return None;
        };
        self.state.stale_in_a_row = 0;
        self.state.pictures_repeated = if matches!(m.track, Some((_, Decision::Stale))) {
            tick.flags.set(TickFlags::STALE);
            tick.frames_disturbed = true;
            self.state.pictures_repeated.saturating_add(1)
        } else {
            0
        };
        self.state.last_frame = Some((m.frame_id, m.mid_exposure_ns));
        let period = self.timing.period_ns();
        let age_ns = input.time_ns - m.mid_exposure_ns;
        let beyond_ns = age_ns - Timing::ms_to_ns(self.timing.camera_delay_ms);
        tick.frames_disturbed |= beyond_ns > period / 2;
        let early = beyond_ns < -period / 2;
        if early {
            tick.flags.set(TickFlags::EARLY);
        }
        let started = EventKind::FramesEarlyStarted {
            age_ms: age_ns as f64 * 1e-6,
            expected_ms: self.timing.camera_delay_ms,
        };
        tick.span(
            &mut self.state.early_since_ns,
            early,
            started,
            |lasted_ms| EventKind::FramesEarlyEnded { lasted_ms },
        );
        if !m.is_usable() {
            tick.flags.set(TickFlags::LOST);
            return None;
        }
        let near_limit = matches!(m.track, Some((_, Decision::NearLimit)));
        if near_limit && !self.state.near_limit {
            tick.event(EventKind::NearLimit);
        }
        self.state.near_limit = near_limit;
        if matches!(m.track, Some((_, Decision::Reacquired))) {
            tick.event(EventKind::BeadReacquired {
                position_um: m.position_um,
            });
            self.state.counts.reacquired += 1;
        }
        let age_samples =
            ((beyond_ns + period / 2).max(0) / period).min(i64::from(u16::MAX)) as u16;
        let offset = (beyond_ns - i64::from(age_samples) * period) as f64 / period as f64;
        Some(LoopMeasurement {
            position_um: m.position_um,
            variance_um2: m.variance_um2,
            age_samples,
            // The estimator knows the bead's way up to half a tick from where its frames are expected.
            offset_samples: offset.max(-0.5),
        })
    }

    /// The position of this tick and its age beyond the camera path, ticks; between two frames of a slower camera that of the newest.
    pub(super) fn newest_position(
        &mut self,
        fix: Option<LoopMeasurement>,
        input: &TickInput,
        steps: u64,
    ) -> Option<(f64, u16)> {
        let steps = u16::try_from(steps).unwrap_or(u16::MAX);
        let older = |(position_um, age): (f64, u16)| (position_um, age.saturating_add(steps));
        let held = (self.state.newest.map(older))
            .filter(|(_, age)| input.measurement.is_none() && u32::from(*age) <= self.planned_gap);
        self.state.newest = fix.map(|fix| (fix.position_um, fix.age_samples)).or(held);
        self.state.newest
    }

    /// Flags and events of the frames that came.
    fn tell_frames(&self, frames: &FrameTally, tick: &mut Tick) {
        if frames.doubled + frames.late > 0 {
            tick.flags.set(TickFlags::DOUBLED_FRAME);
            tick.event(EventKind::FrameRepeated {
                frame_id: frames.repeated_id,
            });
        }
        if frames.missed > 0 {
            tick.frames_disturbed = true;
            tick.flags.set(TickFlags::DROPPED_FRAME);
            tick.event(EventKind::FramesDropped {
                count: u64::from(frames.missed),
            });
        }
        if frames.stale + frames.backlog > 0 {
            tick.event(EventKind::FrameStale {
                age_ms: frames.oldest_ns as f64 * 1e-6,
            });
        }
        if frames.future > 0 {
            tick.event(EventKind::FrameFromFuture {
                ahead_ms: frames.ahead_ns as f64 * 1e-6,
            });
        }
        if frames.restarts > 0 {
            tick.event(EventKind::CameraRestarted);
        }
    }

    /// The driver's account of the previous tick.
    pub(super) fn check_driver(&mut self, input: &TickInput, tick: &mut Tick) {
        match input.previous_late_ns {
            Some(compute_ns) => {
                tick.commands_disturbed = true;
                tick.event(EventKind::LateTick {
                    compute_us: f64::from(compute_ns) * 1e-3,
                });
                self.state.late_in_a_row = self.state.late_in_a_row.saturating_add(1);
                if self.state.late_in_a_row >= self.timing.faults_in_a_row {
                    self.latch(SafeReason::LateTicks, tick);
                }
            }
            None => self.state.late_in_a_row = 0,
        }
    }

    /// Nobody keeps what happens: the bead is given time to stop, then the PZT goes to park.
    pub(super) fn unrecorded(&mut self, tick: &mut Tick) {
        const FREEZE_NS: i64 = 300_000_000;
        self.freeze(FreezeReason::Unrecorded, tick);
        let since_ns = *self.state.unrecorded_since_ns.get_or_insert(tick.time_ns);
        if self.state.life != Life::Running || tick.time_ns - since_ns >= FREEZE_NS {
            self.latch(SafeReason::Unrecorded, tick);
        }
    }

    /// The board's report, or its silence.
    pub(super) fn check_board(&mut self, input: &TickInput, tick: &mut Tick) {
        if let Some(trouble) = input.board_trouble {
            tick.flags.set(TickFlags::BOARD_TROUBLE);
            let reason = match trouble {
                BoardTrouble::Foreign => SafeReason::BoardForeign,
                BoardTrouble::NotObeying => SafeReason::BoardNotObeying,
                BoardTrouble::NotFollowing => SafeReason::BoardNotFollowing,
            };
            self.latch(reason, tick);
        }
        if let Some(report) = input.board {
            tick.flags.set(TickFlags::BOARD_HEARD);
            self.state.board_heard_ns = input.time_ns;
            let before = self.state.board.replace(report);
            let unchanged = |b: ActuatorReport| b.state == report.state && b.fault == report.fault;
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
            let holds = before.map_or(0, |b| b.holds);
            if report.holds > holds {
                tick.event(EventKind::BoardHeld {
                    count: report.holds - holds,
                });
            }
            if !report.state.takes_commands() {
                self.latch(SafeReason::Board, tick);
            }
        } else if input.time_ns - self.state.board_heard_ns
            > Timing::ms_to_ns(self.timing.board_silence_ms)
        {
            self.latch(SafeReason::LinkLost, tick);
        }
        self.check_line(input, tick);
    }

    /// While the board does not follow, the loop's commands are no input of the plant: an estimator that took them for one would
    /// run away. The bead is frozen, as the board freezes it meanwhile.
    fn check_line(&mut self, input: &TickInput, tick: &mut Tick) {
        let holds = self
            .state
            .board
            .is_some_and(|board| board.state == ActuatorState::Holding);
        let state = &mut self.state;
        state.unheard = match input.board {
            Some(_) => 0,
            None => state.unheard.saturating_add(1),
        };
        if input.command_lost {
            tick.flags.set(TickFlags::COMMAND_LOST);
            tick.commands_disturbed = true;
        }
        let refused = input.previous_refused;
        tick.commands_disturbed |= refused;
        if input.command_lost || refused || holds {
            state.unled = state.unled.saturating_add(1);
        } else {
            state.unled = 0;
        }
        let patience = self.timing.faults_in_a_row.min(self.timing.coast_ticks);
        if state.unled >= patience || state.unheard >= self.timing.coast_ticks {
            self.freeze(FreezeReason::LineStalled, tick);
        } else if state.unled == 0 && state.unheard == 0 {
            self.thaw(FreezeReason::LineStalled, tick);
        }
    }
}
