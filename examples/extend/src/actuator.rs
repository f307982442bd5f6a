//! An actuator: an analogue output of 12 bits, with its own range, slew and watchdog.

use crate::bench::Bench;
use cellpos_rig::{
    Actuator, ActuatorError, ActuatorFault, ActuatorInfo, ActuatorReport, ActuatorState, ArmRequest,
};

/// Stroke, um.
const STROKE_UM: f64 = 40.0;
/// Largest slew, um/s.
const SLEW_UM_PER_S: f64 = 40_000.0;
/// Silence after which it parks, us.
const WATCHDOG_US: i64 = 50_000;

/// The analogue output of the bench.
#[derive(Debug)]
pub struct AnalogOutput {
    bench: Bench,
    session: u16,
    state: ActuatorState,
    fault: ActuatorFault,
    park_um: f64,
    limits: [f64; 3],
    neutral_um: f64,
    last_seq: Option<u32>,
    last_time_us: u64,
    moved_ns: i64,
}

impl AnalogOutput {
    /// The output of a bench, disarmed.
    pub fn new(bench: Bench) -> Self {
        let moved_ns = bench.clock().now_ns();
        Self {
            bench,
            session: 0,
            state: ActuatorState::Disarmed,
            fault: ActuatorFault::None,
            park_um: 20.0,
            limits: [0.0, STROKE_UM, SLEW_UM_PER_S],
            neutral_um: 20.0,
            last_seq: None,
            last_time_us: 0,
            moved_ns,
        }
    }

    fn step_um() -> f64 {
        STROKE_UM / 4095.0
    }

    /// Moves the output towards a displacement, within range and slew, by whole codes.
    fn go(&mut self, to_um: f64) {
        let [low_um, high_um, slew_um_per_s] = self.limits;
        let now_ns = self.bench.clock().now_ns();
        // What the slew allows since the last move, and at most in a millisecond.
        let since_s = ((now_ns - self.moved_ns) as f64 * 1e-9).clamp(0.0, 1e-3);
        let most_um = slew_um_per_s * since_s;
        let mut bench = self.bench.now();
        let from_um = bench.pzt_um;
        let wish_um = to_um
            .clamp(low_um, high_um)
            .clamp(from_um - most_um, from_um + most_um);
        bench.pzt_um = (wish_um / Self::step_um()).round() * Self::step_um();
        self.moved_ns = now_ns;
    }

    fn report(&self) -> ActuatorReport {
        let now_ns = self.bench.clock().now_ns();
        ActuatorReport {
            session: self.session,
            state: self.state,
            fault: self.fault,
            applied_um: self.bench.now().pzt_um,
            last_seq: self.last_seq,
            last_time_us: self.last_time_us,
            device_time_us: (now_ns / 1000).max(0) as u64,
            bad_frames: 0,
            ignored: 0,
            holds: 0,
            read_ns: now_ns,
        }
    }
}

impl Actuator for AnalogOutput {
    fn info(&self) -> ActuatorInfo {
        ActuatorInfo {
            name: "analogue output, 12 bits".to_string(),
            low_um: 0.0,
            high_um: STROKE_UM,
            slew_um_per_s: SLEW_UM_PER_S,
            step_um: Self::step_um(),
            watchdog_ms: (WATCHDOG_US / 1000) as u16,
            hold_watchdog_ms: 0,
        }
    }

    fn arm(&mut self, request: &ArmRequest) -> Result<ActuatorReport, ActuatorError> {
        self.session = request.session;
        self.state = ActuatorState::Armed;
        self.fault = ActuatorFault::None;
        self.park_um = request.park_um;
        self.limits = request.limits;
        self.last_seq = None;
        Ok(self.report())
    }

    fn command(
        &mut self,
        command_um: f64,
        neutral_um: f64,
        time_us: u64,
    ) -> Result<(), ActuatorError> {
        if !(command_um.is_finite() && neutral_um.is_finite()) {
            return Err(ActuatorError::NotANumber {
                command_um,
                neutral_um,
            });
        }
        if self.state.takes_commands() {
            self.state = ActuatorState::Running;
            self.neutral_um = neutral_um;
            self.last_seq = Some(self.last_seq.map_or(0, |seq| seq.wrapping_add(1)));
            self.last_time_us = time_us;
            self.go(command_um);
        }
        Ok(())
    }

    fn freeze(&mut self) -> Result<(), ActuatorError> {
        self.state = ActuatorState::Frozen;
        self.go(self.neutral_um);
        Ok(())
    }

    fn park(&mut self) -> Result<(), ActuatorError> {
        self.state = ActuatorState::Safe;
        Ok(())
    }

    fn disarm(&mut self) -> Result<(), ActuatorError> {
        self.state = ActuatorState::Disarmed;
        Ok(())
    }

    fn poll(&mut self) -> Result<Option<ActuatorReport>, ActuatorError> {
        let silent_us = (self.bench.clock().now_ns() - self.moved_ns) / 1000;
        if self.state == ActuatorState::Running && silent_us > WATCHDOG_US {
            self.state = ActuatorState::Safe;
            self.fault = ActuatorFault::CommandTimeout;
        }
        if matches!(self.state, ActuatorState::Safe | ActuatorState::Disarmed) {
            self.go(self.park_um);
        }
        Ok(Some(self.report()))
    }
}
