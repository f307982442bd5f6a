//! The host's side of the board over a line that stalls, takes half a frame, loses bytes, is unplugged and comes back.

use super::{LineFaults, MisbehavingLine};
use cellpos_board::{Board, Config};
use cellpos_drivers::{BoardHost, Port};
use cellpos_link::{Command, Decoder, ToBoard};
use cellpos_rig::{Actuator, ArmRequest, Clock};
use std::sync::{Arc, Mutex};

const MS: i64 = 1_000_000;
const SLEW_UM_PER_S: f64 = 600.0;

/// The firmware's board at the end of a perfect line, with its true state.
struct Bench {
    board: Board,
    /// Reads along what reaches the board.
    reader: Decoder<ToBoard>,
    reached: Vec<Command>,
    obeyed: u64,
    last_seq: Option<u32>,
    /// Output and time of the last look, pm and us.
    last: (i32, u64),
    fastest_um_per_s: f64,
}

impl Bench {
    fn new() -> Self {
        let board = Board::new(Config::DEFAULT).expect("a board");
        Self {
            last: (board.applied_pm(), 0),
            board,
            reader: Decoder::new(),
            reached: Vec::new(),
            obeyed: 0,
            last_seq: None,
            fastest_um_per_s: 0.0,
        }
    }

    /// Brings the board to a time, in steps of its output.
    fn advance(&mut self, now_ns: i64) {
        let now_us = (now_ns / 1000).unsigned_abs();
        loop {
            let step_us = self.board.next_event_us();
            if step_us > now_us {
                break;
            }
            self.board.tick(step_us);
            self.look(step_us);
        }
    }

    /// Speed of the output since its last change, minus the rounding of the converter.
    fn look(&mut self, now_us: u64) {
        let (pm, us) = self.last;
        let moved_um = f64::from(self.board.applied_pm().abs_diff(pm)) * 1e-6;
        if moved_um > 0.0 {
            let step_um = 1.001 * 40.0 / 65_535.0;
            let rate = (moved_um - step_um) / (now_us.saturating_sub(us) as f64 * 1e-6);
            self.fastest_um_per_s = self.fastest_um_per_s.max(rate);
            self.last = (self.board.applied_pm(), now_us);
        }
    }

    fn receive(&mut self, bytes: &[u8], now_ns: i64) {
        self.advance(now_ns);
        let mut rest = bytes;
        while let Some(message) = self.reader.next_message(&mut rest) {
            if let ToBoard::Command(command) = message {
                self.reached.push(command);
            }
        }
        // Frame by frame, so that each command that is obeyed is seen.
        for part in bytes.split_inclusive(|&byte| byte == 0) {
            self.board.receive(part, (now_ns / 1000).unsigned_abs());
            let last_seq = self.board.status().last_seq;
            self.obeyed += u64::from(last_seq != self.last_seq);
            self.last_seq = last_seq;
        }
        self.look((now_ns / 1000).unsigned_abs());
    }
}

#[derive(Clone)]
struct Line {
    bench: Arc<Mutex<Bench>>,
    clock: Clock,
}

impl Port for Line {
    fn name(&self) -> &str {
        "line"
    }
    fn write_some(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        let mut bench = self.bench.lock().expect("one thread");
        bench.receive(bytes, self.clock.now_ns());
        Ok(bytes.len())
    }
    fn read_available(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        let mut bench = self.bench.lock().expect("one thread");
        bench.advance(self.clock.now_ns());
        Ok(bench.board.transmit(buffer))
    }
}

/// Displacement of a command, um: faster than the slew allows, so that the slew is what is seen.
fn wish_um(k: u64) -> f64 {
    20.0 + 8.0 * (k as f64 * 0.11).sin()
}

/// Commands in a millisecond each over a line with these faults, into a board that is then left alone.
fn send(commands: u64, faults: LineFaults, seed: u64) {
    let clock = Clock::virtual_at(0);
    let bench = Arc::new(Mutex::new(Bench::new()));
    let line = Line {
        bench: Arc::clone(&bench),
        clock: clock.clone(),
    };
    let byte_loss = faults.byte_loss;
    let line = MisbehavingLine::new(line, clock.clone(), faults, seed);
    let mut host = BoardHost::connect(line, clock.clone()).expect("a board");
    let request = ArmRequest {
        session: 7,
        park_um: 2.0,
        limits: [2.0, 38.0, SLEW_UM_PER_S],
        watchdog_ms: Some(20),
        hold_watchdog_ms: Some(2000),
    };
    host.arm(&request).expect("armed");
    let start_ns = clock.now_ns();
    let mut lost_before = 0;
    for k in 0..commands {
        clock.sleep_until_ns(start_ns + k as i64 * MS);
        // An error is a line that is gone for the moment.
        let _ = host.command(wish_um(k), 20.0, k * 1000);
        let _ = host.poll();
        let lost = host.account().expect("counted").lost();
        assert!(lost >= lost_before, "a loss is not taken back");
        lost_before = lost;
        let mut bench = bench.lock().expect("one thread");
        for command in bench.reached.drain(..) {
            let sent =
                (command.displacement_pm - (wish_um(u64::from(command.seq)) * 1e6) as i32).abs();
            assert!(
                sent <= 1 && command.time_us == u64::from(command.seq) * 1000,
                "torn: {command:?}"
            );
            // Half a frame may wait for the end of a stall; whatever follows it is the newest.
            assert!(u64::from(command.seq) <= k);
        }
    }
    for _ in 0..600 {
        clock.sleep_until_ns(clock.now_ns() + MS);
        let _ = host.poll();
    }
    let account = host.account().expect("counted");
    let bench = bench.lock().expect("one thread");
    assert_eq!(account.commands, commands);
    assert!(account.answered <= bench.obeyed);
    if byte_loss == 0.0 {
        assert_eq!(account.answered, bench.obeyed);
        assert_eq!(account.lost_in_all(), commands - bench.obeyed);
        assert_eq!(bench.board.status().bad_frames, 0, "no frame is left half");
    }
    assert!(account.lost_in_all() >= commands - bench.obeyed);
    let fastest = bench.fastest_um_per_s;
    assert!(
        (0.9 * SLEW_UM_PER_S..=SLEW_UM_PER_S + 1e-6).contains(&fastest),
        "{fastest} um/s"
    );
}

/// A line with all faults.
fn bad() -> LineFaults {
    LineFaults {
        stalls_per_s: 1.0,
        part: 0.05,
        byte_loss: 1e-4,
        unplugged_ns: (1..1000)
            .map(|k| [k * 7000 * MS, (k * 7000 + 90) * MS])
            .collect(),
        ..LineFaults::default()
    }
}

#[test]
fn a_line_that_stalls_and_takes_parts_of_frames_tears_none_and_every_lost_command_is_counted() {
    let faults = LineFaults {
        stalls_per_s: 3.0,
        part: 0.2,
        ..LineFaults::default()
    };
    for seed in 0..4 {
        send(20_000, faults.clone(), seed);
    }
}

#[test]
fn a_line_that_loses_bytes_and_is_unplugged_tears_no_frame_either() {
    for seed in 0..4 {
        send(20_000, bad(), seed);
    }
}

#[test]
#[ignore = "minutes: cargo test --release -p cellpos-emulator --test all ten_million -- --ignored"]
fn ten_million_commands_over_a_line_that_misbehaves() {
    for seed in 0..10 {
        send(1_000_000, bad(), 100 + seed);
    }
}
