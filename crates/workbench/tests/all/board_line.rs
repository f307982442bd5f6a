//! A board on the machine's clock behind a port, with somebody on the line who may change what passes.

use cellpos_board::Board;
use cellpos_drivers::Port;
use cellpos_emulator::BoardConfig;
use cellpos_link::{Decoder, MAX_FRAME, Message, ToBoard, ToHost, encode};
use std::collections::VecDeque;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// A change to messages: drop it, pass it on, or replace it.
pub(crate) type Tamper<M> = fn(M) -> Option<M>;

/// A board that can be reset, shared by the ports to it.
pub(crate) struct Desk {
    board: Board,
    start: Instant,
    out: VecDeque<u8>,
    stepped_us: u64,
}

impl Desk {
    pub(crate) fn new() -> Arc<Mutex<Self>> {
        Arc::new(Mutex::new(Self {
            board: BoardConfig::default().board().unwrap(),
            start: Instant::now(),
            out: VecDeque::new(),
            stepped_us: 0,
        }))
    }

    fn now_us(&self) -> u64 {
        self.start.elapsed().as_micros() as u64
    }

    /// The microcontroller is reset; its converter keeps its code. `forgets`: as a firmware that does not go to park.
    pub(crate) fn reset(&mut self, forgets: bool) {
        let (config, applied_pm) = (*self.board.config(), self.board.applied_pm());
        let again = if forgets {
            Board::new(cellpos_board::Config {
                power_up_pm: applied_pm,
                ..config
            })
        } else {
            Board::after_reset(config, applied_pm)
        };
        self.board = again.unwrap();
        (self.start, self.stepped_us) = (Instant::now(), 0);
        self.out.clear();
    }

    /// Brings the board up to now, event by event.
    fn advance(&mut self) {
        let now_us = self.now_us();
        while self.board.next_event_us() <= now_us {
            let at_us = self.board.next_event_us().max(self.stepped_us);
            self.board.tick(at_us);
            self.stepped_us = at_us;
            self.collect();
        }
        self.board.tick(now_us);
        self.stepped_us = now_us;
        self.collect();
    }

    fn collect(&mut self) {
        let mut bytes = [0; 512];
        loop {
            let length = self.board.transmit(&mut bytes);
            if length == 0 {
                return;
            }
            self.out.extend(&bytes[..length]);
        }
    }

    fn receive(&mut self, bytes: &[u8]) {
        self.advance();
        let now_us = self.now_us();
        self.board.receive(bytes, now_us);
        self.advance();
    }
}

/// A port to the board.
pub(crate) struct DeskPort {
    desk: Arc<Mutex<Desk>>,
    to_board: Option<(Decoder<ToBoard>, Tamper<ToBoard>)>,
    to_host: Option<(Decoder<ToHost>, Tamper<ToHost>)>,
    ready: VecDeque<u8>,
    write_takes: Duration,
}

impl DeskPort {
    pub(crate) fn new(desk: &Arc<Mutex<Desk>>) -> Self {
        Self {
            desk: Arc::clone(desk),
            to_board: None,
            to_host: None,
            ready: VecDeque::new(),
            write_takes: Duration::ZERO,
        }
    }

    /// A write returns so much later: the board has answered by then.
    pub(crate) fn with_slow_writes(mut self, write_takes: Duration) -> Self {
        self.write_takes = write_takes;
        self
    }

    pub(crate) fn changing_orders(mut self, tamper: Tamper<ToBoard>) -> Self {
        self.to_board = Some((Decoder::new(), tamper));
        self
    }

    pub(crate) fn changing_answers(mut self, tamper: Tamper<ToHost>) -> Self {
        self.to_host = Some((Decoder::new(), tamper));
        self
    }
}

/// Messages of a stream, changed; what is no message is lost.
fn changed<M: Message>(decoder: &mut Decoder<M>, tamper: Tamper<M>, mut bytes: &[u8]) -> Vec<u8> {
    let mut out = Vec::new();
    while let Some(message) = decoder.next_message(&mut bytes) {
        if let Some(message) = tamper(message) {
            let mut wire = [0; MAX_FRAME];
            let length = encode(&message, &mut wire).unwrap();
            out.extend(&wire[..length]);
        }
    }
    out
}

impl Port for DeskPort {
    fn name(&self) -> &str {
        "a board on the desk"
    }

    fn write_some(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        let passed = match &mut self.to_board {
            Some((decoder, tamper)) => changed(decoder, *tamper, bytes),
            None => bytes.to_vec(),
        };
        self.desk.lock().unwrap().receive(&passed);
        std::thread::sleep(self.write_takes);
        Ok(bytes.len())
    }

    fn read_available(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        let bytes: Vec<u8> = {
            let mut desk = self.desk.lock().unwrap();
            desk.advance();
            desk.out.drain(..).collect()
        };
        let passed = match &mut self.to_host {
            Some((decoder, tamper)) => changed(decoder, *tamper, &bytes),
            None => bytes,
        };
        self.ready.extend(passed);
        let length = self.ready.len().min(buffer.len());
        for (place, byte) in buffer.iter_mut().zip(self.ready.drain(..length)) {
            *place = byte;
        }
        Ok(length)
    }
}
