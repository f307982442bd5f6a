//! Scripts when things go wrong: kills, a full disk, a rig on which everything fails; and signals.

use crate::script_runs::*;
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

/// A machine that stalls must not end a run: that is another test's subject.
const PATIENT: &str = "[timing]\noldest_ms = 1000.0\nfaults_in_a_row = 100000\nbudget_us = 1000.0\n\
                       lost_ticks = 100000\nboard_silence_ms = 10000.0\n[board]\nwatchdog_ms = 1000\n";

/// Runs a script in real time, killed at moments that a seed fixes, and resumed until it is done; gives the folder of the run
/// and how often it was killed.
fn killed_and_resumed(folder: &Path, cycles: u32, most: u32, extra: &[&str]) -> (PathBuf, u32) {
    script(folder, cycles);
    std::fs::write(folder.join("rig.toml"), PATIENT).unwrap();
    let mut random = cellpos_numeric::Random::new(1);
    let mut acknowledged: Vec<u64> = Vec::new();
    let mut kills = 0;
    let mut run: Option<PathBuf> = None;
    loop {
        let mut args = vec!["run"];
        let path = run.as_ref().map(|run| run.to_str().unwrap().to_string());
        match &path {
            Some(path) => args.extend(["--resume", path]),
            None => {
                args.extend(["quick.toml", "--rig", "rig.toml"]);
                args.extend(extra);
            }
        }
        args.extend(["--best-effort", "--json"]);
        let mut child = command(folder, &args)
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        if kills < most {
            std::thread::sleep(Duration::from_millis(300 + random.below(2500) as u64));
        }
        let ended = kills >= most || child.try_wait().unwrap().is_some();
        if !ended {
            child.kill().unwrap();
            kills += 1;
        }
        let out = child.wait_with_output().unwrap();
        if run.is_none() && folder.join("runs").exists() {
            // A first session that was killed before it had a table starts again.
            let first = only_run(folder);
            if first.join("cycles.csv").exists() {
                run = Some(first);
            } else {
                std::fs::remove_dir_all(&first).unwrap();
            }
        }
        if let Some(run) = &run {
            let text = std::fs::read_to_string(run.join("cycles.csv")).unwrap();
            let whole = text.rfind('\n').map_or(0, |end| end + 1);
            let now: Vec<u64> = text[..whole]
                .lines()
                .skip(1)
                .map(|line| line.split(',').next().unwrap().parse().unwrap())
                .collect();
            assert!(
                now.starts_with(&acknowledged),
                "an acknowledged row is gone"
            );
            assert_eq!(now, (0..now.len() as u64).collect::<Vec<u64>>());
            acknowledged = now;
        }
        if ended {
            let said = String::from_utf8_lossy(&[out.stdout, out.stderr].concat()).into_owned();
            assert_eq!(out.status.code(), Some(0), "{said}");
            let run = run.unwrap();
            assert_eq!(acknowledged, (0..u64::from(cycles)).collect::<Vec<u64>>());
            return (run, kills);
        }
    }
}

/// Every session's records read, and hold the ticks of the cycles that it acknowledged.
fn check_sessions(folder: &Path, run: &Path) {
    let mut sessions = vec![run.to_owned()];
    if let Ok(more) = std::fs::read_dir(run.join("sessions")) {
        sessions.extend(more.map(|entry| entry.unwrap().path()));
    }
    let (cycles, rows) = (numbers(run, "session"), column(run, "start_s"));
    for session in sessions {
        let path = session.to_str().unwrap();
        let mut args = vec!["export", path, "--out", "ticks.csv", "--json", "--force"];
        if session == *run {
            args.extend(["--session", "1"]);
        }
        let (code, out, err) = cellpos(folder, &args);
        assert_eq!(code, Some(0), "{err}");
        let export: Value = serde_json::from_str(&out).unwrap();
        let events = std::fs::read_to_string(session.join("events.jsonl")).unwrap();
        let Some(begun) = events.lines().next() else {
            continue;
        };
        let begun: Value = serde_json::from_str(begun).unwrap();
        assert_eq!(begun["event"], "session");
        let number = begun["data"]["number"].as_u64().unwrap();
        assert_eq!(begun["data"]["gap_s"].is_number(), number > 1);
        let ticks = std::fs::read_to_string(folder.join("ticks.csv")).unwrap();
        let last_s: f64 = ticks
            .lines()
            .last()
            .and_then(|line| line.split(',').next()?.parse().ok())
            .unwrap_or(-1.0);
        for (_, start_s) in cycles.iter().zip(&rows).filter(|(of, _)| **of == number) {
            let start_s: f64 = start_s.parse().unwrap_or(0.0);
            assert!(
                start_s + 0.05 <= last_s + 0.01,
                "{path}: {start_s} {last_s} {export}"
            );
        }
    }
}

#[test]
fn a_run_that_is_killed_again_and_again_has_every_cycle_once() {
    let folder = tempfile::tempdir().unwrap();
    let (run, kills) = killed_and_resumed(folder.path(), 60, 4, &["--frames", "off"]);
    assert!(kills >= 1);
    check_sessions(folder.path(), &run);
    let (code, out, _) = cellpos(folder.path(), &["run", "--resume", run.to_str().unwrap()]);
    assert_eq!(code, Some(0));
    assert!(out.contains("nothing to resume"));
}

#[test]
#[ignore = "fifty kills in real time take about four minutes"]
fn a_run_that_is_killed_fifty_times_has_every_cycle_once() {
    let folder = tempfile::tempdir().unwrap();
    let (run, kills) = killed_and_resumed(folder.path(), 1500, 50, &["--frames", "off"]);
    eprintln!("{kills} kills");
    assert_eq!(kills, 50);
    check_sessions(folder.path(), &run);
}

#[test]
fn a_full_disk_parks_the_rig_and_every_row_that_is_lost_is_said() {
    let folder = tempfile::tempdir().unwrap();
    script(folder.path(), 400);
    // A file may have 2 MB: the first batches of ticks fit, then none does any more. The refusal is as that of a full disk,
    // once the signal that comes with it is ignored.
    let program = env!("CARGO_BIN_EXE_cellpos");
    let out = Command::new("bash")
        .arg("-c")
        .arg(format!(
            "trap '' XFSZ; ulimit -f 2000; exec {program} run quick.toml --dry --json"
        ))
        .current_dir(folder.path())
        .output()
        .unwrap();
    let err = String::from_utf8_lossy(&out.stderr).into_owned();
    assert_eq!(out.status.code(), Some(1), "{err}");
    let result: Value = serde_json::from_slice(&out.stdout).unwrap();
    assert_eq!(result["summary"]["safe_reason"], "unrecorded", "{result}");
    let warnings = result["warnings"].to_string();
    assert!(warnings.contains("could not be written"), "{warnings}");
    assert!(err.contains("losses are counted"), "{err}");
    let run = only_run(folder.path());
    let export = json(
        folder.path(),
        &[
            "export",
            run.to_str().unwrap(),
            "--out",
            "ticks.csv",
            "--json",
        ],
    );
    let rows = export["rows"].as_u64().unwrap();
    assert!(rows > 8000, "{export}");
    assert_eq!(export["damaged_bytes"], 0);
    let meta = std::fs::read_to_string(run.join("run.toml")).unwrap();
    let lost: u64 = meta
        .lines()
        .find_map(|line| line.strip_prefix("rows_lost = "))
        .and_then(|cell| cell.parse().ok())
        .unwrap();
    let ticks = result["summary"]["ticks"].as_u64().unwrap();
    assert_eq!(rows + lost, ticks, "every tick is there or counted");
    // Half a second until the refusal is believed, and the bead's time to stop.
    assert!(ticks < rows + 8192 + 1500, "{ticks}");
    assert_eq!(result["summary"]["records_lost"], lost, "{result}");
}

/// A rig with every fault, again and again, and a controller whose optimiser fails, too.
fn write_night(folder: &Path, cycles: u32) {
    let mut rig = String::from(
        "[timing]\nfaults_in_a_row = 50\n[emulator]\nseed = 11\n[emulator.faults]\ndrop_rate = 0.002\nstale_rate = 0.001\n\
         double_rate = 0.001\nreorder_rate = 0.001\ngarbage_per_s = 0.2\n",
    );
    let mut event = |kind: &str, at_s: f64, for_s: f64| {
        rig.push_str(&format!(
            "[[emulator.faults.event]]\nkind = \"{kind}\"\nat_s = {at_s:?}\nfor_s = {for_s:?}\n"
        ));
    };
    // The ring of the recorder holds 16 s.
    event("stall-recorder", 10.0, 18.0);
    let mut at_s = 2.0;
    while at_s < f64::from(cycles) / 10.0 {
        for (kind, after_s, for_s) in [
            ("lose-bead", 0.0, 0.12),
            ("stale-frames", 4.0, 0.004),
            ("drop-frames", 8.0, 0.03),
            ("link-garbage", 12.0, 0.02),
            ("stick-bead", 16.0, 0.05),
            ("stall-camera", 20.0, 0.015),
            ("second-bead", 24.0, 0.2),
            ("slow-solver", 28.0, 0.03),
            ("slow-solver", 32.0, 0.3),
        ] {
            event(kind, at_s + after_s, for_s);
        }
        at_s += 40.0;
    }
    std::fs::write(folder.join("night.toml"), rig).unwrap();
    let controller = "controller = \"mpc\"\ndelay_ms = 2.5\nsample_time_ms = 1.0\n[pi]\nkp_um_per_um = 0.46\nki_per_s = 19.5\n\
                      [mpc]\nsolver = \"active-set\"\n";
    std::fs::write(folder.join("mpc.toml"), controller).unwrap();
    let script = format!(
        "name = \"night\"\n[[step]]\ndo = \"sine\"\namplitude = \"2um\"\nfrequency = \"10Hz\"\ncycles = {cycles}\n"
    );
    std::fs::write(folder.join("cycles.toml"), script).unwrap();
}

fn night(cycles: u32) {
    let folder = tempfile::tempdir().unwrap();
    write_night(folder.path(), cycles);
    let began = std::time::Instant::now();
    let (code, out, err) = cellpos(
        folder.path(),
        &[
            "run",
            "cycles.toml",
            "--rig",
            "night.toml",
            "--controller",
            "mpc.toml",
            "--clock",
            "virtual",
            "--frames",
            "off",
            "--json",
        ],
    );
    let took_s = began.elapsed().as_secs_f64();
    // The script came to its end, but records were lost while the disk hung.
    assert_eq!(code, Some(1), "{out}\n{err}");
    let result: Value = serde_json::from_str(&out).unwrap();
    assert_eq!(
        (&result["outcome"], &result["cycles_done"]),
        (&"done".into(), &cycles.into())
    );
    let summary = &result["summary"];
    assert!(summary["records_lost"].as_u64().unwrap() > 500, "{summary}");
    assert!(summary["plans_reused"].as_u64().unwrap() >= 10, "{summary}");
    assert!(
        summary["solver_fallbacks"].as_u64().unwrap() > 100,
        "{summary}"
    );
    let run = only_run(folder.path());
    assert_eq!(
        numbers(&run, "cycle"),
        (0..u64::from(cycles)).collect::<Vec<u64>>()
    );
    let flags = column(&run, "flags");
    for flag in [
        "lost",
        "stale",
        "dropped",
        "coasted",
        "frozen",
        "records-lost",
        "solver-fallback",
    ] {
        let of = flags
            .iter()
            .filter(|all| all.split('+').any(|one| one == flag));
        assert!(of.count() > 0, "no cycle is flagged {flag}");
    }
    let (reached, commanded) = (column(&run, "reached_um"), column(&run, "commanded_um"));
    // Nothing that the optimiser could not give is lost to a replay.
    let replay = cellpos(folder.path(), &["replay", run.to_str().unwrap(), "--json"]);
    let replay: Value = serde_json::from_str(&replay.1).unwrap();
    assert!(replay["first_mismatch"].is_null(), "{replay}");
    let counts = ["lost", "coasted", "frozen", "solver_fallbacks"].map(|name| numbers(&run, name));
    let mut undisturbed = 0;
    for cycle in (0..cycles as usize).filter(|cycle| flags[*cycle].is_empty()) {
        undisturbed += 1;
        assert!(counts.iter().all(|count| count[cycle] == 0), "{cycle}");
        let number = |cell: &String| cell.parse::<f64>().unwrap();
        let ratio = number(&reached[cycle]) / number(&commanded[cycle]);
        assert!((ratio - 1.0).abs() < 0.35, "cycle {cycle}: {ratio}");
    }
    assert!(undisturbed > cycles / 3, "{undisturbed}");
    eprintln!(
        "{cycles} cycles in {took_s:.1} s, {undisturbed} undisturbed: {}",
        [
            "frames_lost",
            "stale",
            "fixes_lost",
            "coasted",
            "frozen",
            "plans_reused",
            "solver_fallbacks",
            "records_lost"
        ]
        .map(|name| format!("{name} {}", summary[name]))
        .join(", ")
    );
}

#[test]
fn a_night_with_faults_of_every_kind_has_every_cycle_once_and_flagged_where_disturbed() {
    night(400);
}

#[test]
#[ignore = "a thousand seconds of the loop; for the figures"]
fn ten_thousand_cycles_with_faults_of_every_kind_are_in_the_table_once() {
    night(10_000);
}

/// The events of a run so far.
fn events(folder: &Path) -> String {
    let run = std::fs::read_dir(folder.join("runs"))
        .ok()
        .and_then(|mut runs| runs.next()?.ok());
    run.and_then(|run| std::fs::read_to_string(run.path().join("events.jsonl")).ok())
        .unwrap_or_default()
}

#[test]
fn signals_pause_go_on_skip_and_end_a_run_that_has_no_keyboard() {
    let folder = tempfile::tempdir().unwrap();
    let text = "name = \"quick\"\n[[step]]\ndo = \"sine\"\namplitude = \"1um\"\nfrequency = \"20Hz\"\ncycles = 2000\n\
                [[step]]\ndo = \"hold\"\nduration = \"100s\"\n";
    std::fs::write(folder.path().join("quick.toml"), text).unwrap();
    std::fs::write(folder.path().join("rig.toml"), PATIENT).unwrap();
    let args = [
        "run",
        "quick.toml",
        "--rig",
        "rig.toml",
        "--frames",
        "off",
        "--best-effort",
        "--json",
    ];
    let child = command(folder.path(), &args)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let wait_for = |what: &str| {
        let began = std::time::Instant::now();
        while !events(folder.path()).contains(what) {
            assert!(began.elapsed() < Duration::from_secs(30), "no {what}");
            std::thread::sleep(Duration::from_millis(20));
        }
    };
    let send = |signal: &str| {
        let mut kill = Command::new("kill");
        let sent = kill.args(["-s", signal, &child.id().to_string()]).status();
        assert!(sent.unwrap().success());
    };
    wait_for("\"stage\":\"running\"");
    send("USR1");
    wait_for("freeze-started");
    send("USR1");
    wait_for("freeze-ended");
    send("USR2");
    wait_for("step-skipped");
    send("TERM");
    let out = child.wait_with_output().unwrap();
    let result: Value = serde_json::from_slice(&out.stdout).unwrap();
    assert_eq!(out.status.code(), Some(1), "{result}");
    assert_eq!(
        (&result["outcome"], &result["stage"]),
        (&"aborted".into(), &"by the operator".into())
    );
    let last = events(folder.path());
    assert!(last.contains("\"paused\""), "{last}");
}
