//! The programs of the workspace, as `cargo test --workspace` has built them.

use std::cell::Cell;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::{Mutex, MutexGuard};
use std::time::{Duration, Instant};

/// Generous: a machine that stalls spoils segments, and an identification measures them again, a run of ten seconds up to five times.
pub const PATIENCE: Duration = Duration::from_secs(100);

/// The folder with the programs.
///
/// # Panics
/// They are not there: a run of this package's tests alone does not build them.
pub fn folder() -> PathBuf {
    let exe = std::env::current_exe().expect("a test knows its own path");
    // A test is in target/<profile>/deps; the programs are one folder up.
    let beside = exe.parent().expect("target/<profile>");
    let folder = if beside.ends_with("deps") {
        beside.parent().expect("target/<profile>").to_path_buf()
    } else {
        beside.to_path_buf()
    };
    for name in ["cellpos", "firmware-sim"] {
        assert!(
            folder.join(name).is_file(),
            "{name} is not built: run `cargo test --workspace`, or `cargo build --workspace --bins` first"
        );
    }
    folder
}

/// A command of `cellpos`, to be run in `working_folder`; the arguments are split at blanks.
pub fn cellpos(working_folder: &Path, line: &str) -> Command {
    let mut command = Command::new(folder().join("cellpos"));
    command
        .args(line.split_whitespace())
        .current_dir(working_folder);
    command
}

/// Standard output of a command as text.
pub fn stdout(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned()
}

/// What a command said on both outputs, on one line without the frames of its messages.
pub fn said(output: &Output) -> String {
    let text = stdout(output) + &String::from_utf8_lossy(&output.stderr);
    let text = text.replace(['│', '\n'], " ");
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// Waits until `holds`, at most for [`PATIENCE`].
///
/// # Panics
/// It does not come true.
pub fn wait_until(what: &str, mut holds: impl FnMut() -> bool) {
    let deadline = Instant::now() + PATIENCE;
    while !holds() {
        assert!(Instant::now() < deadline, "in vain: waited until {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// A test that has the machine's real time to itself, among those of its program.
///
/// Loop, camera and board ask for real-time priority: two rigs at once on two cores starve each other, and the test may fail for
/// that reason alone. Whoever holds it may take it again.
#[must_use = "it ends when it is dropped"]
pub struct Alone {
    _held: Option<MutexGuard<'static, ()>>,
}

/// Waits until no other test of this program runs in real time.
pub fn alone() -> Alone {
    static ONE_AT_A_TIME: Mutex<()> = Mutex::new(());
    let depth = HELD.get();
    HELD.set(depth + 1);
    // A test that failed with it has left nothing behind.
    let free = || {
        ONE_AT_A_TIME
            .lock()
            .unwrap_or_else(|poisoned| poisoned.into_inner())
    };
    Alone {
        _held: (depth == 0).then(free),
    }
}

impl Drop for Alone {
    fn drop(&mut self) {
        HELD.set(HELD.get() - 1);
    }
}

thread_local! {
    static HELD: Cell<usize> = const { Cell::new(0) };
}

/// `firmware-sim`, running, [`alone`]: board at `pzt`, camera at `camera.sock`, log at `box.csv` of its folder.
pub struct RigInABox {
    child: Child,
    folder: PathBuf,
    _alone: Alone,
}

/// A millisecond of the box, from its log.
#[derive(Debug, Clone, PartialEq)]
pub struct BoxRow {
    /// Monotonic clock of the machine, ns.
    pub monotonic_ns: i64,
    /// PZT displacement that the board applies, um.
    pub applied_um: f64,
    /// True bead position, um.
    pub bead_um: f64,
    /// State of the board.
    pub state: String,
}

impl RigInABox {
    /// Starts it and waits until it is up.
    pub fn start(working_folder: &Path, options: &[&str]) -> Self {
        let alone = alone();
        let child = Command::new(self::folder().join("firmware-sim"))
            .args([
                "--pty-link",
                "pzt",
                "--socket",
                "camera.sock",
                "--log",
                "box.csv",
            ])
            .args(if options.contains(&"--duration") {
                &[][..]
            } else {
                &["--duration", "120s"]
            })
            .args(options)
            .current_dir(working_folder)
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .expect("firmware-sim starts");
        let mut rig = Self {
            child,
            folder: working_folder.to_path_buf(),
            _alone: alone,
        };
        wait_until("firmware-sim is up", || {
            if rig.child.try_wait().is_ok_and(|status| status.is_some()) {
                let mut text = String::new();
                if let Some(mut stderr) = rig.child.stderr.take() {
                    let _ = stderr.read_to_string(&mut text);
                }
                panic!("firmware-sim ended: {text}");
            }
            ["pzt", "camera.sock"]
                .iter()
                .all(|name| working_folder.join(name).exists())
        });
        rig
    }

    /// Ends it and gives its log.
    pub fn finish(mut self) -> Vec<BoxRow> {
        let pid = rustix::process::Pid::from_child(&self.child);
        rustix::process::kill_process(pid, rustix::process::Signal::TERM).expect("it runs");
        self.child.wait().expect("it ends");
        let text = std::fs::read_to_string(self.folder.join("box.csv")).expect("it wrote a log");
        text.lines()
            .skip(1)
            .map(|line| {
                let cells: Vec<&str> = line.split(',').collect();
                let number = |i: usize| cells[i].parse::<f64>().unwrap_or(f64::NAN);
                BoxRow {
                    monotonic_ns: cells[1].parse().expect("an integer of nanoseconds"),
                    applied_um: number(2),
                    bead_um: number(4),
                    state: cells[5].to_owned(),
                }
            })
            .collect()
    }
}

impl Drop for RigInABox {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
