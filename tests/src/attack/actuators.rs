//! An actuator that a Python process serves: stalled, killed, killed and served again; and the program stalled and killed before it.
//!
//! `python/tests/emulated_device.py` serves the board of the rig in a box, and prints what it sets. It is judged as the board is: range,
//! slew over a period, park after silence. A run whose actuator was gone says so.

use super::{Attacked, Chance, Ended, box_rig, emptied, how, reads, start, wait};
use crate::programs::{PATIENCE, RigInABox, cellpos};
use rustix::process::{Pid, Signal, kill_process};
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

const PARK_UM: f64 = 12.0;
const PERIOD_S: f64 = 0.02;
const SLEW_UM_PER_S: f64 = 200.0;
/// Silence of the actuator that surely ends a run: twice what the rig file allows, for a busy machine.
const SURELY_SILENT_MS: u64 = 2000;
/// Its watchdog of five periods, two seconds of hold, the ramp to park, and a busy machine.
const PARKED_WITHIN: Duration = Duration::from_secs(6);

/// A run that went Safe before it was attacked, as happens on a machine that stalls.
const ENDED_BEFORE: &str = "safe before the attack";

/// Displacements that the function was called with, um.
type Sets = Arc<Mutex<Vec<f64>>>;

/// The Python process.
struct Server {
    child: Child,
    sets: Sets,
}

impl Server {
    fn start(folder: &Path) -> Option<Self> {
        let _ = std::fs::remove_file(folder.join("actuator.sock"));
        let python = Path::new(env!("CARGO_MANIFEST_DIR")).join("../python");
        let mut child = Command::new("python3")
            .arg(python.join("tests/emulated_device.py"))
            .args(["pzt", "actuator.sock", &PERIOD_S.to_string()])
            .env("PYTHONPATH", python.join("src"))
            .current_dir(folder)
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .ok()?;
        let sets = Sets::default();
        let (told, lines) = (
            Arc::clone(&sets),
            BufReader::new(child.stderr.take()?).lines(),
        );
        std::thread::spawn(move || {
            for line in lines.map_while(Result::ok) {
                let um = line.split(' ').nth(1).and_then(|um| um.parse().ok());
                if let (Some(um), Ok(mut sets)) = (um, told.lock()) {
                    sets.push(um);
                }
            }
        });
        let server = Self { child, sets };
        within(PATIENCE, || folder.join("actuator.sock").exists()).then_some(server)
    }

    fn signal(&self, signal: Signal) {
        let _ = kill_process(Pid::from_child(&self.child), signal);
    }

    fn sets(&self) -> Vec<f64> {
        self.sets
            .lock()
            .map(|sets| sets.clone())
            .unwrap_or_default()
    }

    fn is_parked(&self) -> bool {
        self.sets()
            .last()
            .is_some_and(|um| (um - PARK_UM).abs() < 1e-6)
    }

    /// What it set was within the range, and no faster than asked.
    fn judge(&self, what: &str, attacked: &mut Attacked) {
        let sets = self.sets();
        if let Some(um) = sets.iter().find(|um| !(0.0..=40.0).contains(*um)) {
            attacked.broken.push(format!("{what}: set {um} um"));
        }
        let most_um = SLEW_UM_PER_S * PERIOD_S + 1e-6;
        // The device is led from where it stood to the first command by the same slew.
        if let Some(pair) = sets
            .windows(2)
            .find(|pair| (pair[1] - pair[0]).abs() > most_um)
        {
            attacked
                .broken
                .push(format!("{what}: set {} um, then {} um", pair[0], pair[1]));
        }
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn within(patience: Duration, holds: impl Fn() -> bool) -> bool {
    let deadline = Instant::now() + patience;
    while !holds() {
        if Instant::now() > deadline {
            return false;
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    true
}

fn rig_file(folder: &Path) {
    box_rig(folder);
    let path = folder.join("rig.toml");
    let text = std::fs::read_to_string(&path).unwrap_or_default();
    let text = text
        .replace(
            "kind = \"serial\"\nport = \"pzt\"\nwatchdog_ms = 500",
            "kind = \"program\"\nsocket = \"actuator.sock\"",
        )
        .replace(
            "slew_um_per_s = 20000.0",
            &format!("slew_um_per_s = {SLEW_UM_PER_S}"),
        )
        .replace("budget_us = 1000.0", "board_silence_ms = 1000.0");
    // Arming is not what is attacked, and a busy machine disturbs each of its pulses.
    let text = text + "[arming]\ncheck = false\n";
    std::fs::write(path, text).expect("rig.toml is written");
}

/// A try of one kind. `None`: it never came to a bead that is held, and that was said.
fn attack(folder: &Path, number: u64, chance: &mut Chance, attacked: &mut Attacked) -> Option<()> {
    let kinds = [
        "served stalls",
        "program killed",
        "program stalls",
        "server killed",
        "served again",
    ];
    let kind = number as usize % kinds.len();
    let stall_ms = 20 + chance.below(3500);
    let what = format!("served actuator {number}, {}, {stall_ms} ms", kinds[kind]);
    emptied(folder);
    let rig = RigInABox::start(folder, &[]);
    let Some(mut server) = Server::start(folder) else {
        let why =
            "python3 with NumPy does not serve an actuator (--actuators 0 leaves this attack out)";
        attacked.broken.push(format!("{what}: {why}"));
        return None;
    };
    let line = "track --target 0um --rig rig.toml --duration 60s --best-effort --json";
    let child = start(&mut cellpos(folder, line));
    let pid = Pid::from_child(&child);
    let driven = || server.sets().len() > 60;
    if !within(PATIENCE, driven) {
        let _ = kill_process(pid, Signal::INT);
        let ended = wait(child, &what, attacked).map_or_else(String::new, |one| one.out + &one.err);
        attacked
            .broken
            .push(format!("{what}: no bead is held before it: {ended}"));
        return None;
    }
    std::thread::sleep(Duration::from_millis(chance.below(500)));
    let stall = Duration::from_millis(stall_ms);
    let surely_gone = match kind {
        0 => {
            server.signal(Signal::STOP);
            std::thread::sleep(stall);
            server.signal(Signal::CONT);
            stall_ms > SURELY_SILENT_MS
        }
        1 => {
            let _ = kill_process(pid, Signal::KILL);
            false
        }
        2 => {
            let _ = kill_process(pid, Signal::STOP);
            std::thread::sleep(stall);
            let _ = kill_process(pid, Signal::CONT);
            false
        }
        _ => {
            server.signal(Signal::KILL);
            true
        }
    };
    if kind == 4 {
        server.judge(&what, attacked);
        match Server::start(folder) {
            Some(again) => server = again,
            None => attacked.broken.push(format!("{what}: nobody serves again")),
        }
    }
    std::thread::sleep(Duration::from_millis(300));
    let _ = kill_process(pid, Signal::INT);
    let Ended { code, out, err } = wait(child, &what, attacked)?;
    if surely_gone && code != Some(1) {
        attacked
            .broken
            .push(format!("{what}: exit code {code:?}: {out} {err}"));
    }
    if kind < 3 && !within(PARKED_WITHIN, || server.is_parked()) {
        let last = server.sets().last().copied();
        attacked
            .broken
            .push(format!("{what}: not parked, but at {last:?} um"));
    }
    attacked.end(match kind {
        1 => "killed and parked".to_owned(),
        _ => how(folder, code),
    });
    server.judge(&what, attacked);
    drop(server);
    attacked.ends_within_range(rig, &what);
    reads(folder, &what, attacked);
    Some(())
}

/// Actuators that a Python process serves.
pub fn hostile_actuators(folder: &Path, tries: u64, chance: &mut Chance) -> Attacked {
    let mut attacked = Attacked::default();
    rig_file(folder);
    for number in 0..tries {
        if attack(folder, number, chance, &mut attacked).is_none() {
            break;
        }
    }
    let before = attacked.ends.get(ENDED_BEFORE).copied().unwrap_or(0);
    if 2 * before > attacked.tries {
        attacked.broken.push(format!(
            "{before} of {} runs were not attacked",
            attacked.tries
        ));
    }
    attacked
}
