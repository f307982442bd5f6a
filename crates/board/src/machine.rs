//! The state machine: the reaction of the board to each message and to the passing of time.
//!
//! The board trusts no host. It enforces range and slew itself, and ignores commands that are old, doubled, reordered or of
//! another session. It reacts to silence in two stages. First it moves to the host's last estimate of the zero-flow displacement
//! and holds it, so the bead almost stops. A host that returns continues with its next command. If no command comes, the board
//! ramps to park and stays there until it is armed again.
//!
//! | state | output | left by |
//! |---|---|---|
//! | disarmed | at power-up displacement; after a session, or a reset in one, at park | arm, park |
//! | armed | holds where it was | first command, hold watchdog (to safe), arm, freeze, park, disarm |
//! | running | follows commands, within range and slew | watchdog (to holding), arm with its own number, freeze, park, disarm |
//! | holding | last zero-flow estimate | fresh command (to running), hold watchdog (to safe), arm, freeze, park, disarm |
//! | frozen | last zero-flow estimate | arm, hold watchdog (to safe), park, disarm |
//! | safe | ramp to park | arm, disarm |

use crate::config::{Config, ConfigError};
use crate::output::{Output, Trajectory};
use crate::session::Session;
use crate::transmit::TransmitBuffer;
use cellpos_link::{
    Arm, BoardState, Command, Decoder, Fault, Identity, PROTOCOL_VERSION, Refusal, Request, Status,
    ToBoard, ToHost,
};

/// Firmware version reported in the identity.
pub const FIRMWARE_VERSION: [u8; 3] = [0, 2, 0];
/// Interval of unsolicited status messages while no command is answered, us.
const STATUS_PERIOD_US: u64 = 10_000;
/// Longest stretch between two commands that interpolation bridges, us.
const LONGEST_BRIDGE_US: u64 = 5_000;

/// The board.
#[derive(Debug, Clone)]
pub struct Board {
    config: Config,
    decoder: Decoder<ToBoard>,
    transmit: TransmitBuffer,
    output: Output,
    trajectory: Trajectory,
    session: Session,
    state: BoardState,
    fault: Fault,
    /// Whether a host of the right protocol version said hello.
    greeted: bool,
    /// Whether the output is on its way to park after a reset.
    returning: bool,
    led: bool,
    now_us: u64,
    /// Time at which the hold watchdog was last fed.
    held_since_us: u64,
    next_status_us: u64,
    ignored: u32,
    late: u32,
    clipped: u32,
}

impl Board {
    /// A board that was just switched on at time 0: disarmed, at the power-up displacement.
    ///
    /// # Errors
    /// [`ConfigError`] names the first value that cannot be.
    pub fn new(config: Config) -> Result<Self, ConfigError> {
        config.validate()?;
        let output = Output::new(&config);
        Ok(Self {
            decoder: Decoder::new(),
            transmit: TransmitBuffer::new(),
            trajectory: Trajectory::hold(config.power_up_pm),
            output,
            session: Session::before_any(&config),
            state: BoardState::Disarmed,
            fault: Fault::None,
            greeted: false,
            returning: false,
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

    /// A board whose microcontroller was reset while its converter showed `applied_pm`. No host controls the bead from there, so
    /// the output first ramps to park. It can be armed after it has arrived.
    ///
    /// # Errors
    /// [`ConfigError`] names the first invalid value, also a displacement outside the range.
    pub fn after_reset(config: Config, applied_pm: i32) -> Result<Self, ConfigError> {
        let stands = Config {
            power_up_pm: applied_pm,
            ..config
        };
        let mut board = Self::new(stands)?;
        board.config = config;
        board.trajectory = Trajectory::hold(config.park_pm);
        board.returning = true;
        Ok(board)
    }

    /// Takes bytes that arrived at `now_us`. The output follows at the next [`Board::tick`].
    ///
    /// A time before the last one counts as the last one: the board's clock does not run backwards.
    pub fn receive(&mut self, bytes: &[u8], now_us: u64) {
        self.now_us = self.now_us.max(now_us);
        self.watch();
        let mut rest = bytes;
        while let Some(message) = self.decoder.next_message(&mut rest) {
            self.obey(message);
        }
    }

    /// Brings the output up to `now_us`; returns the code that the converter shows from now on.
    ///
    /// Call it every [`Config::update_us`] while the output moves. If calls come further apart, the output still moves by at most
    /// the slew of one update period per call. So a stalled board slows down and does not jump.
    pub fn tick(&mut self, now_us: u64) -> u16 {
        self.now_us = self.now_us.max(now_us);
        self.watch();
        self.advance();
        if self.greeted && self.now_us >= self.next_status_us {
            self.send_status();
        }
        self.output.code()
    }

    /// Moves bytes for the host into `out`; returns how many.
    pub fn transmit(&mut self, out: &mut [u8]) -> usize {
        self.transmit.take(out)
    }

    /// Next time at which the board must act without a message, us: the next step of a moving output, the end of a watchdog
    /// time, a status. Between events and messages, ticks change nothing.
    pub fn next_event_us(&self) -> u64 {
        let mut next = u64::MAX;
        if self.is_moving() {
            next = self.now_us.saturating_add(u64::from(self.config.update_us));
        }
        if let Some(deadline_us) = self.deadline_us() {
            next = next.min(deadline_us);
        }
        if self.greeted {
            next = next.min(self.next_status_us);
        }
        next.max(self.now_us.saturating_add(1))
    }

    /// Whether the output is still moving to its target.
    pub fn is_moving(&self) -> bool {
        let (target_pm, _) = self.target();
        !self.output.arrived(target_pm) || self.trajectory.ends_after(self.now_us)
    }

    /// Code at the converter.
    pub fn code(&self) -> u16 {
        self.output.code()
    }

    /// Displacement at the converter, pm.
    pub fn applied_pm(&self) -> i32 {
        self.output.applied_pm()
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

    /// The board's configuration.
    pub fn config(&self) -> &Config {
        &self.config
    }

    /// The status for the host.
    pub fn status(&self) -> Status {
        let applied_pm = self.output.applied_pm();
        Status {
            session: self.session.number,
            last_seq: self.session.last_seq,
            last_time_us: self.session.last_time_us,
            state: self.state,
            applied_pm,
            neutral_pm: self.session.neutral_pm.unwrap_or(applied_pm),
            board_time_us: self.now_us,
            fault: self.fault,
            led: self.led,
            bad_frames: self.decoder.bad_frames(),
            ignored: self.ignored,
            late: self.late,
            clipped: self.clipped,
            unsent: self.transmit.unsent(),
            holds: self.session.holds,
        }
    }

    fn advance(&mut self) {
        let (target_pm, rate_nm_per_s) = self.target();
        self.output.advance(self.now_us, target_pm, rate_nm_per_s);
        self.returning &= !self.output.arrived(target_pm);
    }

    /// Target (pm) and rate (nm/s) of the output in the present state.
    fn target(&self) -> (i32, u32) {
        let session = &self.session;
        let slew = session.limits.slew_nm_per_s;
        let pm = self.trajectory.at_pm(self.now_us);
        match self.state {
            BoardState::Disarmed | BoardState::Safe => (pm, self.config.ramp_nm_per_s.min(slew)),
            BoardState::Armed => (pm, slew),
            BoardState::Running | BoardState::Frozen | BoardState::Holding => {
                (session.within(pm), slew)
            }
        }
    }

    /// End of the watchdog time that runs in the present state.
    fn deadline_us(&self) -> Option<u64> {
        let session = &self.session;
        match self.state {
            BoardState::Running => {
                Some(session.last_command_us.saturating_add(session.watchdog_us))
            }
            BoardState::Frozen | BoardState::Armed | BoardState::Holding => {
                Some(self.held_since_us.saturating_add(session.hold_watchdog_us))
            }
            BoardState::Disarmed | BoardState::Safe => None,
        }
    }

    /// Acts on expired watchdogs; on both if the second has expired as well.
    fn watch(&mut self) {
        while let Some(deadline_us) = self.deadline_us().filter(|&end_us| self.now_us >= end_us) {
            match self.state {
                BoardState::Running => {
                    self.session.holds = self.session.holds.saturating_add(1);
                    self.raise(Fault::CommandTimeout);
                    self.hold(BoardState::Holding, deadline_us);
                }
                BoardState::Holding => self.go_to_park(BoardState::Safe),
                BoardState::Frozen => {
                    self.raise(Fault::FreezeTimeout);
                    self.go_to_park(BoardState::Safe);
                }
                BoardState::Armed => {
                    self.raise(Fault::ArmTimeout);
                    self.go_to_park(BoardState::Safe);
                }
                BoardState::Disarmed | BoardState::Safe => return,
            }
        }
    }

    fn raise(&mut self, fault: Fault) {
        self.fault = fault;
        self.transmit.send(&ToHost::Fault {
            fault,
            board_time_us: self.now_us,
        });
    }

    /// Moves to the last zero-flow estimate and waits there, from `since_us` on, as long as the hold watchdog allows.
    fn hold(&mut self, state: BoardState, since_us: u64) {
        let applied_pm = self.output.applied_pm();
        let hold_pm = self.session.neutral_pm.unwrap_or(applied_pm);
        self.trajectory = Trajectory::hold(hold_pm);
        self.state = state;
        self.held_since_us = since_us;
        self.send_status();
    }

    fn go_to_park(&mut self, state: BoardState) {
        self.trajectory = Trajectory::hold(self.session.park_pm);
        self.state = state;
        self.send_status();
    }

    fn send_status(&mut self) {
        self.next_status_us = self.now_us.saturating_add(STATUS_PERIOD_US);
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
                // A disarmed board stays: its power-up displacement is nobody's park.
                if self.state == BoardState::Disarmed {
                    self.send_status();
                } else {
                    self.go_to_park(BoardState::Disarmed);
                }
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
        let config = &self.config;
        Identity {
            protocol: PROTOCOL_VERSION,
            firmware: FIRMWARE_VERSION,
            serial: config.serial,
            limits: config.limits,
            ramp_nm_per_s: config.ramp_nm_per_s,
            park_pm: config.park_pm,
            dac_bits: config.dac_bits,
            watchdog_ms: config.watchdog_ms,
            hold_watchdog_ms: config.hold_watchdog_ms,
        }
    }

    fn arm(&mut self, arm: &Arm) -> Result<(), Refusal> {
        if !self.greeted {
            return Err(Refusal::Protocol);
        }
        if self.returning {
            return Err(Refusal::State);
        }
        // A host with fresh commands is active: it must end its session first, or fall silent.
        if self.state == BoardState::Running && arm.session != self.session.number {
            return Err(Refusal::Busy);
        }
        self.session = Session::asked(arm, &self.config, self.now_us)?;
        self.fault = Fault::None;
        self.state = BoardState::Armed;
        self.held_since_us = self.now_us;
        self.trajectory = Trajectory::hold(self.output.applied_pm());
        self.send_status();
        Ok(())
    }

    fn freeze(&mut self) -> Result<(), Refusal> {
        match self.state {
            BoardState::Armed | BoardState::Running | BoardState::Holding => {
                self.hold(BoardState::Frozen, self.now_us);
                Ok(())
            }
            // A host that repeats freeze is alive.
            BoardState::Frozen => {
                self.held_since_us = self.now_us;
                Ok(())
            }
            BoardState::Disarmed | BoardState::Safe => Err(Refusal::State),
        }
    }

    fn command(&mut self, command: &Command) {
        let taken = matches!(
            self.state,
            BoardState::Armed | BoardState::Running | BoardState::Holding
        );
        if !taken || !self.session.is_fresh(command) {
            self.ignored = self.ignored.saturating_add(1);
            return;
        }
        if self
            .session
            .is_late(command, self.now_us, self.config.late_us)
        {
            self.late = self.late.saturating_add(1);
        }
        let to_pm = self.session.within(command.displacement_pm);
        if self.is_breach(command.displacement_pm, to_pm) {
            self.clipped = self.clipped.saturating_add(1);
        }
        let period_us = self.now_us.saturating_sub(self.session.last_command_us);
        let follows = self.state == BoardState::Running && self.session.last_seq.is_some();
        self.trajectory = if self.session.interpolate && follows {
            let shortest_us = u64::from(self.config.update_us);
            let bridge_us = period_us
                .min(LONGEST_BRIDGE_US.max(shortest_us))
                .max(shortest_us);
            let to_us = self.now_us.saturating_add(bridge_us);
            self.trajectory.towards(self.now_us, to_pm, to_us)
        } else {
            Trajectory::hold(to_pm)
        };
        self.session.last_seq = Some(command.seq);
        self.session.last_time_us = command.time_us;
        self.session.last_command_us = self.now_us;
        self.session.neutral_pm = Some(self.session.within(command.neutral_pm));
        // A host that resumes within the hold watchdog's time ends the fault.
        self.fault = Fault::None;
        self.state = BoardState::Running;
        if self.session.status_is_due() {
            // The status must show the output with this command in it.
            self.advance();
            self.send_status();
        }
    }

    /// Whether a command was clipped by more than the rounding of the converter: half a step beyond the end rounds to the
    /// end.
    fn is_breach(&self, asked_pm: i32, to_pm: i32) -> bool {
        let limits = &self.config.limits;
        let range_pm = u64::from(limits.high_pm.abs_diff(limits.low_pm));
        let beyond_pm = u64::from(asked_pm.abs_diff(to_pm));
        2 * beyond_pm * u64::from(self.config.highest_code()) > range_pm
    }
}
