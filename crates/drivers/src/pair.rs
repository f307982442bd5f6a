//! Two actuators that move one bead: a fast one with a short stroke, and a slow partner.

use cellpos_rig::{
    Actuator, ActuatorError, ActuatorInfo, ActuatorReport, ArmRequest, CommandAccount,
    PartnerReport,
};

/// Settings for arming the partner; the session has the number of the fast actuator's.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PartnerRequest {
    /// End of a ramp to park, on its own scale, um.
    pub park_um: f64,
    /// Smallest and largest displacement (um) and slew (um/s).
    pub limits: [f64; 3],
    /// Silence after which it holds its position, and holding time before it parks, ms; `None`: the device's default.
    pub watchdogs_ms: [Option<u16>; 2],
}

/// A fast actuator and a slow partner as one. A failure of the partner never stops the fast one: it counts as silence of the
/// partner, and the loop reports it.
pub struct Pair {
    fast: Box<dyn Actuator>,
    slow: Box<dyn Actuator>,
    request: PartnerRequest,
    slow_is_armed: bool,
}

impl Pair {
    /// Joins two actuators.
    pub fn new(fast: Box<dyn Actuator>, slow: Box<dyn Actuator>, request: PartnerRequest) -> Self {
        Self {
            fast,
            slow,
            request,
            slow_is_armed: false,
        }
    }
}

impl Actuator for Pair {
    fn info(&self) -> ActuatorInfo {
        self.fast.info()
    }

    fn arm(&mut self, request: &ArmRequest) -> Result<ActuatorReport, ActuatorError> {
        let own = self.slow.info();
        let [low_um, high_um, slew_um_per_s] = self.request.limits;
        let [watchdog_ms, hold_watchdog_ms] = self.request.watchdogs_ms;
        let of_slow = ArmRequest {
            session: request.session,
            park_um: self.request.park_um,
            limits: [
                low_um.max(own.low_um),
                high_um.min(own.high_um),
                slew_um_per_s.min(own.slew_um_per_s),
            ],
            watchdog_ms,
            hold_watchdog_ms,
        };
        // Arm the slow one first: the fast one's watchdog for the first command starts when it is armed.
        self.slow_is_armed = self.slow.arm(&of_slow).is_ok();
        self.fast.arm(request)
    }

    fn command(
        &mut self,
        command_um: f64,
        neutral_um: f64,
        time_us: u64,
    ) -> Result<(), ActuatorError> {
        self.fast.command(command_um, neutral_um, time_us)
    }

    /// The slow one keeps its position: it has no zero flow to go to.
    fn freeze(&mut self) -> Result<(), ActuatorError> {
        self.fast.freeze()
    }

    fn park(&mut self) -> Result<(), ActuatorError> {
        // If this fails, its own watchdog does the same.
        let _ = self.slow.park();
        self.fast.park()
    }

    fn disarm(&mut self) -> Result<(), ActuatorError> {
        self.slow_is_armed = false;
        let _ = self.slow.disarm();
        self.fast.disarm()
    }

    fn poll(&mut self) -> Result<Option<ActuatorReport>, ActuatorError> {
        self.fast.poll()
    }

    fn account(&self) -> Option<CommandAccount> {
        self.fast.account()
    }

    fn command_partner(&mut self, um: f64, time_us: u64) {
        if self.slow_is_armed {
            // If commands stop, it holds its position.
            let _ = self.slow.command(um, um, time_us);
        }
    }

    fn partner_info(&self) -> Option<ActuatorInfo> {
        Some(self.slow.info())
    }

    fn poll_partner(&mut self) -> Option<PartnerReport> {
        let report = self.slow.poll().ok().flatten()?;
        self.slow_is_armed.then_some(PartnerReport {
            state: report.state,
            applied_um: report.applied_um,
        })
    }
}
