//! `cellpos check`, `run`, `report` and `bundle` as a user runs them.

use crate::script_runs::*;
use cellpos_plant::effects;
use serde_json::Value;
use std::path::{Path, PathBuf};

/// The check and a rehearsal of an example, from a separate folder: the run's folder. One that waits for a time to be over does
/// `stopped_after` cycles.
fn rehearsed(folder: &Path, script: &Path, stopped_after: Option<u64>) -> PathBuf {
    let name = script.file_stem().unwrap().to_str().unwrap();
    let path = script.to_str().unwrap();
    let report = format!("{name}.html");
    let check = json(
        folder,
        &[
            "check", path, "--model", "eq6", "--json", "--report", &report,
        ],
    );
    assert_eq!(check["ok"], true);
    assert!(folder.join(&report).exists());
    let mut args = vec!["run", path, "--dry", "--json"];
    if name == "fatigue" {
        args.extend(["--rig", "cell.toml"]);
    }
    let run = json(folder, &args);
    assert_eq!(run["outcome"], "done", "{name}");
    let done = run["cycles_done"].as_u64().unwrap();
    let expected = stopped_after.unwrap_or_else(|| check["cycles"].as_u64().unwrap());
    assert_eq!(done, expected, "{name}");
    // While a motion is learned, its first cycles stand out from the later ones.
    // In twelve minutes one cycle may be taken for stuck by chance.
    let standing_out = match name {
        "sine-sweep" => done / 10,
        "fatigue" => 1,
        _ => 0,
    };
    let disturbed = run["cycles_disturbed"].as_u64().unwrap();
    assert!(disturbed <= standing_out, "{name}: {disturbed}");
    assert_eq!(run["summary"]["range_limited"], 0, "{name}");
    let runs: Vec<_> = std::fs::read_dir(folder.join("runs"))
        .unwrap()
        .map(|run| run.unwrap().path())
        .filter(|run| run.to_str().unwrap().contains(&format!("{name}-dry")))
        .collect();
    let [run] = &runs[..] else {
        panic!("{name}: {runs:?}")
    };
    let cycles = numbers(run, "cycle");
    assert_eq!(cycles, (0..cycles.len() as u64).collect::<Vec<u64>>());
    assert_eq!(
        run.join("cycles.parquet").exists(),
        !cycles.is_empty(),
        "{name}"
    );
    run.clone()
}

fn example(name: &str) -> PathBuf {
    let found = examples().into_iter().find(|path| path.ends_with(name));
    found.unwrap_or_else(|| panic!("no example {name}"))
}

/// The long ones have separate tests.
const LONG: [&str; 2] = ["fatigue.toml", "heartbeat.toml"];

#[test]
fn every_short_example_passes_the_check_and_a_rehearsal_with_a_row_for_each_cycle() {
    let folder = tempfile::tempdir().unwrap();
    let short: Vec<PathBuf> = examples()
        .into_iter()
        .filter(|path| !LONG.iter().any(|long| path.ends_with(long)))
        .collect();
    assert_eq!(short.len() + LONG.len(), 5);
    for script in &short {
        let run = rehearsed(folder.path(), script, None);
        if script.ends_with("step.toml") {
            replays_and_simulates(folder.path(), run.to_str().unwrap());
        }
    }
}

/// The example with one of its numbers changed, in `folder`.
fn changed(folder: &Path, name: &str, from: &str, to: &str) -> PathBuf {
    let text = std::fs::read_to_string(example(name)).unwrap();
    assert!(text.contains(from));
    let path = folder.join(name);
    std::fs::write(&path, text.replace(from, to)).unwrap();
    path
}

/// The published fatigue test with so many cycles instead of 180, on a cell that tires within them: its report.
fn fatigue(cycles: u64) -> Value {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let script = changed(at, LONG[0], "times = 180", &format!("times = {cycles}"));
    let passages = format!("fatigue_passages = {cycles}");
    let rig = cell_rig().replace("fatigue_passages = 180", &passages);
    assert!(rig.contains(&passages));
    std::fs::write(at.join("cell.toml"), rig).unwrap();
    let run = rehearsed(at, &script, None);
    let report = json(at, &["report", run.to_str().unwrap(), "--json"]);
    trends_of_the_cell(&report, cycles);
    report
}

#[test]
fn a_fatigue_test_is_rehearsed_and_its_report_finds_what_is_hidden_in_the_cell() {
    fatigue(30);
}

#[test]
#[ignore = "twelve minutes of a rig; the fast one has 30 cycles"]
fn a_fatigue_test_of_twelve_minutes_is_rehearsed_and_its_report_finds_what_is_hidden_in_the_cell() {
    starts_of_the_cell(&fatigue(180));
}

/// Cycles of 0.8 s, for so many minutes.
fn heartbeat(minutes: u64) {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let waveform = example(LONG[1]).with_extension("csv");
    std::fs::copy(waveform, at.join("heartbeat.csv")).unwrap();
    let script = changed(at, LONG[1], "\"10min\"", &format!("\"{minutes}min\""));
    rehearsed(at, &script, Some(75 * minutes));
}

#[test]
fn a_heartbeat_is_rehearsed_and_stops_by_itself() {
    heartbeat(1);
}

#[test]
#[ignore = "ten minutes of a rig; the fast one has one"]
fn a_heartbeat_is_rehearsed_and_stops_by_itself_after_ten_minutes() {
    heartbeat(10);
}

fn replays_and_simulates(folder: &Path, run: &str) {
    let replay = json(folder, &["replay", run, "--json"]);
    assert_eq!(replay["ticks"], replay["identical"]);
    let (code, _, err) = cellpos(
        folder,
        &[
            "simulate", "--model", "eq6", "--input", run, "--out", "sim.csv",
        ],
    );
    assert_eq!(code, Some(0), "{err}");
    let rows = std::fs::read_to_string(folder.join("sim.csv")).unwrap();
    assert_eq!(
        rows.lines().count() as u64,
        1 + replay["ticks"].as_u64().unwrap()
    );
}

fn trend(report: &Value, quantity: &str, arm: &str) -> Option<Value> {
    let trends = report["trends"].as_array().unwrap();
    let found = trends
        .iter()
        .find(|trend| trend["quantity"] == quantity && trend["arm"] == arm);
    found.cloned()
}

/// The report finds the emulated cell's hidden trends within 5 %, and none in the static arm.
fn trends_of_the_cell(report: &Value, cycles: u64) {
    let of = |quantity: &str, arm: &str| trend(report, quantity, arm);
    // By the share of the passages that are behind it. The cell keeps its volume: its area varies with the root of its length.
    let stretch = |share: f64| 3.80 + (2.86 - 3.80) * share;
    let areal = |share: f64| stretch(share).sqrt();
    let recovery_s = |share: f64| 0.16 + (0.37 - 0.16) * share;
    let hidden: [(&str, &dyn Fn(f64) -> f64); 3] = [
        ("stretch", &stretch),
        ("recovery time", &recovery_s),
        ("areal stretch", &areal),
    ];
    for (quantity, hidden) in hidden {
        let found = of(quantity, "cyclic").unwrap();
        assert_eq!(
            (&found["cycles"], &found["significant"]),
            (&cycles.into(), &true.into())
        );
        // The means of the first and of the last cycles are the values in the middle of those.
        for (key, count) in [("first", "first_cycles"), ("last", "last_cycles")] {
            let inside = 0.5 * (found[count].as_f64().unwrap() - 1.0) / (cycles - 1) as f64;
            let share = if key == "first" { inside } else { 1.0 - inside };
            let value = found[key].as_f64().unwrap();
            assert!(
                (value / hidden(share) - 1.0).abs() < 0.05,
                "{quantity}: {found}"
            );
        }
        let still = of(quantity, "static");
        assert!(
            still.is_none_or(|trend| trend["significant"] == false),
            "{quantity}"
        );
    }
    for quantity in ["stretch", "areal stretch"] {
        // The way to the load and back is no cycle under load.
        assert_eq!(of(quantity, "static").unwrap()["cycles"], cycles - 2);
    }
}

/// The cyclic arm begins outside of the constriction, fresh; the static one is under load throughout.
fn starts_of_the_cell(report: &Value) {
    let disc_um2 = std::f64::consts::FRAC_PI_4 * 64.0;
    for (quantity, hidden) in [
        ("length at cycle start", 8.0),
        ("area at cycle start", disc_um2),
    ] {
        let value = trend(report, quantity, "cyclic").unwrap()["first"]
            .as_f64()
            .unwrap();
        assert!((value / hidden - 1.0).abs() < 0.05, "{quantity}: {value}");
        // The way to the load and back is no cycle under load.
        assert_eq!(trend(report, quantity, "static").unwrap()["cycles"], 178);
    }
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
    let error_percent = |seed: u64| {
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
                "--seed",
                &seed.to_string(),
                "--json",
            ],
        );
        assert_eq!(
            (&run["outcome"], &run["cycles_done"]),
            (&"done".into(), &60.into())
        );
        run["amplitude_error_percent"].as_f64().unwrap()
    };
    // Preview: the amplitude is there, whatever the frequency. Noise and the learning of the gain scatter it by 1 % in a run: four
    // together tell twice as much as one within 2 %.
    let errors = [1, 2, 3, 4].map(error_percent);
    let mean = errors.iter().sum::<f64>() / 4.0;
    assert!(mean.abs() < 1.0, "{errors:?}");
}

#[test]
fn a_report_shows_the_run_and_a_bundle_is_what_its_manifest_says() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    script(at, 100);
    std::fs::write(at.join("cell.toml"), cell_rig()).unwrap();
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
    for figure in ["traces", "excerpt", "error", "error-spectrum", "cycles"] {
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

#[test]
fn a_script_stops_when_the_amplitude_is_not_reached() {
    let folder = tempfile::tempdir().unwrap();
    // The amplifier has a lag of 80 Hz that the model does not know.
    let text = "name = \"far\"\n[stop]\namplitude_error_above = \"40%\"\n[[step]]\ndo = \"sine\"\namplitude = \"2um\"\n\
                frequency = \"120Hz\"\ncycles = 2000\n";
    std::fs::write(folder.path().join("far.toml"), text).unwrap();
    let (code, run, err) = run_beside(folder.path(), "far.toml", effects::driver_lag(80.0));
    assert_eq!(code, Some(1), "{err}");
    assert_eq!(
        (&run["outcome"], &run["stage"]),
        (
            &"stopped".into(),
            &"stopped: amplitude error too large".into()
        )
    );
    let done = run["cycles_done"].as_u64().unwrap();
    assert!((10..30).contains(&done), "{done}");
    let events = std::fs::read_to_string(only_run(folder.path()).join("events.jsonl")).unwrap();
    assert!(events.contains("amplitude-stop") && events.contains("freeze-started"));
}

#[test]
fn a_script_that_looks_at_a_length_is_refused_where_nobody_measures_one() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    std::fs::write(at.join("cell.toml"), cell_rig()).unwrap();
    let real = "[actuator]\nkind = \"serial\"\nport = \"pzt\"\n[camera]\nkind = \"socket\"\nsocket = \"camera.sock\"\n\
                [cell]\nbackground = \"empty.tif\"\n";
    std::fs::write(at.join("real.toml"), real).unwrap();
    let hold = "[[step]]\ndo = \"hold\"\nduration = \"200ms\"\n";
    let stop = format!("name = \"stop\"\n[stop]\nlength_change_above = \"50um\"\n{hold}");
    let wait = format!(
        "name = \"wait\"\n{hold}[[step]]\ndo = \"wait\"\nfor = \"cell-length\"\nabove = \"1um\"\ntimeout = \"2s\"\n"
    );
    for (name, text) in [("stop.toml", stop), ("wait.toml", wait)] {
        std::fs::write(at.join(name), text).unwrap();
        let (code, _, err) = cellpos(at, &["run", name, "--dry"]);
        assert_eq!(code, Some(2), "{err}");
        assert!(err.contains("[emulator.cell]"), "{err}");
        // A rig with a camera and a cell is rehearsed with an emulated one.
        for file in ["cell.toml", "real.toml"] {
            let run = json(at, &["run", name, "--dry", "--rig", file, "--json"]);
            assert_eq!(run["outcome"], "done", "{name}");
        }
    }
    assert_eq!(std::fs::read_dir(at.join("runs")).unwrap().count(), 4);
}

#[test]
fn a_script_that_wants_clips_says_where_there_are_no_pictures() {
    let folder = tempfile::tempdir().unwrap();
    let hold = "[[step]]\ndo = \"hold\"\nduration = \"200ms\"\n";
    for (name, clips, said) in [
        ("plain", "", false),
        ("film", "[clips]\nbefore = \"20ms\"\n", true),
    ] {
        let file = format!("{name}.toml");
        let text = format!("name = \"{name}\"\n{clips}{hold}");
        std::fs::write(folder.path().join(&file), text).unwrap();
        let (code, _, err) = cellpos(folder.path(), &["run", &file, "--clock", "virtual"]);
        assert_eq!(code, Some(0), "{err}");
        assert_eq!(err.contains("no clip is kept"), said, "{err}");
    }
}

#[test]
fn a_mark_and_a_cycle_behind_a_wait_begin_when_it_is_over() {
    let folder = tempfile::tempdir().unwrap();
    let mut script = "name = \"late\"\n".to_owned();
    for step in [
        "do = \"hold\"\nduration = \"1s\"",
        "do = \"mark\"\ntext = \"before\"",
        "do = \"wait\"\nfor = \"position\"\nabove = \"5um\"\ntimeout = \"2s\"\non_timeout = \"continue\"",
        "do = \"mark\"\ntext = \"after\"",
        "do = \"trapezoid\"\namplitude = \"3um\"\nfrequency = \"2Hz\"\ncycles = 2",
    ] {
        script += &format!("[[step]]\n{step}\n");
    }
    std::fs::write(folder.path().join("late.toml"), script).unwrap();
    let args = ["run", "late.toml", "--dry", "--frames", "off", "--json"];
    json(folder.path(), &args);
    let mut runs = std::fs::read_dir(folder.path().join("runs")).unwrap();
    let run = runs.next().unwrap().unwrap().path();
    let events = std::fs::read_to_string(run.join("events.jsonl")).unwrap();
    let at_s = |what: &str| {
        let line = events.lines().find(|line| line.contains(what)).unwrap();
        let event: Value = serde_json::from_str(line).unwrap();
        event["time_s"].as_f64().unwrap()
    };
    let waiting_s = at_s("\"stage\":\"waiting\"");
    assert!((at_s("\"text\":\"before\"") - waiting_s).abs() < 2e-3);
    assert!((at_s("\"text\":\"after\"") - waiting_s - 2.0).abs() < 5e-3);
    let table = std::fs::read_to_string(run.join("cycles.csv")).unwrap();
    let mut rows = table.lines().map(|row| row.split(',').collect::<Vec<_>>());
    let names = rows.next().unwrap();
    let column = |row: &[&str], name: &str| -> f64 {
        row[names.iter().position(|n| *n == name).unwrap()]
            .parse()
            .unwrap()
    };
    let first = rows.next().unwrap();
    assert!((column(&first, "ticks") - 500.0).abs() <= 2.0, "{first:?}");
    assert!(
        (column(&first, "start_s") - waiting_s - 2.0).abs() < 5e-3,
        "{first:?}"
    );
    assert!(!first.contains(&"waited"), "{first:?}");
}
