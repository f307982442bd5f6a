//! The PZT board's firmware: a state machine fed with bytes and times, that yields bytes and a displacement.
//!
//! Free of clocks, ports and threads, so that the same code runs in the emulated rig on a virtual clock, behind a
//! pseudo-terminal in real time, and under a property test that throws any bytes at any times at it. Times are
//! microseconds since the board's start.
//!
//! The board trusts nobody: it enforces range and slew itself, ignores commands that are old, doubled, reordered or of
//! another session, and when commands stop it ramps to park by itself and stays there until it is armed again.
//!
//! | state | output | left by |
//! |---|---|---|
//! | disarmed | at power-up displacement, after a session at park | arm |
//! | armed | holds where it was | first command, hold watchdog (to safe), park, disarm |
//! | running | follows commands, within range and slew | freeze, watchdog (to safe), park, disarm |
//! | frozen | last neutral estimate | arm, hold watchdog (to safe), park, disarm |
//! | safe | ramp to park | arm, disarm |

mod config;
mod output;
mod transmit;

pub use config::{BoardConfig, BoardConfigError};

use cellpos_link::{
    Arm, BoardState, Command, Decoder, Fault, Identity, Limits, Order, PROTOCOL_VERSION, Refusal,
    Request, Status, ToBoard, ToHost, order, picometres, um_from_picometres,
};
use output::{Output, Trajectory};
use transmit::TransmitBuffer;

/// Firmware version reported in the identity.
pub const FIRMWARE_VERSION: [u8; 3] = [0, 1, 0];
/// Between unsolicited status messages while no command is answered, us.
const STATUS_PERIOD_US: u64 = 10_000;
/// The transit time of commands may creep by this part of the elapsed time: two crystal clocks differ by no more.
const CLOCK_TOLERANCE: f64 = 200e-6;
/// Longest stretch between two commands that interpolation bridges, us.
const LONGEST_BRIDGE_US: u64 = 5_000;

/// What belongs to one session, reset by every arming.
#[derive(Debug, Clone, Copy)]
struct Session {
    number: u16,
    low_um: f64,
    high_um: f64,
    slew_um_per_s: f64,
    park_um: f64,
    watchdog_us: u64,
    hold_watchdog_us: u64,
    interpolate: bool,
    status_every: u16,
    since_status: u16,
    last_seq: Option<u32>,
    last_time_us: u64,
    last_command_us: u64,
    neutral_um: Option<f64>,
    /// Smallest transit time seen so far, us, and when: what longer ones are compared with.
    fastest: Option<(f64, u64)>,
}

/// The board.
#[derive(Debug, Clone)]
pub struct Board {
    config: BoardConfig,
    decoder: Decoder<ToBoard>,
    transmit: TransmitBuffer,
    output: Output,
    trajectory: Trajectory,
    session: Session,
    state: BoardState,
    fault: Fault,
    /// Whether a host of the right protocol version said hello.
    greeted: bool,
    led: bool,
    now_us: u64,
    /// When the hold watchdog was last fed.
    held_since_us: u64,
    next_status_us: u64,
    ignored: u32,
    late: u32,
    clipped: u32,
}

impl Board {
    /// A board that has just been switched on at time 0: disarmed, at the power-up displacement.
    ///
    /// # Errors
    /// [`BoardConfigError`] names the first key whose value cannot be.
    pub fn new(config: BoardConfig) -> Result<Self, BoardConfigError> {
        config.validate()?;
        let output = Output::new(&config);
        Ok(Self {
            decoder: Decoder::new(),
            transmit: TransmitBuffer::new(),
            trajectory: Trajectory::hold(output.applied_um()),
            output,
            session: Session {
                number: 0,
                low_um: config.low_um,
                high_um: config.high_um,
                slew_um_per_s: config.slew_um_per_s,
                park_um: config.park_um,
                watchdog_us: u64::from(config.watchdog_ms) * 1000,
                hold_watchdog_us: u64::from(config.hold_watchdog_ms) * 1000,
                interpolate: false,
                status_every: 1,
                since_status: 0,
                last_seq: None,
                last_time_us: 0,
                last_command_us: 0,
                neutral_um: None,
                fastest: None,
            },
            state: BoardState::Disarmed,
            fault: Fault::None,
            greeted: false,
            led: false,
            now_us: 0,
            held_since_us: 0,
            next_status_us: 0,
            ignored: 0,
            late: 0,
            clipped: 0,
            config,
        })
    }

    /// Takes bytes that arrived at `now_us`. The output follows at the next [`Board::tick`].
    ///
    /// A time before the last one is taken as the last one: the board's clock does not run backwards.
    pub fn receive(&mut self, bytes: &[u8], now_us: u64) {
        self.now_us = self.now_us.max(now_us);
        self.watch();
        let mut rest = bytes;
        while let Some(message) = self.decoder.next_message(&mut rest) {
            self.obey(message);
        }
    }

    /// Brings the output up to `now_us`; returns the displacement that stands at the converter from now on, um.
    ///
    /// To be called every [`BoardConfig::update_us`] while the output moves. When calls come further apart, the output
    /// still moves by no more than the slew of one update period per call: a stalled board slows down, it does not jump.
    pub fn tick(&mut self, now_us: u64) -> f64 {
        self.now_us = self.now_us.max(now_us);
        self.watch();
        let (target_um, rate_um_per_s) = self.target();
        self.output.advance(self.now_us, target_um, rate_um_per_s);
        if self.greeted && self.now_us >= self.next_status_us {
            self.send_status();
        }
        self.output.applied_um()
    }

    /// Moves bytes for the host into `out`; returns how many.
    pub fn transmit(&mut self, out: &mut [u8]) -> usize {
        self.transmit.take(out)
    }

    /// When the board next has something to do by itself, us: the next step of a moving output, the end of a watchdog
    /// time, a status. Between events and messages, ticks change nothing.
    pub fn next_event_us(&self) -> u64 {
        let mut next = u64::MAX;
        if self.is_moving() {
            next = self.now_us + u64::from(self.config.update_us);
        }
        if let Some((deadline_us, _)) = self.deadline() {
            next = next.min(deadline_us);
        }
        if self.greeted {
            next = next.min(self.next_status_us);
        }
        next.max(self.now_us + 1)
    }

    /// Whether the output has not yet arrived where it is to be.
    pub fn is_moving(&self) -> bool {
        let (target_um, _) = self.target();
        !self.output.arrived(target_um) || self.trajectory.ends_after(self.now_us)
    }

    /// Displacement at the converter, um.
    pub fn applied_um(&self) -> f64 {
        self.output.applied_um()
    }

    /// State.
    pub fn state(&self) -> BoardState {
        self.state
    }

    /// Latched fault.
    pub fn fault(&self) -> Fault {
        self.fault
    }

    /// Whether the LED is lit.
    pub fn led(&self) -> bool {
        self.led
    }

    /// What the board is made of.
    pub fn config(&self) -> &BoardConfig {
        &self.config
    }

    /// How things stand, as sent to the host.
    pub fn status(&self) -> Status {
        let neutral_um = self.session.neutral_um.unwrap_or(self.output.applied_um());
        Status {
            session: self.session.number,
            last_seq: self.session.last_seq,
            last_time_us: self.session.last_time_us,
            state: self.state,
            applied_pm: picometres(self.output.applied_um()).unwrap_or(0),
            neutral_pm: picometres(neutral_um).unwrap_or(0),
            board_time_us: self.now_us,
            fault: self.fault,
            led: self.led,
            bad_frames: self.decoder.bad_frames(),
            ignored: self.ignored,
            late: self.late,
            clipped: self.clipped,
            unsent: self.transmit.unsent(),
        }
    }

    /// Where the output has to go in the present state (um), and how fast (um/s).
    fn target(&self) -> (f64, f64) {
        let session = &self.session;
        let held = |um: f64| um.clamp(session.low_um, session.high_um);
        match self.state {
            BoardState::Disarmed | BoardState::Safe => (
                self.trajectory.at_um(self.now_us),
                self.config.ramp_um_per_s.min(session.slew_um_per_s),
            ),
            BoardState::Armed | BoardState::Running | BoardState::Frozen => (
                held(self.trajectory.at_um(self.now_us)),
                session.slew_um_per_s,
            ),
        }
    }

    /// End of the watchdog time that runs in the present state, and the fault that follows.
    fn deadline(&self) -> Option<(u64, Fault)> {
        let session = &self.session;
        match self.state {
            BoardState::Running => Some((
                session.last_command_us + session.watchdog_us,
                Fault::CommandTimeout,
            )),
            BoardState::Frozen => Some((
                self.held_since_us + session.hold_watchdog_us,
                Fault::FreezeTimeout,
            )),
            BoardState::Armed => Some((
                self.held_since_us + session.hold_watchdog_us,
                Fault::ArmTimeout,
            )),
            BoardState::Disarmed | BoardState::Safe => None,
        }
    }

    fn watch(&mut self) {
        let Some((deadline_us, fault)) = self.deadline() else {
            return;
        };
        if self.now_us >= deadline_us {
            self.fault = fault;
            self.transmit.send(&ToHost::Fault {
                fault,
                board_time_us: self.now_us,
            });
            self.go_to_park(BoardState::Safe);
        }
    }

    fn go_to_park(&mut self, state: BoardState) {
        self.trajectory = Trajectory::hold(self.session.park_um);
        self.state = state;
        self.send_status();
    }

    fn send_status(&mut self) {
        self.next_status_us = self.now_us + STATUS_PERIOD_US;
        self.session.since_status = 0;
        let status = self.status();
        self.transmit.send(&ToHost::Status(status));
    }

    fn answer(&mut self, request: Request, result: Result<(), Refusal>) {
        self.transmit.send(&match result {
            Ok(()) => ToHost::Ack { request },
            Err(refusal) => ToHost::Refused { request, refusal },
        });
    }

    fn obey(&mut self, message: ToBoard) {
        match message {
            ToBoard::Hello { protocol } => {
                self.greeted = protocol == PROTOCOL_VERSION;
                self.transmit.send(&ToHost::Identity(self.identity()));
                if !self.greeted {
                    self.answer(Request::Hello, Err(Refusal::Protocol));
                }
            }
            ToBoard::Arm(arm) => {
                let result = self.arm(&arm);
                self.answer(Request::Arm, result);
            }
            ToBoard::Command(command) => self.command(&command),
            ToBoard::Freeze => {
                let result = self.freeze();
                self.answer(Request::Freeze, result);
            }
            ToBoard::Park => {
                self.answer(Request::Park, Ok(()));
                self.go_to_park(BoardState::Safe);
            }
            ToBoard::Disarm => {
                self.answer(Request::Disarm, Ok(()));
                self.go_to_park(BoardState::Disarmed);
            }
            ToBoard::Led { on } => {
                self.led = on;
                self.answer(Request::Led, Ok(()));
            }
            ToBoard::StatusRequest => self.send_status(),
            ToBoard::Ping { token } => self.transmit.send(&ToHost::Pong {
                token,
                board_time_us: self.now_us,
            }),
        }
    }

    fn identity(&self) -> Identity {
        let pm = |um| picometres(um).unwrap_or(0);
        Identity {
            protocol: PROTOCOL_VERSION,
            firmware: FIRMWARE_VERSION,
            serial: self.config.serial,
            limits: Limits {
                low_pm: pm(self.config.low_um),
                high_pm: pm(self.config.high_um),
                slew_nm_per_s: (self.config.slew_um_per_s * 1000.0) as u32,
            },
            ramp_nm_per_s: (self.config.ramp_um_per_s * 1000.0) as u32,
            park_pm: pm(self.config.park_um),
            dac_bits: self.config.dac_bits,
            watchdog_ms: self.config.watchdog_ms,
            hold_watchdog_ms: self.config.hold_watchdog_ms,
        }
    }

    fn arm(&mut self, arm: &Arm) -> Result<(), Refusal> {
        if !self.greeted {
            return Err(Refusal::Protocol);
        }
        let config = &self.config;
        let (mut low_um, mut high_um, mut slew_um_per_s) =
            (config.low_um, config.high_um, config.slew_um_per_s);
        if let Some(limits) = arm.limits {
            let inside = |pm: i32| {
                // Limits read from the identity are rounded to a picometre; that is no breach.
                const ROUNDING_UM: f64 = 1e-6;
                let um = um_from_picometres(pm);
                um >= config.low_um - ROUNDING_UM && um <= config.high_um + ROUNDING_UM
            };
            if limits.low_pm >= limits.high_pm
                || !inside(limits.low_pm)
                || !inside(limits.high_pm)
                || limits.slew_nm_per_s == 0
                || f64::from(limits.slew_nm_per_s) > config.slew_um_per_s * 1000.0
            {
                return Err(Refusal::Limits);
            }
            low_um = low_um.max(um_from_picometres(limits.low_pm));
            high_um = high_um.min(um_from_picometres(limits.high_pm));
            slew_um_per_s = f64::from(limits.slew_nm_per_s) / 1000.0;
        }
        let park_um = arm.park_pm.map_or(config.park_um, um_from_picometres);
        // The board's own park may lie outside the tighter limits of a session: a ramp to park ends the session.
        if arm.park_pm.is_some() && !(config.low_um..=config.high_um).contains(&park_um) {
            return Err(Refusal::Park);
        }
        let watchdog_ms = arm.watchdog_ms.unwrap_or(config.watchdog_ms);
        let hold_watchdog_ms = arm.hold_watchdog_ms.unwrap_or(config.hold_watchdog_ms);
        let allowed = 1..=config.longest_watchdog_ms;
        if !allowed.contains(&watchdog_ms) || !allowed.contains(&hold_watchdog_ms) {
            return Err(Refusal::Watchdog);
        }
        self.session = Session {
            number: arm.session,
            low_um,
            high_um,
            slew_um_per_s,
            park_um,
            watchdog_us: u64::from(watchdog_ms) * 1000,
            hold_watchdog_us: u64::from(hold_watchdog_ms) * 1000,
            interpolate: arm.interpolate,
            status_every: arm.status_every,
            since_status: 0,
            last_seq: None,
            last_time_us: 0,
            last_command_us: self.now_us,
            neutral_um: None,
            fastest: None,
        };
        self.fault = Fault::None;
        self.state = BoardState::Armed;
        self.held_since_us = self.now_us;
        self.trajectory = Trajectory::hold(self.output.applied_um());
        self.send_status();
        Ok(())
    }

    fn freeze(&mut self) -> Result<(), Refusal> {
        match self.state {
            BoardState::Armed | BoardState::Running => {
                let hold_um = self.session.neutral_um.unwrap_or(self.output.applied_um());
                self.trajectory = Trajectory::hold(hold_um);
                self.state = BoardState::Frozen;
                self.held_since_us = self.now_us;
                self.send_status();
                Ok(())
            }
            // A host that goes on saying freeze is alive.
            BoardState::Frozen => {
                self.held_since_us = self.now_us;
                Ok(())
            }
            BoardState::Disarmed | BoardState::Safe => Err(Refusal::State),
        }
    }

    fn command(&mut self, command: &Command) {
        let session = &mut self.session;
        let taken = matches!(self.state, BoardState::Armed | BoardState::Running)
            && command.session == session.number
            && session
                .last_seq
                .is_none_or(|last| matches!(order(last, command.seq), Order::Newer { .. }));
        if !taken {
            self.ignored = self.ignored.saturating_add(1);
            return;
        }
        let transit_us = self.now_us as f64 - command.time_us as f64;
        let floor_us = session.fastest.map_or(transit_us, |(fastest_us, at_us)| {
            fastest_us + (self.now_us - at_us) as f64 * CLOCK_TOLERANCE
        });
        session.fastest = Some((transit_us.min(floor_us), self.now_us));
        if transit_us > floor_us + f64::from(self.config.late_us) {
            self.late = self.late.saturating_add(1);
        }
        let asked_um = um_from_picometres(command.displacement_pm);
        let to_um = asked_um.clamp(session.low_um, session.high_um);
        // Half a step of the converter beyond the end rounds to the end: no breach.
        if (asked_um - to_um).abs() > 0.5 * self.config.step_um() {
            self.clipped = self.clipped.saturating_add(1);
        }
        let period_us = self.now_us - session.last_command_us;
        self.trajectory = if session.interpolate && session.last_seq.is_some() {
            let shortest_us = u64::from(self.config.update_us);
            let bridge_us = period_us.clamp(shortest_us, LONGEST_BRIDGE_US.max(shortest_us));
            self.trajectory
                .towards(self.now_us, to_um, self.now_us + bridge_us)
        } else {
            Trajectory::hold(to_um)
        };
        session.last_seq = Some(command.seq);
        session.last_time_us = command.time_us;
        session.last_command_us = self.now_us;
        session.neutral_um =
            Some(um_from_picometres(command.neutral_pm).clamp(session.low_um, session.high_um));
        session.since_status = session.since_status.saturating_add(1);
        let due = session.status_every > 0 && session.since_status >= session.status_every;
        self.state = BoardState::Running;
        if due {
            // The status must show the output with this command in it.
            let (target_um, rate_um_per_s) = self.target();
            self.output.advance(self.now_us, target_um, rate_um_per_s);
            self.send_status();
        }
    }
}
