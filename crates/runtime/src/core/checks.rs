//! What is checked before anything is decided: ticks that never came, the frame, the driver's account, the board.

use super::Core;
use crate::guide::Guide;
use crate::life::{EventKind, SafeReason};
use crate::tick::{Tick, TickInput};
use crate::tick_record::TickFlags;
use crate::timing::Timing;
use cellpos_control::Measurement as LoopMeasurement;
use cellpos_link::BoardState;
use cellpos_rig::BoardReport;
use cellpos_vision::Decision;

impl<R: Guide> Core<R> {
    /// Accounts for ticks that never came: the last command was held, the bead moved on.
    pub(super) fn catch_up(&mut self, time_ns: i64, tick: &mut Tick) {
        const MOST: i64 = 100;
        let period = self.timing.period_ns();
        let skipped = (time_ns - self.state.last_time_ns + period / 2) / period - 1;
        if skipped <= 0 {
            return;
        }
        tick.disturbed = true;
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
    pub(super) fn check_frame(
        &mut self,
        input: &TickInput,
        tick: &mut Tick,
    ) -> Option<LoopMeasurement> {
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
        let period = self.timing.period_ns();
        let beyond_ns = age_ns - Timing::ms_to_ns(self.timing.camera_delay_ms);
        tick.disturbed |= stale
            || tick.flags.0 & (TickFlags::DROPPED_FRAME | TickFlags::DOUBLED_FRAME) != 0
            || beyond_ns > period / 2;
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
    pub(super) fn check_driver(&mut self, input: &TickInput, tick: &mut Tick) {
        match input.previous_late_ns {
            Some(compute_ns) => {
                tick.disturbed = true;
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
            tick.disturbed = true;
            self.state.refused_in_a_row += 1;
            if self.state.refused_in_a_row >= self.timing.faults_in_a_row {
                self.latch(SafeReason::ActuatorRingFull, tick);
            }
        } else {
            self.state.refused_in_a_row = 0;
        }
    }

    /// What the board says, or its silence.
    pub(super) fn check_board(&mut self, input: &TickInput, tick: &mut Tick) {
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
}
