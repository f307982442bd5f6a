//! The board's promises: whatever comes in, and when nothing comes in any more. Here is the desk that the tests share.

mod arming;
mod commands;
mod fuzz;
mod stops;

use cellpos_board::{Board, Config};
use cellpos_link::{
    Arm, BoardState, Command, Decoder, MAX_FRAME, PROTOCOL_VERSION, Status, ToBoard, ToHost,
    encode, picometres, um_from_picometres,
};

fn wire(message: &ToBoard) -> Vec<u8> {
    let mut frame = [0; MAX_FRAME];
    let length = encode(message, &mut frame).unwrap();
    frame[..length].to_vec()
}

/// A board with a host that can speak and listen.
struct Desk {
    board: Board,
    decoder: Decoder<ToHost>,
    now_us: u64,
    seq: u32,
}

impl Desk {
    fn new(config: Config) -> Self {
        Self::of(Board::new(config).unwrap())
    }

    fn of(board: Board) -> Self {
        Self {
            board,
            decoder: Decoder::new(),
            now_us: 0,
            seq: 0,
        }
    }

    fn armed(config: Config, arm: Arm) -> Self {
        let mut desk = Self::new(config);
        desk.say(ToBoard::Hello {
            protocol: PROTOCOL_VERSION,
        });
        desk.say(ToBoard::Arm(arm));
        assert_eq!(desk.board.state(), BoardState::Armed);
        desk.hear();
        desk
    }

    fn say(&mut self, message: ToBoard) {
        self.board.receive(&wire(&message), self.now_us);
    }

    fn command(&mut self, um: f64, neutral_um: f64) {
        self.seq += 1;
        let command = Command {
            session: 1,
            seq: self.seq,
            time_us: self.now_us,
            displacement_pm: picometres(um).unwrap(),
            neutral_pm: picometres(neutral_um).unwrap(),
        };
        self.say(ToBoard::Command(command));
    }

    fn applied_um(&self) -> f64 {
        um_from_picometres(self.board.applied_pm())
    }

    fn hear(&mut self) -> Vec<ToHost> {
        let mut heard = Vec::new();
        let mut bytes = [0; 100];
        loop {
            let count = self.board.transmit(&mut bytes);
            if count == 0 {
                return heard;
            }
            let mut rest = &bytes[..count];
            while let Some(message) = self.decoder.next_message(&mut rest) {
                heard.push(message);
            }
        }
    }

    fn status(&mut self) -> Status {
        self.say(ToBoard::StatusRequest);
        self.hear()
            .iter()
            .rev()
            .find_map(|m| match m {
                ToHost::Status(status) => Some(*status),
                _ => None,
            })
            .expect("a status was asked for")
    }

    /// Ticks every 100 us for `ms`; returns the applied displacement after each tick.
    fn run(&mut self, ms: f64) -> Vec<f64> {
        (0..(ms * 10.0) as usize)
            .map(|_| {
                self.now_us += 100;
                self.board.tick(self.now_us);
                self.applied_um()
            })
            .collect()
    }
}

const STEP_UM: f64 = 40.0 / 65535.0;
