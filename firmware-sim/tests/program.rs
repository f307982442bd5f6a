//! The program as its users meet it: a serial port, a socket, a log.

use cellpos_link::frames::FrameGatherer;
use cellpos_link::{
    Arm, BoardState, Command as BoardCommand, Decoder, Fault, MAX_FRAME, PROTOCOL_VERSION, Status,
    ToBoard, ToHost, encode, picometres, um_from_picometres,
};
use rustix::process::{Pid, Signal, kill_process};
use serialport::SerialPort;
use std::io::{Read, Write};
use std::os::unix::net::UnixStream;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};
use tempfile::TempDir;

/// Generous: the machine may be busy with other tests.
const PATIENCE: Duration = Duration::from_secs(20);

struct Sim {
    child: Child,
    dir: TempDir,
}

impl Sim {
    fn start(arguments: &[&str]) -> Self {
        let dir = tempfile::tempdir().unwrap();
        let path = |name: &str| dir.path().join(name).display().to_string();
        let child = Command::new(env!("CARGO_BIN_EXE_firmware-sim"))
            .args([
                "--pty-link",
                &path("pzt"),
                "--socket",
                &path("camera"),
                "--log",
                &path("log.csv"),
                "--best-effort",
                "--duration",
                "60s",
            ])
            .args(arguments)
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let sim = Self { child, dir };
        let deadline = Instant::now() + PATIENCE;
        while !sim.path("pzt").exists() || !sim.path("camera").exists() {
            assert!(Instant::now() < deadline, "the program does not come up");
            std::thread::sleep(Duration::from_millis(5));
        }
        sim
    }

    fn path(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    fn host(&self) -> Host {
        let port = serialport::new(self.path("pzt").to_string_lossy(), 921_600)
            .timeout(Duration::from_millis(2))
            .open()
            .unwrap();
        Host {
            port,
            decoder: Decoder::new(),
            seq: 0,
            status: None,
        }
    }

    /// Ends the program with SIGTERM; the rows of its log.
    fn finish(mut self) -> Vec<Row> {
        kill_process(Pid::from_child(&self.child), Signal::TERM).unwrap();
        assert!(self.child.wait().unwrap().success());
        assert!(!self.path("pzt").is_symlink() && !self.path("camera").exists());
        let text = std::fs::read_to_string(self.path("log.csv")).unwrap();
        text.lines().skip(1).map(Row::read).collect()
    }
}

impl Drop for Sim {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[derive(Debug)]
struct Row {
    time_s: f64,
    applied_um: f64,
    bead_um: f64,
    state: String,
    fault: String,
}

impl Row {
    fn read(line: &str) -> Self {
        let cells: Vec<&str> = line.split(',').collect();
        Self {
            time_s: cells[0].parse().unwrap(),
            applied_um: cells[2].parse().unwrap(),
            bead_um: cells[4].parse().unwrap(),
            state: cells[5].to_owned(),
            fault: cells[6].to_owned(),
        }
    }
}

struct Host {
    port: Box<dyn SerialPort>,
    decoder: Decoder<ToHost>,
    seq: u32,
    status: Option<Status>,
}

impl Host {
    fn say(&mut self, message: &ToBoard) {
        let mut frame = [0; MAX_FRAME];
        let length = encode(message, &mut frame).unwrap();
        self.port.write_all(&frame[..length]).unwrap();
    }

    fn hear(&mut self) -> Vec<ToHost> {
        let mut bytes = [0; 1024];
        let count = self.port.read(&mut bytes).unwrap_or(0);
        let mut rest = &bytes[..count];
        let mut heard = Vec::new();
        while let Some(message) = self.decoder.next_message(&mut rest) {
            if let ToHost::Status(status) = message {
                self.status = Some(status);
            }
            heard.push(message);
        }
        heard
    }

    fn wait_for(&mut self, mut wanted: impl FnMut(&ToHost) -> bool) -> ToHost {
        let deadline = Instant::now() + PATIENCE;
        while Instant::now() < deadline {
            if let Some(message) = self.hear().into_iter().find(|m| wanted(m)) {
                return message;
            }
        }
        panic!("the board does not say it; last status {:?}", self.status);
    }

    /// Hello and arm, with a watchdog that a busy machine does not trip.
    fn arm(&mut self, session: u16) {
        self.say(&ToBoard::Hello {
            protocol: PROTOCOL_VERSION,
        });
        self.wait_for(|m| matches!(m, ToHost::Identity(_)));
        self.say(&ToBoard::Arm(Arm {
            watchdog_ms: Some(400),
            hold_watchdog_ms: Some(300),
            ..Arm::session(session)
        }));
        self.wait_for(|m| matches!(m, ToHost::Status(s) if s.state == BoardState::Armed && s.session == session));
        self.seq = 0;
    }

    fn command(&mut self, session: u16, um: f64) {
        self.seq += 1;
        self.say(&ToBoard::Command(BoardCommand {
            session,
            seq: self.seq,
            time_us: u64::from(self.seq) * 1000,
            displacement_pm: picometres(um).unwrap(),
            neutral_pm: 20_000_000,
        }));
    }
}

#[test]
fn a_host_that_falls_silent_leaves_a_bead_at_rest_and_then_a_slew_limited_ramp_to_park() {
    let sim = Sim::start(&[]);
    let mut host = sim.host();
    host.arm(7);
    for _ in 0..100 {
        host.command(7, 20.5);
        host.hear();
    }
    let seq = host.seq;
    host.wait_for(|m| matches!(m, ToHost::Status(s) if s.last_seq == Some(seq)));
    // Silence. The board says that it holds, and then that it has parked, with its own words and numbers.
    let fault = host.wait_for(|m| matches!(m, ToHost::Fault { .. }));
    assert!(matches!(
        fault,
        ToHost::Fault {
            fault: Fault::CommandTimeout,
            ..
        }
    ));
    host.wait_for(
        |m| matches!(m, ToHost::Status(s) if s.state == BoardState::Safe && s.applied_pm == 0),
    );
    std::thread::sleep(Duration::from_millis(50));
    let rows = sim.finish();
    let running: Vec<&Row> = rows.iter().filter(|row| row.state == "Running").collect();
    let safe: Vec<&Row> = rows.iter().filter(|row| row.state == "Safe").collect();
    let holding: Vec<&Row> = rows.iter().filter(|row| row.state == "Holding").collect();
    let step_um = 40.0 / 65535.0;
    assert!((running[running.len() - 1].applied_um - 20.5).abs() <= step_um);
    let held_s = running[running.len() - 1].time_s - running[0].time_s;
    assert!(
        held_s > 0.39,
        "no ramp before the watchdog time is over: {held_s} s"
    );
    assert!(safe.iter().all(|row| row.fault == "CommandTimeout"));
    let at_rest = &holding[holding.len() / 2..];
    assert!(
        at_rest
            .iter()
            .all(|row| (row.applied_um - 20.0).abs() <= step_um)
    );
    for pair in safe.windows(2) {
        // The ramp is a staircase: one update period of 0.1 ms more may fall between two rows.
        let reach_um = 1000.0 * (pair[1].time_s - pair[0].time_s + 100e-6) + 2.0 * step_um;
        let fall_um = pair[0].applied_um - pair[1].applied_um;
        assert!(
            (-1e-9..=reach_um).contains(&fall_um),
            "{:?} to {:?}",
            pair[0],
            pair[1]
        );
    }
    assert!(safe.len() > 15, "20 um at 1 um/ms");
    assert_eq!(safe[safe.len() - 1].applied_um, 0.0);
    // The truth, too: 20 um from neutral the bead is swept away.
    assert!(rows[rows.len() - 1].bead_um < -20.0);
}

#[test]
fn a_second_host_finds_the_line_open_after_the_first_was_cut_off() {
    let sim = Sim::start(&[]);
    let mut first = sim.host();
    first.arm(1);
    first.command(1, 21.0);
    drop(first);
    // A session whose commands are fresh is not taken over: the board has to miss the first host.
    std::thread::sleep(Duration::from_millis(500));
    let mut second = sim.host();
    second.arm(2);
    second.command(2, 20.0);
    let status = second.wait_for(
        |m| matches!(m, ToHost::Status(s) if s.state == BoardState::Running && s.session == 2),
    );
    assert!(matches!(status, ToHost::Status(s) if s.last_seq == Some(1)));
}

#[test]
fn frames_come_over_the_socket_in_order_and_a_client_may_come_back() {
    let sim = Sim::start(&["--seed", "5"]);
    let mut last_id = None;
    for _ in 0..2 {
        let mut socket = UnixStream::connect(sim.path("camera")).unwrap();
        socket.set_read_timeout(Some(PATIENCE)).unwrap();
        let mut gatherer = FrameGatherer::new();
        let mut bytes = [0; 5000];
        let mut seen = 0;
        while seen < 50 {
            let count = socket.read(&mut bytes).unwrap();
            assert!(count > 0);
            let mut rest = &bytes[..count];
            while let Some((header, pixels)) = gatherer.next_frame(&mut rest).unwrap() {
                assert!(last_id.is_none_or(|last| header.frame_id > last));
                last_id = Some(header.frame_id);
                assert_eq!((header.width, header.height, header.bits), (256, 32, 8));
                // The latency of 2 ms, and the delay that the machine adds.
                assert!(header.sent_ns >= header.mid_exposure_ns + 2_000_000);
                let brightest = pixels.iter().max().unwrap();
                assert!(*brightest > 150, "the bead is in the picture");
                seen += 1;
            }
        }
    }
    sim.finish();
}

#[test]
fn garbage_on_the_line_is_counted_and_commands_still_get_through() {
    let sim = Sim::start(&["--link-garbage", "0s"]);
    let mut host = sim.host();
    host.arm(3);
    for _ in 0..100 {
        host.command(3, 20.25);
        host.hear();
        std::thread::sleep(Duration::from_millis(1));
    }
    let status = host.wait_for(|m| {
        matches!(m, ToHost::Status(s) if s.bad_frames > 3 && um_from_picometres(s.applied_pm) > 20.2)
    });
    assert!(matches!(status, ToHost::Status(s) if s.state == BoardState::Running));
    assert!(host.decoder.bad_frames() > 0);
    sim.finish();
}

#[test]
fn a_line_that_is_cut_leaves_the_board_to_its_watchdog() {
    let sim = Sim::start(&["--link-loss", "1s"]);
    let mut host = sim.host();
    host.arm(4);
    let deadline = Instant::now() + PATIENCE;
    let log = sim.path("log.csv");
    // Commands go on; only the log can tell that none arrives any more.
    loop {
        host.command(4, 20.0);
        host.hear();
        let text = std::fs::read_to_string(&log).unwrap();
        if text.contains(",Safe,CommandTimeout") {
            break;
        }
        assert!(Instant::now() < deadline);
    }
    let rows = sim.finish();
    let first = rows.iter().find(|row| row.state == "Safe").unwrap();
    assert!(first.time_s > 1.0, "cut at 1 s, safe at {} s", first.time_s);
}

#[test]
fn wrong_input_ends_with_code_2_and_says_what_would_be_right() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("rig.toml");
    std::fs::write(&file, "[emulator]\nlatency_s = 0.002\n").unwrap();
    let output = Command::new(env!("CARGO_BIN_EXE_firmware-sim"))
        .args(["--rig", &file.to_string_lossy()])
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(2));
    let text = String::from_utf8(output.stderr).unwrap();
    assert!(
        text.contains("latency_s") && text.contains("latency_ms"),
        "{text}"
    );
    let output = Command::new(env!("CARGO_BIN_EXE_firmware-sim"))
        .args(["--duration", "10"])
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(2));
    assert!(String::from_utf8(output.stderr).unwrap().contains("10s"));
}
