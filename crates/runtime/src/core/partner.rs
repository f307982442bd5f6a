//! The slow partner of the PZT within a tick.

use super::Core;
use crate::life::{EventKind, Life};
use crate::reference::ReferenceGenerator;
use crate::tick::{Tick, TickInput};
use crate::tick_record::TickFlags;
use cellpos_control::{Mode, Partner, PartnerInput, PartnerOutput, PartnerState, PartnerStatus};
use cellpos_rig::PartnerReport;

/// The partner's state, its newest report, and since when it is lost or at a limit.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Slow {
    pub state: PartnerState,
    pub heard: Option<PartnerReport>,
    lost_since_ns: Option<i64>,
    limited_since_ns: Option<i64>,
}

impl<R: ReferenceGenerator> Core<R> {
    /// The same loop with a slow partner that returns the PZT to the middle of its stroke.
    #[must_use]
    pub fn with_partner(mut self, partner: Partner) -> Self {
        self.partner = Some(partner);
        self
    }

    /// Moves the partner on, and with it what is believed of the zero flow. It moves only while the bead is held: what is
    /// on its way when the bead is lost still arrives, and the zero flow follows it.
    pub(super) fn move_partner(
        &mut self,
        input: &TickInput,
        mode: Mode,
        tick: &mut Tick,
    ) -> PartnerOutput {
        let Some(partner) = self.partner else {
            return PartnerOutput::default();
        };
        let state = &mut self.state;
        if let Some(report) = input.partner {
            tick.flags.set(TickFlags::PARTNER_HEARD);
            state.partner.heard = Some(report);
        }
        let given = PartnerInput {
            steps: tick.steps,
            report: input
                .partner
                .map(|report| (report.applied_um, report.state.takes_commands())),
            pzt_um: self.controller.previous_command_um(),
            held: mode == Mode::Run && state.missing == 0,
        };
        let out = partner.step(&mut state.partner.state, &given);
        state.rest.shift(out.shift_um);
        state.newest_zero_flow.um += out.shift_um;
        state.rest_um += out.shift_um;
        let status = state.partner.state.status();
        let lost = status == PartnerStatus::Lost;
        let limited = status == PartnerStatus::AtLimit;
        if lost {
            tick.flags.set(TickFlags::PARTNER_LOST);
        }
        if limited {
            tick.flags.set(TickFlags::PARTNER_LIMITED);
        }
        let since_ns = &mut state.partner.lost_since_ns;
        tick.span(since_ns, lost, EventKind::PartnerLost, |lasted_ms| {
            EventKind::PartnerBack { lasted_ms }
        });
        let since_ns = &mut state.partner.limited_since_ns;
        let started = EventKind::PartnerLimitStarted;
        tick.span(since_ns, limited, started, |lasted_ms| {
            EventKind::PartnerLimitEnded { lasted_ms }
        });
        // Parked with the PZT: it gets no more commands.
        let parks = state.life == Life::Safe;
        PartnerOutput {
            command_um: out.command_um.filter(|_| !parks),
            ..out
        }
    }

    /// Effect of the partner on the flow, um of PZT; NaN while it is not known.
    pub(super) fn partner_effect_um(&self) -> f64 {
        match self.state.partner.state.status() {
            PartnerStatus::Waiting => f64::NAN,
            _ => self.state.partner.state.effect_um(),
        }
    }
}
