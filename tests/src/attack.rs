//! The program under attack: killed, fed with damaged files, with boards and cameras that misbehave, stopped and signalled.
//!
//! Each attack says how many tries it made, how they ended, and what broke. A try fails if the program panics, hangs, ends with
//! an undocumented exit code, moves the PZT out of range, leaves an unreadable run, or does a cycle twice or not at all. `attack
//! --help` runs them in the numbers of a night; the tests of this package run a few
//! of each.

pub mod actuators;
pub mod cameras;
pub mod inputs;
pub mod sockets;

use crate::programs::{PATIENCE, RigInABox, cellpos};
use rustix::process::{Pid, Signal, kill_process};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// How an attack went.
#[derive(Debug, Clone, Default)]
pub struct Attacked {
    /// Tries made.
    pub tries: u64,
    /// How they ended, in a word, and how often.
    pub ends: BTreeMap<String, u64>,
    /// What broke, in a sentence each.
    pub broken: Vec<String>,
}

impl Attacked {
    fn end(&mut self, how: impl Into<String>) {
        self.tries += 1;
        *self.ends.entry(how.into()).or_default() += 1;
    }

    /// Ends a rig, whose log must show the PZT within its range throughout.
    fn ends_within_range(&mut self, rig: RigInABox, what: &str) {
        let outside = |um: f64| !(-1e-6..=40.0 + 1e-6).contains(&um);
        if let Some(row) = rig.finish().iter().find(|row| outside(row.applied_um)) {
            self.broken
                .push(format!("{what}: the PZT at {} um", row.applied_um));
        }
    }

    /// A line of the table.
    pub fn line(&self, name: &str) -> String {
        let ends: Vec<String> = self
            .ends
            .iter()
            .map(|(how, count)| format!("{count} {how}"))
            .collect();
        format!(
            "| {name} | {} | {} | {} |",
            self.tries,
            self.broken.len(),
            ends.join(", ")
        )
    }
}

/// Numbers that look like chance and are the same each time.
#[derive(Debug, Clone, Copy)]
pub struct Chance(u64);

impl Chance {
    /// From a seed.
    pub fn new(seed: u64) -> Self {
        Self(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1)
    }

    fn next(&mut self) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0
    }

    /// Below a bound.
    fn below(&mut self, bound: u64) -> u64 {
        self.next() % bound.max(1)
    }
}

/// What is left of a command.
struct Ended {
    code: Option<i32>,
    out: String,
    err: String,
}

/// Waits for a child, at most for twice [`PATIENCE`]; a child that does not end is killed and said to be broken.
fn wait(mut child: Child, what: &str, attacked: &mut Attacked) -> Option<Ended> {
    let deadline = Instant::now() + 2 * PATIENCE;
    while child.try_wait().ok()?.is_none() {
        if Instant::now() > deadline {
            let _ = child.kill();
            attacked.broken.push(format!("{what}: does not end"));
        }
        std::thread::sleep(Duration::from_millis(2));
    }
    let output = child.wait_with_output().ok()?;
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    let ended = Ended {
        code: output.status.code(),
        out: text(&output.stdout),
        err: text(&output.stderr),
    };
    if ended.err.contains("panicked at") || ended.code == Some(101) {
        let why = ended.err.lines().find(|line| line.contains("panicked"));
        let why = why.unwrap_or("exit code 101");
        attacked.broken.push(format!("{what}: {why}"));
    }
    Some(ended)
}

fn start(command: &mut Command) -> Child {
    command
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("cellpos starts")
}

/// Runs a command that must end with a documented exit code.
fn run(folder: &Path, line: &str, what: &str, attacked: &mut Attacked) -> Option<Ended> {
    let ended = wait(start(&mut cellpos(folder, line)), what, attacked)?;
    if !matches!(ended.code, Some(0..=2)) {
        attacked
            .broken
            .push(format!("{what}: {line}: exit code {:?}", ended.code));
    }
    Some(ended)
}

fn only_run(folder: &Path) -> Option<PathBuf> {
    let mut entries = std::fs::read_dir(folder.join("runs")).ok()?.flatten();
    entries.next().map(|entry| entry.path())
}

fn quick_script(folder: &Path, cycles: u64) {
    let text = format!(
        "name = \"quick\"\n[[step]]\ndo = \"sine\"\namplitude = \"1um\"\nfrequency = \"20Hz\"\ncycles = {cycles}\n"
    );
    std::fs::write(folder.join("quick.toml"), text).expect("a script is written");
}

/// Numbers of the cycles in a run's table.
fn cycles(run: &Path) -> Vec<u64> {
    let text = std::fs::read_to_string(run.join("cycles.csv")).unwrap_or_default();
    let whole = text.rfind('\n').map_or(0, |end| end + 1);
    text[..whole]
        .lines()
        .skip(1)
        .filter_map(|line| line.split(',').next()?.parse().ok())
        .collect()
}

/// How often a script is resumed after its last kill. A session that goes Safe, as happens on a machine that stalls, is one more
/// interruption.
const MOST_SESSIONS: u64 = 10;

/// `kill -9` of the program in the middle of a script, and on again, until it has been killed so often; then to its end. How
/// the sessions after the last kill ended is in the account: on a machine that is not busy there is one, and it is done.
pub fn kill_the_program(folder: &Path, kills: u64, chance: &mut Chance) -> Attacked {
    let mut attacked = Attacked::default();
    let count = 20 + 20 * kills;
    quick_script(folder, count);
    let options = "--best-effort --frames off --json";
    let mut done = 0;
    let mut more = 0;
    loop {
        let begun = only_run(folder);
        if let Some(run) = begun
            .as_ref()
            .filter(|run| !run.join("cycles.csv").exists())
        {
            // Killed before it had begun: there is nothing to go on with.
            let _ = std::fs::remove_dir_all(run);
        }
        let line = match only_run(folder) {
            Some(run) => format!("run --resume {} {options}", run.display()),
            None => format!("run quick.toml {options}"),
        };
        let child = start(&mut cellpos(folder, &line));
        if done == kills {
            let what = "the last session";
            let Some(ended) = wait(child, what, &mut attacked) else {
                break;
            };
            more += 1;
            let json: serde_json::Value = serde_json::from_str(&ended.out).unwrap_or_default();
            match json["ended"]["reason"].as_str() {
                Some(reason) if ended.code == Some(1) && more < MOST_SESSIONS => {
                    let how = format!("went on after safe ({reason})");
                    *attacked.ends.entry(how).or_default() += 1;
                    continue;
                }
                _ if ended.code == Some(0) => {}
                _ => attacked
                    .broken
                    .push(format!("{what}: {:?} {}", ended.code, ended.err)),
            }
            break;
        }
        std::thread::sleep(Duration::from_millis(300 + chance.below(2000)));
        let _ = kill_process(Pid::from_child(&child), Signal::KILL);
        if wait(child, "a killed session", &mut attacked).is_some_and(|ended| ended.code == Some(0))
        {
            attacked.end("was over before");
            break;
        }
        done += 1;
        attacked.end("killed");
    }
    if let Some(run) = only_run(folder) {
        if cycles(&run) != (0..count).collect::<Vec<u64>>() {
            attacked.broken.push(format!("cycles: {:?}", cycles(&run)));
        }
        let line = format!("export {} --out all.csv --force --json", run.display());
        let ended = self::run(folder, &line, "export", &mut attacked);
        if ended.is_none_or(|ended| ended.code != Some(0)) {
            attacked
                .broken
                .push("the sessions do not read whole".to_owned());
        }
    }
    attacked
}

/// rig.toml for a rig in a box.
fn box_rig(folder: &Path) {
    let text = "[actuator]\nkind = \"serial\"\nport = \"pzt\"\nwatchdog_ms = 500\n\
         [camera]\nkind = \"socket\"\nsocket = \"camera.sock\"\n\
         [vision]\nwindow_px = 21\n[vision.profile]\nkind = \"ring\"\nedge_px = 5.0\n\
         [calibration]\npixel_um = 0.1\norigin_px = 127.5\nsign = 1.0\n\
         [limits]\nlow_um = 0.0\nhigh_um = 40.0\nslew_um_per_s = 20000.0\npark_um = 12.0\n\
         [timing]\noldest_ms = 60.0\nfaults_in_a_row = 200\nbudget_us = 1000.0\n";
    std::fs::write(folder.join("rig.toml"), text).expect("rig.toml is written");
}

fn emptied(folder: &Path) {
    let _ = std::fs::remove_dir_all(folder.join("runs"));
    for name in ["pzt", "camera.sock", "actuator.sock", "box.csv"] {
        let _ = std::fs::remove_file(folder.join(name));
    }
}

const OVER_THE_LINE: &str = "track --target 0um --rig rig.toml --duration 2s --best-effort --json";

/// A rig in a box that does nothing wrong holds a bead: what is attacked afterwards is a run, and no refusal.
fn holds_before(folder: &Path, attacked: &mut Attacked) -> bool {
    box_rig(folder);
    emptied(folder);
    let rig = RigInABox::start(folder, &[]);
    let ended = run(folder, OVER_THE_LINE, "before the attack", attacked);
    drop(rig);
    let held = ended.as_ref().is_some_and(|ended| ended.code == Some(0));
    if !held {
        let why = ended.map_or_else(String::new, |ended| ended.out + &ended.err);
        attacked
            .broken
            .push(format!("before the attack: no bead is held: {why}"));
    }
    held
}

/// How a try ended: by its exit code, and whether it came to a run.
fn how(folder: &Path, code: Option<i32>) -> String {
    let code = code.unwrap_or(-1);
    match only_run(folder) {
        Some(_) => format!("exit {code}"),
        None => format!("exit {code} before a run"),
    }
}

/// The run that a try left reads back; a try that never came to a run leaves none.
fn reads(folder: &Path, what: &str, attacked: &mut Attacked) {
    let Some(run) = only_run(folder) else { return };
    let line = format!("export {} --out all.csv --force --json", run.display());
    if let Some(ended) = self::run(folder, &line, what, attacked)
        && ended.code == Some(2)
    {
        attacked
            .broken
            .push(format!("{what}: the run does not read: {}", ended.err));
    }
}

/// `kill -9` of the rig while a bead is held.
pub fn kill_the_rig(folder: &Path, kills: u64, chance: &mut Chance) -> Attacked {
    let mut attacked = Attacked::default();
    if !holds_before(folder, &mut attacked) {
        return attacked;
    }
    for number in 0..kills {
        emptied(folder);
        let what = format!("rig killed, {number}");
        let rig = RigInABox::start(folder, &[]);
        let line = "track --target 0um --rig rig.toml --duration 60s --best-effort --json";
        let child = start(&mut cellpos(folder, line));
        std::thread::sleep(Duration::from_millis(500 + chance.below(2500)));
        drop(rig);
        let Some(ended) = wait(child, &what, &mut attacked) else {
            continue;
        };
        if ended.code == Some(0) {
            attacked
                .broken
                .push(format!("{what}: said that all went well"));
        }
        attacked.end(how(folder, ended.code));
        reads(folder, &what, &mut attacked);
    }
    attacked
}

/// Boards whose link garbles and dies, behind a real line.
pub fn hostile_boards(folder: &Path, tries: u64, chance: &mut Chance) -> Attacked {
    let mut attacked = Attacked::default();
    if !holds_before(folder, &mut attacked) {
        return attacked;
    }
    for number in 0..tries {
        emptied(folder);
        let what = format!("board {number}");
        let mut options = vec![format!("--link-garbage={}Hz", 1 + chance.below(400))];
        if chance.below(2) == 0 {
            let at = 200 + chance.below(1500);
            options.push(format!("--link-loss={at}ms,{}ms", 1 + chance.below(800)));
        }
        let options: Vec<&str> = options.iter().map(String::as_str).collect();
        let rig = RigInABox::start(folder, &options);
        if let Some(ended) = run(folder, OVER_THE_LINE, &what, &mut attacked) {
            attacked.end(how(folder, ended.code));
        }
        attacked.ends_within_range(rig, &what);
        reads(folder, &what, &mut attacked);
    }
    attacked
}

/// Stopped, continued, interrupted, hung up on, poked: the program ends on request, and its run is readable.
pub fn stalls_and_signals(folder: &Path, tries: u64, chance: &mut Chance) -> Attacked {
    let mut attacked = Attacked::default();
    let signals = [
        ("STOP", Signal::STOP),
        ("INT", Signal::INT),
        ("TERM", Signal::TERM),
        ("HUP", Signal::HUP),
        ("TSTP", Signal::TSTP),
        ("USR1", Signal::USR1),
        ("USR2", Signal::USR2),
    ];
    for number in 0..tries {
        emptied(folder);
        let (name, signal) = signals[number as usize % signals.len()];
        let what = format!("signal {name}, {number}");
        let line = "track --target 0um --duration 60s --best-effort --frames off --json";
        let child = start(&mut cellpos(folder, line));
        let pid = Pid::from_child(&child);
        std::thread::sleep(Duration::from_millis(20 + chance.below(3000)));
        let _ = kill_process(pid, signal);
        std::thread::sleep(Duration::from_millis(chance.below(500)));
        let _ = kill_process(pid, Signal::CONT);
        std::thread::sleep(Duration::from_millis(300));
        // Whatever came before: this ends it, and a second one at once.
        let _ = kill_process(pid, Signal::INT);
        std::thread::sleep(Duration::from_millis(300));
        let _ = kill_process(pid, Signal::INT);
        if let Some(ended) = wait(child, &what, &mut attacked) {
            let how = match ended.code {
                Some(code) => format!("exit {code}"),
                None => format!("killed by {name}"),
            };
            attacked.end(how);
        }
        reads(folder, &what, &mut attacked);
    }
    attacked
}
