//! `cellpos run` on a board behind a real pseudo-terminal and a camera behind a real socket, killed and resumed.

use cellpos_tests::programs::{BoxRow, RigInABox, cellpos};
use std::path::{Path, PathBuf};
use std::time::Duration;

const PARK_UM: f64 = 12.0;
const WATCHDOG_MS: f64 = 50.0;
const HOLD_WATCHDOG_MS: f64 = 50.0;
/// What was on its way to the board when the program died, and a stall within a row.
const STALL_MARGIN_MS: f64 = 30.0;

fn write_files(folder: &Path, cycles: u32) {
    let rig = format!(
        "[actuator]\nkind = \"serial\"\nport = \"pzt\"\nwatchdog_ms = {WATCHDOG_MS}\n\
         hold_watchdog_ms = {HOLD_WATCHDOG_MS}\n\
         [camera]\nkind = \"socket\"\nsocket = \"camera.sock\"\n\
         [vision]\nwindow_px = 21\n[vision.profile]\nkind = \"ring\"\nedge_px = 5.0\n\
         [calibration]\npixel_um = 0.1\norigin_px = 127.5\nsign = 1.0\n\
         [limits]\nlow_um = 0.0\nhigh_um = 40.0\nslew_um_per_s = 20000.0\npark_um = {PARK_UM}\n\
         [timing]\noldest_ms = 60.0\nfaults_in_a_row = 1000\nbudget_us = 1000.0\nlost_ticks = 20000\n"
    );
    std::fs::write(folder.join("rig.toml"), rig).unwrap();
    let script = format!(
        "name = \"cycles\"\n[[step]]\ndo = \"sine\"\namplitude = \"1um\"\nfrequency = \"10Hz\"\ncycles = {cycles}\n"
    );
    std::fs::write(folder.join("script.toml"), script).unwrap();
}

fn acknowledged(run: &Path) -> Vec<u64> {
    let text = std::fs::read_to_string(run.join("cycles.csv")).unwrap_or_default();
    let whole = text.rfind('\n').map_or(0, |end| end + 1);
    text[..whole]
        .lines()
        .skip(1)
        .map(|line| line.split(',').next().unwrap().parse().unwrap())
        .collect()
}

fn run_folder(folder: &Path) -> Option<PathBuf> {
    let mut runs = std::fs::read_dir(folder.join("runs")).ok()?.flatten();
    runs.next()
        .map(|entry| entry.path())
        .filter(|run| run.join("cycles.csv").exists())
}

fn monotonic_ns() -> i64 {
    let now = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
    now.tv_sec * 1_000_000_000 + now.tv_nsec
}

/// Time until the board was in Safe, ms, on the board's clock: stalls of the machine do not count.
fn safe_after(rows: &[BoxRow], killed_ns: i64) -> Option<f64> {
    const STALL_MS: f64 = 3.0;
    let mut lived_ms = 0.0;
    let mut last_ns = killed_ns;
    for row in rows.iter().filter(|row| row.monotonic_ns >= killed_ns) {
        lived_ms += ((row.monotonic_ns - last_ns) as f64 * 1e-6).min(STALL_MS);
        last_ns = row.monotonic_ns;
        if row.state == "Safe" {
            return Some(lived_ms);
        }
    }
    None
}

/// Kills a run at moments that a seed fixes, resumes it each time, and lets the last session come to its end.
fn killed(kills: u32, cycles: u32) {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    write_files(folder, cycles);
    let elsewhere = folder.join("elsewhere");
    std::fs::create_dir(&elsewhere).unwrap();
    let rig = RigInABox::start(
        folder,
        &["--duration", "1000s", "--new-bead-after", "100ms"],
    );
    let mut random = cellpos_numeric::Random::new(1);
    let mut killed_ns = Vec::new();
    let mut before: Vec<u64> = Vec::new();
    // A busy machine ends a session now and then; it must not end them all.
    let mut in_vain = 0;
    loop {
        in_vain += 1;
        assert!(in_vain < 20, "sessions end before they do anything");
        let (from, line) = match run_folder(folder) {
            // Board and camera are found from any folder, though rig.toml names them by relative paths.
            Some(run) => (
                elsewhere.as_path(),
                format!("run --resume {} --best-effort --json", run.display()),
            ),
            None => {
                // Killed before there was a table: nothing was acknowledged, nothing is lost.
                let _ = std::fs::remove_dir_all(folder.join("runs"));
                let line = "run script.toml --rig rig.toml --best-effort --json";
                (folder, line.to_string())
            }
        };
        let mut child = cellpos(from, &line)
            .stdout(std::process::Stdio::null())
            .stderr(std::process::Stdio::null())
            .spawn()
            .unwrap();
        let last = killed_ns.len() as u32 >= kills;
        let ended = if last {
            Some(child.wait().unwrap())
        } else {
            std::thread::sleep(Duration::from_millis(600 + random.below(2400) as u64));
            child.try_wait().unwrap()
        };
        if ended.is_none() {
            child.kill().unwrap();
            child.wait().unwrap();
            in_vain = 0;
            killed_ns.push(monotonic_ns());
            // The board has to notice before somebody arms it again.
            std::thread::sleep(Duration::from_millis(300));
        }
        if let Some(run) = run_folder(folder) {
            let now = acknowledged(&run);
            assert!(now.starts_with(&before), "an acknowledged row is gone");
            assert_eq!(now, (0..now.len() as u64).collect::<Vec<u64>>());
            if now.len() > before.len() {
                in_vain = 0;
            }
            before = now;
        }
        if before.len() as u32 == cycles {
            break;
        }
    }
    let rows = rig.finish();
    let mut parked = 0;
    let mut longest_ms: f64 = 0.0;
    for &at_ns in &killed_ns {
        // A session killed before it had armed the board leaves it as the one before did: disarmed or safe.
        let state = rows
            .iter()
            .rev()
            .find(|row| row.monotonic_ns <= at_ns)
            .map_or("", |row| row.state.as_str());
        if ["Running", "Holding", "Frozen", "Armed"].contains(&state) {
            let after_ms = safe_after(&rows, at_ns).expect("parked after a kill");
            assert!(
                after_ms <= WATCHDOG_MS + HOLD_WATCHDOG_MS + STALL_MARGIN_MS,
                "{after_ms} ms in {state}"
            );
            longest_ms = longest_ms.max(after_ms);
            parked += 1;
        }
    }
    eprintln!(
        "{} kills, {parked} while armed, parked after {} ms at most",
        killed_ns.len(),
        longest_ms.round()
    );
    assert_eq!(killed_ns.len() as u32, kills);
    assert!(parked > 0);
    let last = rows.last().unwrap();
    assert!((last.applied_um - PARK_UM).abs() < 0.01, "{last:?}");
}

#[test]
fn a_killed_run_on_a_board_of_its_own_parks_it_and_is_resumed_without_losing_a_cycle() {
    killed(2, 60);
}

#[test]
#[ignore = "fifty kills in real time take some minutes"]
fn fifty_kills_on_a_board_of_its_own_lose_no_cycle_and_park_it_each_time() {
    killed(50, 1250);
}
