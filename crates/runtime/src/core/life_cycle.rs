//! The life cycle: armed, running, frozen, safe.

use super::Core;
use crate::arming::{ArmingInput, ArmingState, Fix, Step};
use crate::life::{EventKind, FreezeReason, Life, Request, SafeReason};
use crate::reference::ReferenceGenerator;
use crate::tick::Tick;
use crate::tick_record::TickFlags;
use cellpos_control::{Measurement, Mode};

/// Frames in a row that show the picture before once more after which the bead is frozen. Shot noise never repeats: one is
/// already no chance.
const REPEATED_PICTURES: u32 = 3;

/// Reasons to stop the bead for which the newest estimate of the zero flow may be what went wrong.
const BLIND: [FreezeReason; 5] = [
    FreezeReason::BeadLost,
    FreezeReason::CameraStalled,
    FreezeReason::PictureFrozen,
    FreezeReason::NotFollowing,
    FreezeReason::VisionSlow,
];

/// The reasons for which the bead is frozen at present. Control resumes when the last one is gone.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct FreezeReasons(u8);

impl FreezeReasons {
    pub(super) fn any(self) -> bool {
        self.0 != 0
    }

    pub(super) fn has(self, reason: FreezeReason) -> bool {
        self.0 & (1 << reason as u8) != 0
    }

    /// Adds one; whether it is the first.
    pub(super) fn add(&mut self, reason: FreezeReason) -> bool {
        let first = !self.any();
        self.0 |= 1 << reason as u8;
        first
    }

    /// Takes one away; whether it was the last.
    pub(super) fn remove(&mut self, reason: FreezeReason) -> bool {
        let before = *self;
        self.0 &= !(1 << reason as u8);
        before.any() && !self.any()
    }
}

impl<R: ReferenceGenerator> Core<R> {
    /// Time without a bead after which a run ends, ns.
    fn lost_ns(&self) -> i64 {
        i64::from(self.timing.lost_ticks) * self.timing.period_ns()
    }

    /// Life cycle; returns the controller's task.
    pub(super) fn advance_life(
        &mut self,
        fix: Option<Measurement>,
        request: Request,
        tick: &mut Tick,
    ) -> Mode {
        if self.state.life == Life::Armed && request.stops() {
            // The pulse ends here. If the loop continues, it starts again.
            self.state.arming = ArmingState::default();
            tick.flags.set(TickFlags::FREEZE);
            return Mode::Freeze;
        }
        if self.state.life == Life::Armed
            && let Some(mode) = self.arm(fix, tick)
        {
            return mode;
        }
        if self.state.life == Life::Running {
            if self.state.pictures_repeated >= REPEATED_PICTURES {
                self.freeze(FreezeReason::PictureFrozen, tick);
            }
            if self.state.frozen.has(FreezeReason::NotFollowing)
                && tick.time_ns - self.state.frozen_since_ns >= self.lost_ns()
            {
                self.latch(SafeReason::NotFollowing, tick);
            }
            let cause = if self.state.pictures_repeated > 0 {
                (FreezeReason::PictureFrozen, SafeReason::StaleFrames)
            } else if self.state.frameless > self.planned_gap {
                (FreezeReason::CameraStalled, SafeReason::CameraLost)
            } else if self.state.vision_slow_since_ns.is_some() {
                (FreezeReason::VisionSlow, SafeReason::VisionSlow)
            } else {
                (FreezeReason::BeadLost, SafeReason::BeadLost)
            };
            if self.state.missing >= self.timing.lost_ticks {
                self.latch(cause.1, tick);
            } else if self.state.missing >= self.timing.coast_ticks {
                self.freeze(cause.0, tick);
            } else if self.state.missing == 0 {
                self.thaw(FreezeReason::BeadLost, tick);
                self.thaw(FreezeReason::CameraStalled, tick);
                self.thaw(FreezeReason::PictureFrozen, tick);
                self.thaw(FreezeReason::VisionSlow, tick);
            }
        }
        let frozen = self.state.frozen;
        match (self.state.life, frozen.any()) {
            (Life::Running, false) => {
                let pause_um = self.state.following.pause_um();
                pause_um.map_or(Mode::Run, Mode::Direct)
            }
            (Life::Running, true) => {
                tick.flags.set(TickFlags::FREEZE);
                // With the bead in view the estimate of the zero flow continues, and nothing is better known.
                if BLIND.into_iter().any(|reason| frozen.has(reason)) {
                    Mode::Direct(self.state.rest_um)
                } else {
                    Mode::Freeze
                }
            }
            _ => Mode::Park,
        }
    }

    /// A tick of the check before the loop is closed: the controller's task, unless the check is over.
    fn arm(&mut self, fix: Option<Measurement>, tick: &mut Tick) -> Option<Mode> {
        let held = self.controller.previous_command_um();
        let neutral_um = self.controller.neutral_um();
        let told = ArmingInput {
            fix: fix.map(|fix| Fix {
                position_um: fix.position_um,
                late_ticks: f64::from(fix.age_samples) + fix.offset_samples,
            }),
            framed: !tick.flags.has(TickFlags::TIMER),
            command_um: held,
            neutral_um,
            disturbed: tick.disturbed(),
            led: !tick.commands_disturbed,
            steps: tick.steps,
        };
        match self.arming.step(&mut self.state.arming, &told) {
            Step::Command(command_um) => return Some(Mode::Direct(command_um)),
            Step::Another(command_um, verdict) => {
                tick.event(EventKind::ArmingRejected {
                    gain_ratio: verdict.gain_ratio,
                    ci95: verdict.stated95(),
                });
                return Some(Mode::Direct(command_um));
            }
            Step::Again(command_um, verdict) => {
                if let Some(refusal) = verdict.refusal {
                    tick.event(EventKind::ArmingRepeated {
                        refusal,
                        gain_ratio: verdict.gain_ratio,
                        ci95: verdict.stated95(),
                    });
                }
                return Some(Mode::Direct(command_um));
            }
            Step::Done(verdict) => match verdict.refusal {
                Some(refusal) => {
                    tick.event(EventKind::ArmingRefused {
                        refusal,
                        gain_ratio: verdict.gain_ratio,
                        ci95: verdict.stated95(),
                    });
                    self.latch(SafeReason::ArmingRefused, tick);
                }
                None => {
                    self.controller.start_estimate(
                        verdict.gain_ratio,
                        verdict.shaken_sd,
                        verdict.dof,
                    );
                    if verdict.gain_ratio.is_finite() {
                        tick.event(EventKind::ArmingPassed {
                            gain_ratio: verdict.gain_ratio,
                            ci95: verdict.stated95(),
                        });
                    }
                    tick.event(EventKind::Running);
                    self.state.life = Life::Running;
                    self.state.running_since = tick.index;
                    (self.state.blind, self.state.missing) = (0, 0);
                }
            },
        }
        None
    }

    pub(super) fn latch(&mut self, reason: SafeReason, tick: &mut Tick) {
        if self.state.life != Life::Safe {
            self.state.life = Life::Safe;
            self.state.safe_reason = Some(reason);
            self.state.frozen = FreezeReasons::default();
            tick.event(EventKind::SafeLatched { reason });
        }
    }

    pub(super) fn freeze(&mut self, reason: FreezeReason, tick: &mut Tick) {
        let rest_um = self.state.rest.zero_flow().um;
        self.freeze_at(reason, rest_um, tick);
    }

    /// The same at a displacement at which the bead rests, um.
    pub(super) fn freeze_at(&mut self, reason: FreezeReason, rest_um: f64, tick: &mut Tick) {
        if self.state.life != Life::Running {
            return;
        }
        // Where commands work the other way round, later estimates of the zero flow are worth nothing.
        let known = self.state.frozen.has(FreezeReason::NotFollowing);
        if !self.state.frozen.has(reason) && !known {
            let newest_um = self.controller.neutral_um();
            self.state.rest_um = rest_um;
            if BLIND.contains(&reason) && self.state.rest_um != newest_um {
                let variance_um2 = self.state.rest.zero_flow().variance_um2;
                self.controller.rest_at(self.state.rest_um, variance_um2);
            }
        }
        if self.state.frozen.add(reason) {
            self.state.frozen_since_ns = tick.time_ns;
            tick.event(EventKind::FreezeStarted { reason });
        }
    }

    /// A reason to freeze is gone: the bead is held again when it was the last.
    pub(super) fn thaw(&mut self, reason: FreezeReason, tick: &mut Tick) {
        if self.state.frozen.remove(reason) {
            tick.event(EventKind::FreezeEnded {
                lasted_ms: (tick.time_ns - self.state.frozen_since_ns) as f64 * 1e-6,
            });
        }
    }
}
