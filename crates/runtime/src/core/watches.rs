//! What is watched besides the bead: whether it follows the commands.

use super::Core;
use super::following::{Instead, Seen};
use super::rest::{Rest, Seen as RestSeen, ZeroFlow};
use crate::life::{EventKind, FreezeReason, Life};
use crate::reference::ReferenceGenerator;
use crate::tick::Tick;
use crate::tick_record::TickFlags;
use cellpos_control::{LoopOutput, Measurement as LoopMeasurement};

/// What was said of the pauses of the loop.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Pauses {
    now: bool,
    /// Those that no event tells of yet, and when one did last.
    untold: u32,
    told_ns: Option<i64>,
}

impl Pauses {
    /// Takes in whether the loop pauses, and says how often it did.
    fn step(&mut self, pauses: bool, tick: &mut Tick) {
        /// Shortest time between two such events: a flow that rises may ask for pause after pause.
        const BETWEEN_NS: i64 = 1_000_000_000;
        self.untold += u32::from(pauses && !self.now);
        self.now = pauses;
        let told = |at_ns: i64| tick.time_ns - at_ns < BETWEEN_NS;
        if self.untold > 0 && !self.told_ns.is_some_and(told) {
            tick.event(EventKind::LoopPaused { count: self.untold });
            (self.untold, self.told_ns) = (0, Some(tick.time_ns));
        }
    }
}

impl<R: ReferenceGenerator> Core<R> {
    /// The newest fix and the zero flow at which a PZT would stop.
    pub(super) fn watch_rest(
        &mut self,
        fix: Option<LoopMeasurement>,
        output: &LoopOutput,
        steps: u64,
    ) {
        self.state.rest.wait(steps, self.sample_s);
        let newest = ZeroFlow {
            um: output.neutral_um,
            variance_um2: self.controller.neutral_variance_um2(),
        };
        let newest = std::mem::replace(&mut self.state.newest_zero_flow, newest);
        if self.state.life != Life::Running {
            self.state.rest = Rest::new(newest);
            return;
        }
        let Some(fix) = fix else { return };
        let model = self.controller.settings().model;
        let gain = self.controller.adaptation().map_or(1.0, |now| now.gain);
        let seen = RestSeen {
            innovation_um: output.innovation_um,
            walk_um2: 2.0 * self.diffusion_um2_per_s * self.sample_s,
            fix_um2: fix.variance_um2.max(0.0),
            newest,
            gain: gain * model.fast_gain_per_s() * model.sample_time_s,
        };
        self.state.rest.step(&seen, output.flags);
    }

    /// A bead that moves against the commands, or follows them up to a level and no further, is frozen at the zero flow of before. One that
    /// the loop holds although it follows on one side only is held on; the run says it.
    pub(super) fn watch_following(
        &mut self,
        fix: Option<LoopMeasurement>,
        reference_um: f64,
        obeyed: bool,
        output: &LoopOutput,
        tick: &mut Tick,
    ) {
        let state = &mut self.state;
        if state.clipped {
            tick.flags.set(TickFlags::CLIPPED);
        }
        let driven = state.life == Life::Running && !state.frozen.any();
        if !driven || !obeyed || output.flags.stuck {
            state.following.clear();
            state.pauses.now = false;
            return;
        }
        let on_time = fix.filter(|fix| {
            !tick.disturbed() && fix.age_samples == 0 && fix.offset_samples.abs() < 0.2
        });
        let found = state.following.step(&Seen {
            fix: on_time.map(|fix| (fix.position_um, fix.variance_um2)),
            reference_um,
            command_um: output.command_um,
            dither_um: output.dither_um,
            cancel_um: output.cancel_um,
            zero_flow_um: state.rest.zero_flow().um,
        });
        let pauses = state.following.pause_um().is_some();
        state.pauses.step(pauses, tick);
        match found {
            None => {}
            Some((Instead::OneSided, _)) if state.clipped => {}
            Some((Instead::OneSided, level_um)) => {
                state.clipped = true;
                tick.flags.set(TickFlags::CLIPPED);
                tick.event(EventKind::ActuatorClipped { level_um });
            }
            Some((Instead::Against, rest_um)) => {
                self.freeze_at(FreezeReason::NotFollowing, rest_um, tick);
            }
            Some((Instead::Adrift, rest_um)) => {
                state.clipped = true;
                tick.flags.set(TickFlags::CLIPPED);
                tick.event(EventKind::ActuatorClipped { level_um: rest_um });
                self.freeze_at(FreezeReason::NotFollowing, rest_um, tick);
            }
        }
    }
}
