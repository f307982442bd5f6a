//! The host's side of the conversation with the PZT board, on any byte port.

use crate::outbox::{Kind, Outbox};
use crate::port::Port;
use cellpos_link::{
    Arm, BoardState, Command, Decoder, Fault, Identity, Limits, MAX_FRAME, Order, PROTOCOL_VERSION,
    Refusal, Request, Status, ToBoard, ToHost, encode, order, picometres, um_from_picometres,
};
use cellpos_rig::{
    Actuator, ActuatorError, ActuatorFault, ActuatorInfo, ActuatorReport, ActuatorState,
    ArmRequest, Clock, CommandAccount,
};
use std::time::Duration;

/// Longest time until the answer to a request.
const ANSWER_WITHIN: Duration = Duration::from_millis(500);
/// Longest time until the answer to the first hello. A board that resets when its port is opened, or a line that wakes up slowly
/// (a pseudo-terminal of QEMU looks once a second), is silent at first.
const HELLO_WITHIN: Duration = Duration::from_secs(3);
/// Interval between repetitions of a request within that time.
const REPEAT_EVERY: Duration = Duration::from_millis(50);

fn state_of(state: BoardState) -> ActuatorState {
    match state {
        BoardState::Disarmed => ActuatorState::Disarmed,
        BoardState::Armed => ActuatorState::Armed,
        BoardState::Running => ActuatorState::Running,
        BoardState::Frozen => ActuatorState::Frozen,
        BoardState::Safe => ActuatorState::Safe,
        BoardState::Holding => ActuatorState::Holding,
    }
}

fn fault_of(fault: Fault) -> ActuatorFault {
    match fault {
        Fault::None => ActuatorFault::None,
        Fault::CommandTimeout => ActuatorFault::CommandTimeout,
        Fault::FreezeTimeout => ActuatorFault::FreezeTimeout,
        Fault::ArmTimeout => ActuatorFault::ArmTimeout,
    }
}

/// A request in words.
fn name_of(request: Request) -> &'static str {
    match request {
        Request::Hello => "to say what it is (hello)",
        Request::Arm => "to be armed",
        Request::Command => "to take a command",
        Request::Freeze => "to freeze",
        Request::Park => "to park",
        Request::Disarm => "to be disarmed",
        Request::Led => "to switch its LED",
    }
}

/// A refusal in words.
fn reason_of(refusal: Refusal) -> &'static str {
    match refusal {
        Refusal::Protocol => {
            "it speaks another version of the protocol: update the firmware or the program"
        }
        Refusal::Limits => {
            "range or slew of the session are empty or wider than its own: narrow [limits] in rig.toml"
        }
        Refusal::Park => "the park displacement is outside its range: change park_um in rig.toml",
        Refusal::Watchdog => {
            "a watchdog time is zero or longer than it allows: change watchdog_ms or hold_watchdog_ms in rig.toml"
        }
        Refusal::Busy => {
            "another program has armed it and sends commands: end that program, or wait until it is silent"
        }
        Refusal::State => "not possible in its present state: arm it again",
    }
}

/// A PZT board at the end of a port.
#[derive(Debug)]
pub struct BoardHost<P> {
    port: P,
    clock: Clock,
    decoder: Decoder<ToHost>,
    outbox: Outbox,
    identity: Identity,
    session: u16,
    seq: u32,
    first_seq: u32,
    account: CommandAccount,
    /// Newest command that a status of this session names as obeyed.
    answered_seq: Option<u32>,
    /// Commands of earlier sessions that the line did not take.
    not_taken_before: u64,
    newest: Option<ActuatorReport>,
}

impl<P: Port> BoardHost<P> {
    /// Says hello and reads the board's identity.
    ///
    /// # Errors
    /// No answer, a broken line, or another version of the protocol.
    pub fn connect(port: P, clock: Clock) -> Result<Self, ActuatorError> {
        let mut host = Self {
            port,
            clock,
            decoder: Decoder::new(),
            outbox: Outbox::default(),
            identity: Identity {
                protocol: 0,
                firmware: [0; 3],
                serial: 0,
                limits: Limits {
                    low_pm: 0,
                    high_pm: 0,
                    slew_nm_per_s: 0,
                },
                ramp_nm_per_s: 0,
                park_pm: 0,
                dac_bits: 0,
                watchdog_ms: 0,
                hold_watchdog_ms: 0,
            },
            session: 0,
            seq: 0,
            first_seq: 0,
            account: CommandAccount::default(),
            answered_seq: None,
            not_taken_before: 0,
            newest: None,
        };
        let hello = ToBoard::Hello {
            protocol: PROTOCOL_VERSION,
        };
        let identity = host.ask(&hello, Request::Hello, |answer| match answer {
            ToHost::Identity(identity) => Some(identity),
            _ => None,
        })?;
        if identity.protocol != PROTOCOL_VERSION {
            return Err(ActuatorError::Incompatible {
                actuator: host.name(),
                expected: format!("protocol {PROTOCOL_VERSION}"),
                received: format!("protocol {}", identity.protocol),
            });
        }
        host.identity = identity;
        Ok(host)
    }

    /// Numbers the commands of each session from `seq` on (default 0), to test the wrap of the numbers, which comes after seven
    /// weeks at 1 kHz.
    pub fn count_from(&mut self, seq: u32) {
        self.first_seq = seq;
    }

    /// Description of the board.
    pub fn identity(&self) -> &Identity {
        &self.identity
    }

    /// The port.
    pub fn port_mut(&mut self) -> &mut P {
        &mut self.port
    }

    /// Frames from the board that could not be read.
    pub fn bad_frames(&self) -> u32 {
        self.decoder.bad_frames()
    }

    /// Switches the LED in front of the camera.
    ///
    /// # Errors
    /// The line is broken.
    pub fn led(&mut self, on: bool) -> Result<(), ActuatorError> {
        self.order(&ToBoard::Led { on })
    }

    /// Sends a ping and waits for its answer; gives the round trip and the board's time (us since its start), `None` when no
    /// answer came within `patience`.
    ///
    /// # Errors
    /// The line is broken.
    pub fn ping(
        &mut self,
        token: u32,
        patience: Duration,
    ) -> Result<Option<(Duration, u64)>, ActuatorError> {
        let start_ns = self.clock.now_ns();
        let patience_ns = i64::try_from(patience.as_nanos()).unwrap_or(i64::MAX / 4);
        self.send(&ToBoard::Ping { token })?;
        loop {
            let found = self.receive(|answer| match answer {
                ToHost::Pong {
                    token: of,
                    board_time_us,
                } if of == token => Some(board_time_us),
                _ => None,
            })?;
            let waited_ns = self.clock.now_ns() - start_ns;
            if let Some(board_time_us) = found {
                let trip = Duration::from_nanos(waited_ns.max(0) as u64);
                return Ok(Some((trip, board_time_us)));
            }
            if waited_ns > patience_ns {
                return Ok(None);
            }
            self.clock.sleep(Duration::from_micros(20));
        }
    }

    /// Asks for the board's status: state and counters.
    ///
    /// # Errors
    /// The line is broken, or no status came.
    pub fn status(&mut self) -> Result<Status, ActuatorError> {
        // No refusal answers a status request, so the request only serves as the name in errors.
        self.ask(
            &ToBoard::StatusRequest,
            Request::Hello,
            |answer| match answer {
                ToHost::Status(status) => Some(status),
                _ => None,
            },
        )
    }

    fn name(&self) -> String {
        format!("PZT board on {}", self.port.name())
    }

    fn line_error(&self, stage: &'static str, source: std::io::Error) -> ActuatorError {
        ActuatorError::Line {
            actuator: self.name(),
            stage,
            source,
        }
    }

    /// Sends a message; whether the line has taken it completely.
    fn send(&mut self, message: &ToBoard) -> Result<bool, ActuatorError> {
        let mut wire = [0; MAX_FRAME];
        // The longest message fits by the link's own bound; an encoding error would be a defect of the link.
        let length = encode(message, &mut wire)
            .map_err(|error| self.line_error("encoding a message", std::io::Error::other(error)))?;
        let kind = match message {
            ToBoard::Command(_) => Kind::Command,
            _ => Kind::Order,
        };
        self.outbox.put(&wire, length, kind);
        self.flush()
    }

    fn flush(&mut self) -> Result<bool, ActuatorError> {
        self.outbox
            .push(&mut self.port)
            .map_err(|error| self.line_error("writing", error))
    }

    /// Sends a message that must reach the board. If the line accepts nothing, it waits; after the time of an answer it leaves
    /// the message to [`Actuator::poll`].
    fn order(&mut self, message: &ToBoard) -> Result<(), ActuatorError> {
        let give_up_ns = self.clock.now_ns() + ANSWER_WITHIN.as_nanos() as i64;
        let mut sent = self.send(message)?;
        while !sent && self.clock.now_ns() < give_up_ns {
            self.clock.sleep(Duration::from_micros(200));
            sent = self.flush()?;
        }
        Ok(())
    }

    /// Counts the commands of this session that the board has obeyed, by the numbers that its reports name.
    fn answered(&mut self, status: &Status) {
        let Some(seq) = status.last_seq.filter(|_| status.session == self.session) else {
            return;
        };
        let passed_over = match self.answered_seq {
            None => seq.wrapping_sub(self.first_seq),
            Some(last) => match order(last, seq) {
                Order::Newer { skipped } => skipped,
                Order::Same | Order::Older => return,
            },
        };
        self.account.answered += 1;
        self.account.passed_over += u64::from(passed_over);
        self.answered_seq = Some(seq);
    }

    fn note(&mut self, status: &Status) -> ActuatorReport {
        let report = ActuatorReport {
            session: status.session,
            state: state_of(status.state),
            fault: fault_of(status.fault),
            applied_um: um_from_picometres(status.applied_pm),
            last_seq: status.last_seq,
            last_time_us: status.last_time_us,
            device_time_us: status.board_time_us,
            bad_frames: status.bad_frames,
            ignored: status.ignored,
            holds: status.holds,
            read_ns: self.clock.now_ns(),
        };
        self.newest = Some(report);
        report
    }

    /// Reads the messages that have arrived, and passes each to `each` until that returns a result.
    fn receive<T>(
        &mut self,
        mut each: impl FnMut(ToHost) -> Option<T>,
    ) -> Result<Option<T>, ActuatorError> {
        let mut buffer = [0; 512];
        loop {
            let length = self
                .port
                .read_available(&mut buffer)
                .map_err(|error| self.line_error("reading", error))?;
            if length == 0 {
                return Ok(None);
            }
            let mut bytes = &buffer[..length];
            let mut found = None;
            while let Some(message) = self.decoder.next_message(&mut bytes) {
                if let ToHost::Status(status) = &message {
                    self.answered(status);
                    self.note(status);
                }
                found = found.or_else(|| each(message));
            }
            if found.is_some() {
                return Ok(found);
            }
        }
    }

    /// Sends a request, again if need be, until `answer` succeeds.
    fn ask<T>(
        &mut self,
        message: &ToBoard,
        request: Request,
        mut answer: impl FnMut(ToHost) -> Option<T>,
    ) -> Result<T, ActuatorError> {
        let within = match request {
            Request::Hello => HELLO_WITHIN,
            _ => ANSWER_WITHIN,
        };
        let give_up_ns = self.clock.now_ns() + within.as_nanos() as i64;
        let actuator = self.name();
        while self.clock.now_ns() < give_up_ns {
            self.send(message)?;
            let again_ns = self.clock.now_ns() + REPEAT_EVERY.as_nanos() as i64;
            while self.clock.now_ns() < again_ns {
                let found = self.receive(|received| match received {
                    ToHost::Refused {
                        request: refused,
                        refusal,
                    } if refused == request => Some(Err(refusal)),
                    other => answer(other).map(Ok),
                })?;
                match found {
                    Some(Ok(found)) => return Ok(found),
                    Some(Err(refusal)) => {
                        return Err(ActuatorError::Refused {
                            actuator,
                            request: name_of(request),
                            reason: reason_of(refusal).to_string(),
                        });
                    }
                    None => self.clock.sleep(Duration::from_micros(500)),
                }
            }
        }
        Err(ActuatorError::Timeout {
            actuator,
            request: name_of(request),
            after: within,
        })
    }
}

impl<P: Port> Actuator for BoardHost<P> {
    fn info(&self) -> ActuatorInfo {
        let limits = &self.identity.limits;
        let (low_um, high_um) = (
            um_from_picometres(limits.low_pm),
            um_from_picometres(limits.high_pm),
        );
        let codes = (1_u32 << self.identity.dac_bits.min(31)) - 1;
        let [major, minor, patch] = self.identity.firmware;
        ActuatorInfo {
            name: format!(
                "{}, serial number {}, firmware {major}.{minor}.{patch}",
                self.name(),
                self.identity.serial
            ),
            low_um,
            high_um,
            slew_um_per_s: f64::from(limits.slew_nm_per_s) * 1e-3,
            step_um: (high_um - low_um) / f64::from(codes.max(1)),
            watchdog_ms: self.identity.watchdog_ms,
            hold_watchdog_ms: self.identity.hold_watchdog_ms,
        }
    }

    fn arm(&mut self, request: &ArmRequest) -> Result<ActuatorReport, ActuatorError> {
        let [low_um, high_um, slew_um_per_s] = request.limits;
        let own = self.identity.limits;
        let arm = Arm {
            watchdog_ms: request.watchdog_ms,
            hold_watchdog_ms: request.hold_watchdog_ms,
            park_pm: picometres(request.park_um),
            // Rounded to whole units the wish may lie a hair outside the board's own limits: those are refused as wider.
            limits: Some(Limits {
                low_pm: picometres(low_um).map_or(own.low_pm, |pm| pm.max(own.low_pm)),
                high_pm: picometres(high_um).map_or(own.high_pm, |pm| pm.min(own.high_pm)),
                slew_nm_per_s: ((slew_um_per_s * 1e3).round() as u32).min(own.slew_nm_per_s),
            }),
            ..Arm::session(request.session)
        };
        (self.account, self.answered_seq) = (CommandAccount::default(), None);
        self.not_taken_before = self.outbox.not_taken();
        self.session = request.session;
        self.seq = self.first_seq;
        self.ask(&ToBoard::Arm(arm), Request::Arm, |answer| match answer {
            ToHost::Ack {
                request: Request::Arm,
            } => Some(()),
            _ => None,
        })?;
        let status = self.ask(
            &ToBoard::StatusRequest,
            Request::Arm,
            |answer| match answer {
                ToHost::Status(status) => Some(status),
                _ => None,
            },
        )?;
        Ok(self.note(&status))
    }

    fn command(
        &mut self,
        command_um: f64,
        neutral_um: f64,
        time_us: u64,
    ) -> Result<(), ActuatorError> {
        let (Some(displacement_pm), Some(neutral_pm)) =
            (picometres(command_um), picometres(neutral_um))
        else {
            return Err(ActuatorError::NotANumber {
                command_um,
                neutral_um,
            });
        };
        let command = Command {
            session: self.session,
            seq: self.seq,
            time_us,
            displacement_pm,
            neutral_pm,
        };
        self.seq = self.seq.wrapping_add(1);
        self.account.commands += 1;
        self.send(&ToBoard::Command(command)).map(|_| ())
    }

    fn freeze(&mut self) -> Result<(), ActuatorError> {
        self.order(&ToBoard::Freeze)
    }

    fn park(&mut self) -> Result<(), ActuatorError> {
        self.order(&ToBoard::Park)
    }

    fn disarm(&mut self) -> Result<(), ActuatorError> {
        self.order(&ToBoard::Disarm)
    }

    fn poll(&mut self) -> Result<Option<ActuatorReport>, ActuatorError> {
        self.newest = None;
        if !self.outbox.is_empty() {
            self.flush()?;
        }
        self.receive(|_| None::<()>)?;
        Ok(self.newest.take())
    }

    fn account(&self) -> Option<CommandAccount> {
        let not_taken = self.outbox.not_taken() - self.not_taken_before;
        Some(CommandAccount {
            not_taken,
            ..self.account
        })
    }
}
