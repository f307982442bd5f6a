//! A run on the whole terminal: its display, its keys, and the release of the terminal on every way out.

use rustix::fs::OFlags;
use rustix::termios::{self, LocalModes, Winsize};
use serialport::{SerialPort, TTYPort};
use std::fs::{File, OpenOptions};
use std::io::{ErrorKind, Read, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Generous: the machine may be busy with other tests.
const PATIENCE: Duration = Duration::from_secs(60);
/// Takes the whole terminal, and gives it back.
const TAKEN: &str = "\x1b[?1049h";
const GIVEN: &str = "\x1b[?1049l";

/// `cellpos` on a separate terminal, which may become its controlling terminal.
struct OnTerminal {
    child: Child,
    keys: TTYPort,
    terminal: File,
    written: Arc<Mutex<Vec<u8>>>,
    read_on: Arc<AtomicBool>,
    reader: Option<JoinHandle<()>>,
}

impl OnTerminal {
    fn start(folder: &Path, line: &str, columns: u16, rows: u16) -> Self {
        let (mut master, slave) = TTYPort::pair().unwrap();
        let open = || {
            OpenOptions::new()
                .read(true)
                .write(true)
                // The test's own terminal stays unchanged.
                .custom_flags(OFlags::NOCTTY.bits().cast_signed())
                .open(slave.name().unwrap())
                .unwrap()
        };
        let terminal = open();
        // As a shell has it: lines, echo, keys that are signals.
        let mut modes = termios::tcgetattr(&terminal).unwrap();
        modes
            .local_modes
            .insert(LocalModes::ICANON | LocalModes::ECHO | LocalModes::ISIG);
        for (index, key) in [
            (termios::SpecialCodeIndex::VINTR, 3),
            (termios::SpecialCodeIndex::VSUSP, 26),
        ] {
            modes.special_codes[index] = key;
        }
        termios::tcsetattr(&terminal, termios::OptionalActions::Now, &modes).unwrap();
        let size = Winsize {
            ws_row: rows,
            ws_col: columns,
            ws_xpixel: 0,
            ws_ypixel: 0,
        };
        termios::tcsetwinsize(&terminal, size).unwrap();
        let child = Command::new("setsid")
            .arg("--ctty")
            .arg(env!("CARGO_BIN_EXE_cellpos"))
            .args(line.split(' '))
            .current_dir(folder)
            .stdin(Stdio::from(open()))
            .stdout(Stdio::null())
            .stderr(Stdio::from(open()))
            .spawn()
            .unwrap();
        let keys = master.try_clone_native().unwrap();
        let (written, read_on) = (Arc::default(), Arc::new(AtomicBool::new(true)));
        let (to, on) = (Arc::clone(&written), Arc::clone(&read_on));
        let reader = std::thread::spawn(move || {
            master.set_timeout(Duration::from_millis(50)).unwrap();
            let mut bytes = [0; 4096];
            while on.load(Ordering::Acquire) {
                match master.read(&mut bytes) {
                    Ok(read) => {
                        let to: &Mutex<Vec<u8>> = &to;
                        to.lock().unwrap().extend(&bytes[..read]);
                    }
                    Err(error) if error.kind() == ErrorKind::TimedOut => {}
                    Err(_) => return,
                }
            }
        });
        Self {
            child,
            keys,
            terminal,
            written,
            read_on,
            reader: Some(reader),
        }
    }

    fn text(&self) -> String {
        String::from_utf8_lossy(&self.written.lock().unwrap()).into_owned()
    }

    /// What was written without the sequences between the letters.
    fn plain(&self) -> String {
        let text = self.text();
        let mut parts = text.split('\x1b');
        let mut out = parts.next().unwrap_or("").to_string();
        for part in parts {
            let end = part.find(|c: char| c.is_ascii_alphabetic());
            out.push_str(end.map_or("", |end| &part[end + 1..]));
        }
        out
    }

    fn wait_for(&self, what: &str) {
        let start = Instant::now();
        while !self.plain().contains(what) {
            assert!(
                start.elapsed() < PATIENCE,
                "not shown: {what}\n{}",
                self.plain()
            );
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    fn press(&mut self, keys: &str) {
        self.keys.write_all(keys.as_bytes()).unwrap();
    }

    /// How it ended, and the modes of the terminal then.
    fn end(mut self) -> (ExitStatus, LocalModes, String) {
        let start = Instant::now();
        let status = loop {
            if let Some(status) = self.child.try_wait().unwrap() {
                break status;
            }
            assert!(start.elapsed() < PATIENCE, "it goes on\n{}", self.plain());
            std::thread::sleep(Duration::from_millis(20));
        };
        // What it wrote last.
        std::thread::sleep(Duration::from_millis(200));
        let modes = termios::tcgetattr(&self.terminal).unwrap().local_modes;
        (status, modes, self.text())
    }
}

impl Drop for OnTerminal {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
        self.read_on.store(false, Ordering::Release);
        if let Some(reader) = self.reader.take() {
            let _ = reader.join();
        }
    }
}

/// Taken once and given back once, in this order; then what was said meanwhile.
fn is_given_back(text: &str) {
    let (taken, given) = (text.find(TAKEN), text.rfind(GIVEN));
    assert!(taken.is_some() && taken < given, "{text:?}");
    assert_eq!(text.matches(GIVEN).count(), 1, "{text:?}");
    let behind = &text[given.unwrap()..];
    assert!(!behind.contains("\x1b[?25l"), "the cursor: {behind:?}");
}

#[test]
fn a_run_fills_the_terminal_takes_keys_refuses_to_be_stopped_and_gives_the_terminal_back() {
    let folder = tempfile::tempdir().unwrap();
    let line = "track --target 0um --tui --best-effort --no-record --frames off";
    let mut run = OnTerminal::start(folder.path(), line, 100, 30);
    run.wait_for("RUNNING");
    run.wait_for("f freeze, q stop");
    run.press("2.5");
    run.wait_for("target: 2.5_");
    run.press("\r");
    run.press("f");
    run.wait_for("FROZEN");
    // Ctrl-Z: a stopped program cannot hold a bead, and the picture continues.
    run.press("\x1a");
    run.wait_for("SIGTSTP: refused");
    run.press("f");
    // Ctrl-C: freezes, then parks.
    run.press("\x03");
    let (status, modes, text) = run.end();
    assert_eq!(status.code(), Some(0), "{text}");
    is_given_back(&text);
    assert!(modes.contains(LocalModes::ICANON | LocalModes::ECHO));
    let behind = &text[text.rfind(GIVEN).unwrap()..];
    assert!(
        behind.contains("SIGTSTP") && behind.contains("SIGINT"),
        "{behind:?}"
    );
}

#[test]
fn a_script_fits_forty_columns_and_twelve_rows() {
    let folder = tempfile::tempdir().unwrap();
    let script = "name = \"small\"\n[[step]]\ndo = \"hold\"\nduration = \"1s\"\n[[step]]\ndo = \"sine\"\n\
                  amplitude = \"1um\"\nfrequency = \"5Hz\"\ncycles = 10\n";
    std::fs::write(folder.path().join("small.toml"), script).unwrap();
    let line = "run small.toml --tui --best-effort --frames off";
    let run = OnTerminal::start(folder.path(), line, 40, 12);
    run.wait_for("RUNNING");
    run.wait_for("of 10");
    let (status, _, text) = run.end();
    assert_eq!(status.code(), Some(0), "{text}");
    is_given_back(&text);
    // Nothing was written beyond the terminal's ends.
    for place in text.split("\x1b[").skip(1) {
        let Some((numbers, _)) = place.split_once('H') else {
            continue;
        };
        if let Some((row, column)) = numbers.split_once(';')
            && let (Ok(row), Ok(column)) = (row.parse::<u16>(), column.parse::<u16>())
        {
            assert!(row <= 12 && column <= 40, "{row};{column}");
        }
    }
}

#[test]
fn a_terminal_that_stalls_costs_the_run_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let line = "track --target 0um --tui --best-effort --frames off --duration 4s --json";
    let run = OnTerminal::start(folder.path(), line, 120, 40);
    run.wait_for("RUNNING");
    // From here on nobody reads: the terminal's buffer fills, and whoever writes to it waits.
    run.read_on.store(false, Ordering::Release);
    let start = Instant::now();
    loop {
        let text = std::fs::read_dir(folder.path().join("runs"))
            .ok()
            .and_then(|mut runs| runs.next()?.ok())
            .and_then(|run| std::fs::read_to_string(run.path().join("run.toml")).ok())
            .unwrap_or_default();
        // However the run ends on a loaded machine, it ends, and its rows are on the disk.
        if text.contains("records_lost") {
            assert!(text.contains("records_lost = 0"), "{text}");
            break;
        }
        assert!(start.elapsed() < PATIENCE, "it is held up");
        std::thread::sleep(Duration::from_millis(20));
    }
}

#[test]
fn without_a_terminal_there_is_no_screen() {
    let folder = tempfile::tempdir().unwrap();
    let output = Command::new(env!("CARGO_BIN_EXE_cellpos"))
        .args("track --target 0um --tui --no-record --duration 1s".split(' '))
        .current_dir(folder.path())
        .stdin(Stdio::null())
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(2));
    let text = String::from_utf8_lossy(&output.stderr);
    assert!(text.contains("--tui needs a terminal"), "{text}");
}
