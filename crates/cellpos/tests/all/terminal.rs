//! A terminal that takes no output (Ctrl-S, a stalled line) holds up nothing.

use rustix::fs::OFlags;
use serde_json::Value;
use serialport::{SerialPort, TTYPort};
use std::fs::OpenOptions;
use std::io::{ErrorKind, Read, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

#[test]
fn a_terminal_that_takes_no_output_stops_neither_the_loop_nor_the_recorder() {
    let folder = tempfile::tempdir().unwrap();
    let (mut master, slave) = TTYPort::pair().unwrap();
    let name = slave.name().unwrap();
    let plain = OFlags::NOCTTY.bits().cast_signed();
    // Full to the brim, and nobody reads: the next byte blocks whoever writes it.
    let mut brim = OpenOptions::new()
        .write(true)
        .custom_flags(plain | OFlags::NONBLOCK.bits().cast_signed())
        .open(&name)
        .unwrap();
    loop {
        match brim.write(&[b'.'; 512]) {
            Ok(0) => break,
            Ok(_) => {}
            Err(error) if error.kind() == ErrorKind::WouldBlock => break,
            Err(error) => panic!("{error}"),
        }
    }
    let terminal = OpenOptions::new()
        .write(true)
        .custom_flags(plain)
        .open(&name)
        .unwrap();
    let mut child = Command::new(env!("CARGO_BIN_EXE_cellpos"))
        .args("track --target 0um --duration 3s --frames off --best-effort --json".split(' '))
        .current_dir(folder.path())
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::from(terminal))
        .spawn()
        .unwrap();
    // The run comes to its end, and its folder is closed, while the terminal still takes nothing.
    let began = Instant::now();
    loop {
        let closed = std::fs::read_dir(folder.path().join("runs"))
            .ok()
            .and_then(|mut runs| runs.next()?.ok())
            .and_then(|run| std::fs::read_to_string(run.path().join("run.toml")).ok())
            .is_some_and(|text| text.contains("outcome"));
        if closed {
            break;
        }
        assert!(began.elapsed() < Duration::from_secs(60), "it is held up");
        std::thread::sleep(Duration::from_millis(20));
    }
    // Ctrl-Q: the last messages may appear.
    let reading = std::thread::spawn(move || {
        master.set_timeout(Duration::from_millis(100)).unwrap();
        let mut bytes = [0; 4096];
        while began.elapsed() < Duration::from_secs(60) {
            match master.read(&mut bytes) {
                Ok(_) => {}
                Err(error) if error.kind() == ErrorKind::TimedOut => {}
                Err(_) => break,
            }
        }
    });
    let mut out = String::new();
    child
        .stdout
        .take()
        .unwrap()
        .read_to_string(&mut out)
        .unwrap();
    let status = child.wait().unwrap();
    drop((brim, slave));
    let result: Value = serde_json::from_str(&out).unwrap();
    assert_eq!(status.code(), Some(0), "{result}");
    assert_eq!(result["ended"]["kind"], "done", "{result}");
    assert_eq!(result["records_lost"], 0, "{result}");
    reading.join().unwrap();
}
