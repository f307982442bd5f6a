//! What is kept of a tick: flags, events, counts, the record.

use super::Core;
use crate::life::{EventKind, Life};
use crate::reference::{ReferenceGenerator, ReferenceOutput};
use crate::tick::{Action, Tick, TickInput};
use crate::tick_record::{TickCounts, TickFlags, TickRecord};
use cellpos_control::{LoopOutput, SolverStatus};
use cellpos_rig::{ActuatorFault, ActuatorState};

impl<R: ReferenceGenerator> Core<R> {
    /// Flags and events that follow from the controller's output.
    pub(super) fn account(&mut self, input: &TickInput, output: &LoopOutput, tick: &mut Tick) {
        let flags = output.flags;
        self.state.blind = if flags.coasting {
            let steps = u32::try_from(tick.steps).unwrap_or(u32::MAX);
            self.state.blind.saturating_add(steps)
        } else {
            0
        };
        self.state.missing = self.state.blind.saturating_sub(self.planned_gap);
        // A frame that came and was of no use is a loss, whatever is planned.
        let between = flags.coasting
            && self.state.missing == 0
            && input.measurement.is_none()
            && !tick.flags.has(TickFlags::STALE);
        for (set, mask) in [
            (flags.range_limited, TickFlags::RANGE_LIMITED),
            (flags.slew_limited, TickFlags::SLEW_LIMITED),
            (flags.not_finite, TickFlags::NOT_FINITE),
            (flags.coasting && !between, TickFlags::COASTING),
            (between, TickFlags::BETWEEN),
            (flags.gated, TickFlags::GATED),
            (flags.stuck, TickFlags::STUCK),
        ] {
            if set {
                tick.flags.set(mask);
            }
        }
        if self.state.life != Life::Running {
            return;
        }
        /// Cameras leave shorter gaps all the time: they are no event.
        const WORTH_AN_EVENT: u32 = 3;
        let coasts = self.state.missing >= WORTH_AN_EVENT
            || (self.state.coasting_since_ns.is_some() && self.state.missing > 0);
        tick.span(
            &mut self.state.coasting_since_ns,
            coasts,
            EventKind::CoastingStarted,
            |lasted_ms| EventKind::CoastingEnded { lasted_ms },
        );
        self.tell_stuck(flags.stuck, tick);
        tick.span(
            &mut self.state.saturated_since_ns,
            flags.range_limited,
            EventKind::SaturationStarted,
            |lasted_ms| EventKind::SaturationEnded { lasted_ms },
        );
    }

    /// A bead that does not follow is held by something only if its board obeyed meanwhile: while the line is silent the
    /// commands are the loop's alone.
    fn tell_stuck(&mut self, stuck: bool, tick: &mut Tick) {
        /// The board must have obeyed a command given so long after the bead was first taken for stuck.
        const OBEYED_NS: i64 = 10_000_000;
        let state = &mut self.state;
        let told = state.stuck_told;
        if !stuck {
            if let (true, Some(since_ns)) = (told, state.stuck_since_ns) {
                let lasted_ms = (tick.time_ns - since_ns) as f64 * 1e-6;
                tick.event(EventKind::StuckEnded { lasted_ms });
            }
            (state.stuck_since_ns, state.stuck_told) = (None, false);
            return;
        }
        let sure_ns = *state.stuck_since_ns.get_or_insert(tick.time_ns) + OBEYED_NS;
        let obeyed_ns = match state.board {
            Some(board) if board.last_seq.is_some() => board.last_time_us.saturating_mul(1000),
            // A board whose reports name no command.
            _ => tick.time_ns.unsigned_abs(),
        };
        if !told && i64::try_from(obeyed_ns).is_ok_and(|ns| ns >= sure_ns) {
            state.stuck_told = true;
            tick.event(EventKind::StuckStarted);
        }
    }

    /// Adds the tick to the counts.
    pub(super) fn count(&mut self, input: &TickInput, output: &LoopOutput, flags: TickFlags) {
        let counts = &mut self.state.counts;
        counts.ticks = counts.ticks.wrapping_add(1);
        let frames = &input.frames;
        for (counter, more) in [
            (&mut counts.superseded, frames.superseded),
            (
                &mut counts.stale,
                frames
                    .refused()
                    .saturating_add(frames.late + frames.backlog),
            ),
            (&mut counts.doubled, frames.doubled),
            (&mut counts.reordered, frames.late),
            (&mut counts.future, frames.future),
            (&mut counts.camera_restarts, frames.restarts),
            (&mut counts.frames_lost, frames.missed),
        ] {
            *counter += u64::from(more);
        }
        // Pictures that came once more under new numbers.
        counts.stale += u64::from(self.state.pictures_repeated > 0 && input.measurement.is_some());
        counts.frames_lost = counts.frames_lost.saturating_sub(u64::from(frames.late));
        counts.late += u64::from(input.previous_late_ns.is_some());
        counts.refused += u64::from(input.previous_refused);
        match output.solver.status {
            SolverStatus::PreviousPlan => counts.plans_reused += 1,
            SolverStatus::FallbackPi => counts.solver_fallbacks += 1,
            SolverStatus::Feasible => counts.plans_stopped += 1,
            SolverStatus::NotUsed | SolverStatus::Solved => {}
        }
        for (mask, counter) in [
            (TickFlags::TIMER, &mut counts.timer),
            (TickFlags::EARLY, &mut counts.early),
            (TickFlags::LOST, &mut counts.fixes_lost),
            (TickFlags::GATED, &mut counts.gated),
            (TickFlags::COASTING, &mut counts.coasted),
            (TickFlags::FREEZE, &mut counts.frozen),
            (TickFlags::RANGE_LIMITED, &mut counts.range_limited),
            (TickFlags::SLEW_LIMITED, &mut counts.slew_limited),
            (TickFlags::PARTNER_LOST, &mut counts.partner_lost),
            (TickFlags::PARTNER_LIMITED, &mut counts.partner_limited),
        ] {
            *counter += u64::from(flags.has(mask));
        }
    }

    /// The tick's record.
    pub(super) fn record(
        &mut self,
        input: &TickInput,
        output: &LoopOutput,
        generated: &ReferenceOutput,
        flags: TickFlags,
    ) -> TickRecord {
        self.references.add(input.time_ns, generated.reference_um);
        let m = input.measurement;
        let (last_id, last_exposure) = self.state.last_frame.unwrap_or((0, 0));
        let record = TickRecord {
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
            target_um: generated.reference_um,
            error_um: f64::NAN,
            plan_ns: generated.plan_ns,
            stage: generated.stage as u8,
            length_um: m.map_or(f64::NAN, |m| m.length_um),
            area_um2: m.map_or(f64::NAN, |m| m.area_um2),
            length_sd_um: m.map_or(f64::NAN, |m| m.length_sd_um),
            area_sd_um2: m.map_or(f64::NAN, |m| m.area_sd_um2),
            estimate_um: output.estimate_um,
            estimate_sd_um: output.estimate_sd_um,
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
                .map_or(ActuatorFault::None as u8, |b| b.fault as u8),
            partner_command_um: self.state.partner.state.command_um(),
            partner_applied_um: self.state.partner.state.applied_um(),
            partner_effect_um: self.partner_effect_um(),
            partner: self.state.partner.heard.map_or(255, |p| p.state as u8),
            flags,
            drained: input.frames.arrived.min(255) as u8,
            wake_ns: 0,
            compute_ns: 0,
            obeyed_before_us: f64::NAN,
            obeyed_at_us: f64::NAN,
            solver_status: output.solver.status as u8,
            solver_iterations: output.solver.iterations.min(255) as u8,
            solver_active: output.solver.active.min(255) as u8,
            solver_ns: output.solver.solve_ns,
            law: self.controller.record(),
            counts: TickCounts {
                skipped: self.state.counts.skipped,
                frames_lost: self.state.counts.frames_lost,
                stale: self.state.counts.stale,
            },
        };
        TickRecord {
            error_um: record.error_at_exposure_um(&self.references),
            ..record
        }
    }

    /// The command for the board.
    pub(super) fn action(&mut self, output: &LoopOutput, index: u64) -> Action {
        /// Periods after which an order to park that the board has not confirmed is given again.
        const REPEAT: u64 = 10;
        if self.state.life != Life::Safe {
            return Action::Command {
                command_um: output.command_um,
                neutral_um: self.state.told_um,
            };
        }
        let confirmed = self
            .state
            .board
            .is_some_and(|b| matches!(b.state, ActuatorState::Safe | ActuatorState::Disarmed));
        match self.state.parked_at {
            Some(at) if confirmed || index < at + REPEAT => Action::None,
            _ => {
                self.state.parked_at = Some(index);
                Action::Park
            }
        }
    }
}
