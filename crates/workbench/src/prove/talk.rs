//! The board's protocol, message by message, with each answer and its time.

use cellpos_drivers::Port;
use cellpos_link::{
    Command, Decoder, MAX_FRAME, PROTOCOL_VERSION, Request, Status, ToBoard, ToHost, encode,
};
use cellpos_rig::Clock;
use cellpos_session::Failure;

/// Longest wait for an answer if the protocol names no time, ms.
pub(super) const ANSWER_MS: f64 = 500.0;

/// A conversation with an untrusted board.
pub struct Talk {
    port: Box<dyn Port>,
    decoder: Decoder<ToHost>,
    clock: Clock,
    /// Messages since the last clear, each with the time of its reading, ns.
    pub(super) heard: Vec<(i64, ToHost)>,
    pub(super) session: u16,
    pub(super) seq: u32,
    start_ns: i64,
    token: u32,
    /// Displacement and zero flow of the last command, pm.
    last: Option<(i32, i32)>,
}

impl Talk {
    /// Opens a conversation with the device on a port.
    pub fn on(port: Box<dyn Port>) -> Self {
        let clock = Clock::Real;
        let start_ns = clock.now_ns();
        Self {
            port,
            decoder: Decoder::new(),
            heard: Vec::new(),
            // Session numbers are random: the last digits of the clock.
            session: (start_ns / 1000 % 60_000) as u16 + 1,
            seq: 0,
            start_ns,
            token: 0,
            last: None,
            clock,
        }
    }

    /// Time of the machine, ns.
    pub(super) fn now_ns(&self) -> i64 {
        self.clock.now_ns()
    }

    pub(super) fn sleep_until_ns(&self, at_ns: i64) {
        self.clock.sleep_until_ns(at_ns);
    }

    /// Writes all bytes to the line.
    pub(super) fn send_bytes(&mut self, mut bytes: &[u8]) -> Result<(), Failure> {
        let give_up_ns = self.now_ns() + (ANSWER_MS * 1e6) as i64;
        while !bytes.is_empty() {
            let taken = self.port.write_some(bytes).map_err(Failure::failed)?;
            bytes = bytes.get(taken..).unwrap_or(&[]);
            if taken == 0 {
                if self.now_ns() > give_up_ns {
                    return Err(Failure::failed(std::io::Error::other(format!(
                        "{}: the line takes nothing",
                        self.port.name()
                    ))));
                }
                self.clock.sleep(std::time::Duration::from_micros(100));
            }
        }
        Ok(())
    }

    /// A message in its form on the line.
    pub(super) fn wire(message: &ToBoard) -> Result<Vec<u8>, Failure> {
        let mut bytes = [0; MAX_FRAME];
        let length = encode(message, &mut bytes).map_err(Failure::failed)?;
        Ok(bytes.get(..length).unwrap_or(&[]).to_vec())
    }

    pub(super) fn send(&mut self, message: &ToBoard) -> Result<(), Failure> {
        let wire = Self::wire(message)?;
        self.send_bytes(&wire)
    }

    /// Takes what has arrived.
    pub(super) fn pump(&mut self) -> Result<(), Failure> {
        let mut buffer = [0; 512];
        loop {
            let length = self
                .port
                .read_available(&mut buffer)
                .map_err(Failure::failed)?;
            if length == 0 {
                return Ok(());
            }
            let at_ns = self.now_ns();
            let mut bytes = buffer.get(..length).unwrap_or(&[]);
            while let Some(message) = self.decoder.next_message(&mut bytes) {
                self.heard.push((at_ns, message));
            }
        }
    }

    /// Listens for a time, ms.
    pub(super) fn listen(&mut self, ms: f64) -> Result<(), Failure> {
        let end_ns = self.now_ns() + (ms * 1e6) as i64;
        loop {
            self.pump()?;
            let left_ns = end_ns - self.now_ns();
            if left_ns <= 0 {
                return Ok(());
            }
            let nap_ns = left_ns.min(100_000) as u64;
            self.clock.sleep(std::time::Duration::from_nanos(nap_ns));
        }
    }

    /// Waits for the answer to a message that was sent from `start_ns` on, at most for a time, ms; returns it with the time that it
    /// took, ms. A board can answer before the write returns: the time begins before it.
    pub(super) fn wait_since<T>(
        &mut self,
        start_ns: i64,
        ms: f64,
        is: impl Fn(&ToHost) -> Option<T>,
    ) -> Result<Option<(T, f64)>, Failure> {
        let mut seen = 0;
        loop {
            self.pump()?;
            for (at_ns, message) in self.heard.get(seen..).unwrap_or(&[]) {
                if let Some(found) = is(message) {
                    return Ok(Some((found, (at_ns - start_ns).max(0) as f64 * 1e-6)));
                }
            }
            seen = self.heard.len();
            if (self.now_ns() - start_ns) as f64 * 1e-6 > ms {
                return Ok(None);
            }
            self.clock.sleep(std::time::Duration::from_micros(50));
        }
    }

    /// Sends a message and waits for its answer; forgets earlier messages.
    pub(super) fn ask<T>(
        &mut self,
        message: &ToBoard,
        ms: f64,
        is: impl Fn(&ToHost) -> Option<T>,
    ) -> Result<Option<(T, f64)>, Failure> {
        self.pump()?;
        self.heard.clear();
        let start_ns = self.now_ns();
        self.send(message)?;
        self.wait_since(start_ns, ms, is)
    }

    /// Repeats the hello for as long as a board may take that is reset when its port is opened.
    pub(super) fn hello(&mut self) -> Result<Option<(cellpos_link::Identity, f64)>, Failure> {
        let hello = ToBoard::Hello {
            protocol: PROTOCOL_VERSION,
        };
        let start_ns = self.now_ns();
        while (self.now_ns() - start_ns) as f64 * 1e-6 < 3000.0 {
            let answer = self.ask(&hello, 50.0, |m| match m {
                ToHost::Identity(identity) => Some(*identity),
                _ => None,
            })?;
            if let Some((identity, _)) = answer {
                return Ok(Some((identity, (self.now_ns() - start_ns) as f64 * 1e-6)));
            }
        }
        Ok(None)
    }

    /// Round trip of a ping, ms, and the board's time at it, us.
    pub(super) fn ping(&mut self, ms: f64) -> Result<Option<(f64, u64)>, Failure> {
        self.token = self.token.wrapping_add(1);
        let of = self.token;
        let pong = self.ask(&ToBoard::Ping { token: of }, ms, |m| match m {
            ToHost::Pong {
                token,
                board_time_us,
            } if *token == of => Some(*board_time_us),
            _ => None,
        })?;
        Ok(pong.map(|(time_us, ms)| (ms, time_us)))
    }

    /// The status after all that was sent so far: the answer to a ping comes after all earlier answers.
    pub(super) fn status(&mut self) -> Result<Option<Status>, Failure> {
        if self.ping(ANSWER_MS)?.is_none() {
            return Ok(None);
        }
        let status = self.ask(&ToBoard::StatusRequest, ANSWER_MS, |m| match m {
            ToHost::Status(status) => Some(*status),
            _ => None,
        })?;
        Ok(status.map(|(status, _)| status))
    }

    /// The status, or a failure in words if none comes.
    pub(super) fn must_status(&mut self) -> Result<Status, Failure> {
        let name = self.port.name().to_string();
        self.status()?.ok_or_else(|| {
            Failure::failed(std::io::Error::other(format!(
                "{name}: no status within {ANSWER_MS} ms of a status request"
            )))
        })
    }

    /// Whether a request is acknowledged (`Ok`), or why not, in words.
    pub(super) fn request(
        &mut self,
        message: &ToBoard,
        request: Request,
    ) -> Result<Result<(), String>, Failure> {
        let answer = self.ask(message, ANSWER_MS, |m| match m {
            ToHost::Ack { request: of } if *of == request => Some(Ok(())),
            ToHost::Refused {
                request: of,
                refusal,
            } if *of == request => Some(Err(format!("{refusal:?}").to_lowercase())),
            _ => None,
        })?;
        Ok(match answer {
            Some((answer, _)) => answer,
            None => Err("no answer".to_string()),
        })
    }

    /// The next command of the session, and its number.
    pub(super) fn command(
        &mut self,
        displacement_pm: i32,
        neutral_pm: i32,
    ) -> Result<u32, Failure> {
        let seq = self.seq;
        self.seq = self.seq.wrapping_add(1);
        self.last = Some((displacement_pm, neutral_pm));
        self.send(&self.command_of(self.session, seq, displacement_pm, neutral_pm))?;
        Ok(seq)
    }

    /// Board time, us.
    ///
    /// # Errors
    /// The line breaks, or no status comes.
    pub fn board_time_us(&mut self) -> Result<u64, Failure> {
        Ok(self.must_status()?.board_time_us)
    }

    /// Commands the last place again, so that the board's watchdog is fed, and returns the board time of its last message, us.
    ///
    /// # Errors
    /// The line breaks.
    pub fn keep_fed(&mut self) -> Result<Option<u64>, Failure> {
        self.pump()?;
        self.heard.clear();
        if let Some((displacement_pm, neutral_pm)) = self.last {
            self.command(displacement_pm, neutral_pm)?;
        }
        // A board that was reset speaks when it is greeted.
        self.send(&ToBoard::Hello {
            protocol: PROTOCOL_VERSION,
        })?;
        self.send(&ToBoard::StatusRequest)?;
        self.listen(20.0)?;
        Ok(self.statuses().last().map(|status| status.board_time_us))
    }

    /// Any command.
    pub(super) fn command_of(
        &self,
        session: u16,
        seq: u32,
        displacement_pm: i32,
        neutral_pm: i32,
    ) -> ToBoard {
        ToBoard::Command(Command {
            session,
            seq,
            time_us: ((self.now_ns() - self.start_ns) / 1000).unsigned_abs(),
            displacement_pm,
            neutral_pm,
        })
    }

    /// Statuses that were heard, in their order.
    pub(super) fn statuses(&self) -> impl Iterator<Item = &Status> {
        self.heard.iter().filter_map(|(_, m)| match m {
            ToHost::Status(status) => Some(status),
            _ => None,
        })
    }
}
