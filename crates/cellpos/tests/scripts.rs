//! `cellpos check`, `simulate`, `run` as a user runs them: on the examples, cut off, with a full disk.

use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

fn command(folder: &Path, args: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cellpos"));
    command.args(args).current_dir(folder);
    command
}

fn cellpos(folder: &Path, args: &[&str]) -> (Option<i32>, String, String) {
    let out = command(folder, args).output().unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    (out.status.code(), text(out.stdout), text(out.stderr))
}

fn json(folder: &Path, args: &[&str]) -> Value {
    let (code, out, err) = cellpos(folder, args);
    assert_eq!(code, Some(0), "{args:?}: {out}\n{err}");
    serde_json::from_str(&out).unwrap()
}

fn examples() -> Vec<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/scripts");
    let mut files: Vec<PathBuf> = std::fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|e| e == "toml"))
        .collect();
    files.sort();
    assert_eq!(files.len(), 5);
    files
}

/// Cell `column` of every row of a run's per-cycle table.
fn column(run: &Path, column: &str) -> Vec<String> {
    let text = std::fs::read_to_string(run.join("cycles.csv")).unwrap();
    let mut lines = text.lines();
    let at = lines
        .next()
        .unwrap()
        .split(',')
        .position(|name| name == column)
        .unwrap();
    lines
        .map(|line| line.split(',').nth(at).unwrap().to_string())
        .collect()
}

fn numbers(run: &Path, name: &str) -> Vec<u64> {
    column(run, name)
        .iter()
        .map(|cell| cell.parse().unwrap())
        .collect()
}

fn only_run(folder: &Path) -> PathBuf {
    let mut runs = std::fs::read_dir(folder.join("runs")).unwrap();
    let run = runs.next().unwrap().unwrap().path();
    assert!(runs.next().is_none(), "one run");
    run
}

/// A script of 20 Hz cycles about the middle.
fn script(folder: &Path, cycles: u32) {
    let text = format!(
        "name = \"quick\"\n[[step]]\ndo = \"sine\"\namplitude = \"1um\"\nfrequency = \"20Hz\"\ncycles = {cycles}\n\
         [[step]]\ndo = \"hold\"\nduration = \"100ms\"\n"
    );
    std::fs::write(folder.join("quick.toml"), text).unwrap();
}

#[test]
fn every_example_passes_the_check_and_a_rehearsal_with_a_row_for_each_cycle() {
    let folder = tempfile::tempdir().unwrap();
    for path in examples() {
        let name = path.file_stem().unwrap().to_str().unwrap().to_string();
        let path = path.to_str().unwrap();
        let report = format!("{name}.html");
        let check = json(
            folder.path(),
            &[
                "check", path, "--model", "eq6", "--json", "--report", &report,
            ],
        );
        assert_eq!(check["ok"], true);
        assert!(folder.path().join(&report).exists());
        // The fatigue example lasts twelve minutes and the heartbeat ten: seconds here, and the same code as the others.
        let run = json(folder.path(), &["run", path, "--dry", "--json"]);
        assert_eq!(run["outcome"], "done", "{name}");
        let done = run["cycles_done"].as_u64().unwrap();
        let expected = match name.as_str() {
            // It stops by itself after ten minutes of 0.8 s cycles.
            "heartbeat" => 750,
            _ => check["cycles"].as_u64().unwrap(),
        };
        assert_eq!(done, expected, "{name}");
        assert_eq!(run["cycles_disturbed"], 0, "{name}");
        assert_eq!(run["summary"]["range_limited"], 0, "{name}");
    }
    let runs: Vec<_> = std::fs::read_dir(folder.path().join("runs"))
        .unwrap()
        .map(|run| run.unwrap().path())
        .collect();
    assert_eq!(runs.len(), 5);
    for run in &runs {
        let cycles = numbers(run, "cycle");
        assert_eq!(cycles, (0..cycles.len() as u64).collect::<Vec<u64>>());
        assert_eq!(
            run.join("cycles.parquet").exists(),
            !cycles.is_empty(),
            "{run:?}"
        );
    }
    let step = runs
        .iter()
        .find(|run| run.to_str().unwrap().contains("step-dry"))
        .unwrap();
    let replay = json(folder.path(), &["replay", step.to_str().unwrap(), "--json"]);
    assert_eq!(replay["ticks"], replay["identical"]);
    let (code, _, err) = cellpos(
        folder.path(),
        &[
            "simulate",
            "--model",
            "eq6",
            "--input",
            step.to_str().unwrap(),
            "--out",
            "sim.csv",
        ],
    );
    assert_eq!(code, Some(0), "{err}");
    let rows = std::fs::read_to_string(folder.path().join("sim.csv")).unwrap();
    assert_eq!(
        rows.lines().count() as u64,
        1 + replay["ticks"].as_u64().unwrap()
    );
}

#[test]
fn what_the_rig_cannot_do_is_refused_before_anything_moves() {
    let folder = tempfile::tempdir().unwrap();
    let text = "[[step]]\ndo = \"sine\"\namplitude = \"9um\"\nfrequency = \"200Hz\"\ncycles = 20\nramp_in = 4\nramp_out = 4\n";
    std::fs::write(folder.path().join("wild.toml"), text).unwrap();
    std::fs::write(folder.path().join("torn.toml"), "[[step]]\ndo = \"hodl\"\n").unwrap();
    let (code, out, _) = cellpos(folder.path(), &["check", "wild.toml"]);
    assert_eq!(code, Some(1));
    assert!(
        out.contains("wild.toml:1: PZT range") && out.contains("scale all positions by 0."),
        "{out}"
    );
    let (code, _, err) = cellpos(folder.path(), &["run", "wild.toml", "--dry"]);
    assert_eq!(code, Some(2));
    assert!(err.contains("the rig cannot do it"), "{err}");
    for args in [
        ["check", "torn.toml"].as_slice(),
        &["run", "torn.toml", "--dry"],
    ] {
        let (code, _, err) = cellpos(folder.path(), args);
        assert_eq!(code, Some(2));
        assert!(
            err.contains("torn.toml:2:6") && err.contains("hold"),
            "{err}"
        );
    }
    let (code, _, err) = cellpos(folder.path(), &["run", "absent.toml"]);
    assert_eq!(code, Some(2), "{err}");
    assert!(!folder.path().join("runs").exists(), "nothing was started");
}

#[test]
fn a_rehearsal_behaves_as_the_model_it_is_given() {
    let folder = tempfile::tempdir().unwrap();
    script(folder.path(), 60);
    // The controller is made for the model too, so a rig of half the gain is a rehearsal like any other.
    let eq6 = std::fs::read_to_string(
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/model.toml"),
    )
    .unwrap();
    std::fs::write(folder.path().join("model.toml"), eq6).unwrap();
    let run = json(
        folder.path(),
        &[
            "run",
            "quick.toml",
            "--dry",
            "--model",
            "model.toml",
            "--controller",
            "mpc",
            "--json",
        ],
    );
    assert_eq!(
        (&run["outcome"], &run["cycles_done"]),
        (&"done".into(), &60.into())
    );
    // Preview: the amplitude is there, whatever the frequency.
    let error = run["amplitude_error_percent"].as_f64().unwrap();
    assert!(error.abs() < 2.0, "{error}");
}

/// Runs a script in real time, killed at moments that a seed fixes, and resumed until it is done; gives the folder of the run
/// and how often it was killed.
fn killed_and_resumed(folder: &Path, cycles: u32, most: u32, extra: &[&str]) -> (PathBuf, u32) {
    script(folder, cycles);
    // A machine that stalls must not end a run: that is another test's subject.
    let patient = "[timing]\noldest_ms = 1000.0\nfaults_in_a_row = 100000\nbudget_us = 1000.0\n\
                   lost_ticks = 100000\nboard_silence_ms = 10000.0\n[board]\nwatchdog_ms = 1000\n";
    std::fs::write(folder.join("rig.toml"), patient).unwrap();
    let mut seed = 0x2545_f491_4f6c_dd1d_u64;
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
        seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
        if kills < most {
            std::thread::sleep(Duration::from_millis(300 + (seed >> 33) % 2500));
        }
        let ended = kills >= most || child.try_wait().unwrap().is_some();
        if !ended {
            child.kill().unwrap();
            kills += 1;
        }
        let out = child.wait_with_output().unwrap();
        if run.is_none() && folder.join("runs").exists() {
            // A first session that was killed before it had a table is begun anew.
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
            let err = String::from_utf8_lossy(&out.stderr).into_owned();
            assert_eq!(out.status.code(), Some(0), "{err}");
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
        let (code, out, err) = cellpos(folder, &["export", path, "--out", "ticks.csv", "--json"]);
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
fn a_full_disk_does_not_stop_the_run_and_what_is_lost_is_said() {
    let folder = tempfile::tempdir().unwrap();
    script(folder.path(), 400);
    // A file may have 3 MB (in blocks of 512 bytes): the ticks of 20 s have 7 MB. The refusal is as that of a full disk,
    // once the signal that comes with it is ignored.
    let program = env!("CARGO_BIN_EXE_cellpos");
    let out = Command::new("bash")
        .arg("-c")
        .arg(format!(
            "trap '' XFSZ; ulimit -f 3000; exec {program} run quick.toml --dry --json"
        ))
        .current_dir(folder.path())
        .output()
        .unwrap();
    let err = String::from_utf8_lossy(&out.stderr).into_owned();
    assert_eq!(out.status.code(), Some(0), "{err}");
    let result: Value = serde_json::from_slice(&out.stdout).unwrap();
    assert_eq!(result["cycles_done"], 400, "control went on");
    let warnings = result["warnings"].to_string();
    assert!(
        warnings.contains("rows") && warnings.contains("could not be written"),
        "{warnings}"
    );
    assert!(err.contains("control goes on"), "{err}");
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
    assert!(rows > 1000 && rows < 20_000, "{export}");
    assert_eq!(export["damaged_bytes"], 0);
    let meta = std::fs::read_to_string(run.join("run.toml")).unwrap();
    let lost: u64 = meta
        .lines()
        .find_map(|line| line.strip_prefix("rows_lost = "))
        .and_then(|cell| cell.parse().ok())
        .unwrap();
    let ticks = result["summary"]["ticks"].as_u64().unwrap();
    assert_eq!(rows + lost, ticks, "every tick is there or counted");
}

#[test]
fn a_report_shows_the_run_and_a_bundle_is_what_its_manifest_says() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    script(at, 100);
    std::fs::write(at.join("cell.toml"), "[emulator.cell]\n").unwrap();
    json(
        at,
        &["run", "quick.toml", "--dry", "--rig", "cell.toml", "--json"],
    );
    let run = only_run(at);
    let name = run.strip_prefix(at).unwrap().to_str().unwrap();
    let report = json(at, &["report", name, "--json"]);
    assert_eq!(
        (&report["cycles"], &report["sessions"]),
        (&100.into(), &1.into())
    );
    // PI on a moving reference is far from what the best controller could do while holding.
    let (rms, bound) = (&report["rms_nm"], report["bound_rms_nm"].as_f64().unwrap());
    assert!(
        (bound - 44.5).abs() < 1.0 && rms.as_f64().unwrap() > bound,
        "{report}"
    );
    let trends = report["trends"].as_array().unwrap();
    let reached = trends
        .iter()
        .find(|trend| trend["quantity"] == "reached over commanded amplitude")
        .unwrap();
    assert_eq!(
        (&reached["arm"], &reached["cycles"]),
        (&"cyclic".into(), &100.into())
    );
    let page = std::fs::read_to_string(run.join("report.html")).unwrap();
    for part in [
        "Traces",
        "Error",
        "Cycles",
        "Loop timing",
        "Events",
        "provenance",
        "SHA-256",
    ] {
        assert!(page.contains(part), "{part}");
    }
    assert!(!page.contains("http-equiv") && !page.contains("src=\"http"));
    for figure in [
        "traces",
        "excerpt",
        "error-histogram",
        "error-spectrum",
        "cycles",
    ] {
        assert!(
            run.join(format!("report-figures/{figure}.csv")).exists(),
            "{figure}"
        );
    }

    let packed = json(at, &["bundle", name, "--json"]);
    assert_eq!(packed["inputs_missing"], serde_json::json!([]));
    let bundle = PathBuf::from(format!("{}-bundle", run.display()));
    assert!(bundle.join("inputs/00-quick.toml").exists());
    let path = bundle.to_str().unwrap();
    assert_eq!(
        json(at, &["bundle", "--verify", path, "--json"])["wrong"],
        serde_json::json!([])
    );
    let (code, _, err) = cellpos(at, &["bundle", name]);
    assert_eq!(code, Some(2), "never overwritten: {err}");
    let table = bundle.join("cycles.csv");
    let text = std::fs::read_to_string(&table).unwrap();
    std::fs::write(&table, text.replacen("cyclic", "static", 1)).unwrap();
    std::fs::write(bundle.join("more.txt"), "").unwrap();
    std::fs::remove_file(bundle.join("run.toml")).unwrap();
    let (code, out, _) = cellpos(at, &["bundle", "--verify", path]);
    assert_eq!(code, Some(1));
    for wrong in [
        "cycles.csv: changed",
        "run.toml: missing",
        "more.txt: not in the manifest",
    ] {
        assert!(out.contains(wrong), "{out}");
    }
}
