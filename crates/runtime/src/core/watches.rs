//! What is watched besides the bead: whether it follows the commands, and what its motion tells of the plant.

use super::Core;
use super::following::{Instead, Seen};
use crate::life::{EventKind, FreezeReason, Life};
use crate::reference::ReferenceGenerator;
use crate::tick::Tick;
use crate::tick_record::TickFlags;
use cellpos_control::{LoopOutput, Measurement as LoopMeasurement};

impl<R: ReferenceGenerator> Core<R> {
    /// What the newest fix says of the zero flow at which a PZT would stop.
    pub(super) fn watch_rest(&mut self, fix: Option<LoopMeasurement>, output: &LoopOutput) {
        let Some(fix) = fix.filter(|_| self.state.life == Life::Running) else {
            return;
        };
        let walk_um2 = 2.0 * self.diffusion_um2_per_s * self.sample_s;
        self.state.rest.step(
            output.neutral_um,
            output.innovation_um,
            walk_um2 + fix.variance_um2.max(0.0),
            output.flags,
            self.sample_s,
        );
    }

    /// A bead that moves against the commands is frozen at the zero flow that its motion shows if they work the other way round; one
    /// that follows them up to a level and no further, at the zero flow of before.
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
            return;
        }
        let on_time = fix.filter(|fix| {
            !tick.disturbed && fix.age_samples == 0 && fix.offset_samples.abs() < 0.2
        });
        let found = state.following.step(&Seen {
            fix: on_time.map(|fix| (fix.position_um, fix.variance_um2)),
            reference_um,
            command_um: output.command_um,
            zero_flow_um: output.neutral_um,
        });
        match found {
            None => {}
            Some((Instead::Unclear, rest_um)) => {
                let ticks = state.following.pause_ticks();
                state.pause = Some((rest_um, tick.index + ticks));
            }
            Some((Instead::Against, rest_um)) => {
                self.freeze_at(FreezeReason::NotFollowing, rest_um, tick);
            }
            Some((Instead::Adrift, level_um)) => {
                state.clipped = true;
                tick.flags.set(TickFlags::CLIPPED);
                tick.event(EventKind::ActuatorClipped { level_um });
                self.freeze(FreezeReason::NotFollowing, tick);
            }
        }
    }

    /// Gain and lag of the plant from its motion; their changes are events.
    pub(super) fn watch_plant(
        &mut self,
        fix: Option<LoopMeasurement>,
        output: &LoopOutput,
        tick: &mut Tick,
    ) {
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
}
