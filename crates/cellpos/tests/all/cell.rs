//! A cell followed through rendered frames: its length and area decide, are recorded, and show how it tires.

use crate::script_runs::*;
use std::path::Path;

/// The example rig, with `more` keys of the cell.
fn rig(folder: &Path, name: &str, more: &str) {
    let text = format!("{}{more}\n", cell_rig());
    std::fs::write(folder.join(name), text).unwrap();
}

/// Numbers of a column of the per-cycle table.
fn values(run: &Path, name: &str) -> Vec<f64> {
    column(run, name)
        .iter()
        .map(|cell| cell.parse().unwrap_or(f64::NAN))
        .collect()
}

#[test]
fn the_trends_of_stretch_recovery_and_area_are_found_through_frames_and_the_static_arm_has_none() {
    const PASSAGES: usize = 3;
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let text = cell_rig().replace(
        "fatigue_passages = 180",
        &format!("fatigue_passages = {PASSAGES}"),
    );
    assert!(text.contains(&format!("= {PASSAGES}")));
    std::fs::write(at.join("cell.toml"), text).unwrap();
    let step = |what: &str, duration: &str| {
        format!("[[step.step]]\ndo = {what}\nduration = \"{duration}\"\n")
    };
    let script = format!(
        "name = \"tire\"\n[[step]]\ndo = \"repeat\"\nlabel = \"cyclic\"\ntimes = {PASSAGES}\n{}{}{}{}\
         [[step]]\ndo = \"static\"\nlike = \"cyclic\"\nload = \"mean\"\n",
        step("\"move\"\nto = \"8um\"", "200ms"),
        step("\"hold\"", "500ms"),
        step("\"move\"\nto = \"0um\"", "200ms"),
        step("\"hold\"", "900ms"),
    );
    std::fs::write(at.join("tire.toml"), script).unwrap();
    let args = [
        "run",
        "tire.toml",
        "--rig",
        "cell.toml",
        "--clock",
        "virtual",
        "--json",
    ];
    let run = json(at, &args);
    assert_eq!(run["outcome"], "done", "{run}");
    assert_eq!(run["cycles_disturbed"], 0, "{run}");
    let run = only_run(at);

    let peak_um = values(&run, "length_peak_um");
    let start_um = values(&run, "length_start_um");
    let recovery_s = values(&run, "recovery_s");
    assert!((start_um[0] / 8.0 - 1.0).abs() < 0.01, "{}", start_um[0]);
    for cycle in 0..PASSAGES {
        let share = cycle as f64 / (PASSAGES - 1) as f64;
        let stretch = 3.80 + (2.86 - 3.80) * share;
        let found = peak_um[cycle] / start_um[0];
        assert!((found / stretch - 1.0).abs() < 0.02, "{cycle}: {found}");
        let expected_s = 0.16 + (0.37 - 0.16) * share;
        let found_s = recovery_s[cycle];
        assert!(
            (found_s / expected_s - 1.0).abs() < 0.05,
            "{cycle}: {found_s}"
        );
    }
    // The first static cycle still sees the last of the recovery.
    let still = &peak_um[PASSAGES + 1..];
    let spread = still
        .iter()
        .fold(0.0_f64, |m, um| m.max((um / still[0] - 1.0).abs()));
    assert!(spread < 0.01, "static arm: {still:?}");
    assert!(recovery_s[PASSAGES + 1..].iter().all(|s| s.is_nan()));

    let report = json(at, &["report", run.to_str().unwrap(), "--json"]);
    let page = std::fs::read_to_string(run.join("report.html")).unwrap();
    assert!(
        page.contains("stretch") && report["cycles"] == 2 * PASSAGES,
        "{report}"
    );
}

#[test]
fn waits_and_stops_look_at_the_length_that_the_frames_show() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    rig(at, "cell.toml", "");
    let into = "[[step]]\ndo = \"move\"\nto = \"8um\"\nduration = \"200ms\"\n";
    let wait =
        "[[step]]\ndo = \"wait\"\nfor = \"cell-length\"\nabove = \"20um\"\ntimeout = \"2s\"\n";
    let hold = "[[step]]\ndo = \"hold\"\nduration = \"1s\"\n";
    std::fs::write(
        at.join("wait.toml"),
        format!("name = \"wait\"\n{into}{wait}"),
    )
    .unwrap();
    let stop = format!("name = \"stop\"\n[stop]\nlength_change_above = \"15um\"\n{into}{hold}");
    std::fs::write(at.join("stop.toml"), stop).unwrap();
    let run = |script: &str, frames: &str| {
        let args = [
            "run",
            script,
            "--rig",
            "cell.toml",
            "--clock",
            "virtual",
            "--frames",
            frames,
            "--json",
        ];
        let (code, out, err) = cellpos(at, &args);
        (
            code,
            serde_json::from_str::<serde_json::Value>(&out).expect(&err),
        )
    };
    let mut ended = Vec::new();
    for frames in ["on", "off"] {
        let (code, waited) = run("wait.toml", frames);
        assert_eq!(code, Some(0), "{waited}");
        let (code, stopped) = run("stop.toml", frames);
        assert_eq!(code, Some(1), "{stopped}");
        assert!(stopped.to_string().contains("length"), "{stopped}");
        ended.push([&waited, &stopped].map(|run| run["summary"]["duration_s"].as_f64().unwrap()));
    }
    // Pictures and positions are two ways to the same length: 20 um is passed within a frame or two.
    for (with, without) in ended[0].iter().zip(&ended[1]) {
        assert!((with - without).abs() < 0.02, "{ended:?}");
    }
}

#[test]
fn a_cell_is_held_through_frames_as_well_as_a_bead_and_its_size_is_in_every_tick() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    rig(at, "cell.toml", "");
    let args = [
        "track",
        "--target",
        "0um",
        "--rig",
        "cell.toml",
        "--duration",
        "3s",
        "--clock",
        "virtual",
        "--frames",
        "on",
        "--json",
    ];
    let run = json(at, &args);
    let (rms, bound) = (&run["rms_true_nm"], &run["bound_rms_nm"]);
    assert!(
        rms.as_f64().unwrap() < 1.45 * bound.as_f64().unwrap(),
        "{run}"
    );
    assert!(run["fixes_lost"].as_u64().unwrap() <= 3, "{run}");
    // The cell's outline tells its place better than a micrometre bead's picture: 2 nm at most.
    assert!(run["fix_noise_nm"].as_f64().unwrap() < 2.0, "{run}");
    let folder_of_run = run["run"].as_str().unwrap();
    json(at, &["replay", folder_of_run, "--json"]);
    let (code, out, err) = cellpos(at, &["export", folder_of_run, "--out", "ticks.csv"]);
    assert_eq!(code, Some(0), "{out}{err}");
    let text = std::fs::read_to_string(at.join("ticks.csv")).unwrap();
    let mut lines = text.lines().filter(|line| !line.starts_with('#'));
    let header: Vec<&str> = lines.next().unwrap().split(',').collect();
    let of = |name: &str| header.iter().position(|h| *h == name).expect(name);
    let (length, area) = (of("length_um"), of("area_um2"));
    let mut seen = 0;
    for line in lines {
        let cells: Vec<&str> = line.split(',').collect();
        if let (Ok(um), Ok(um2)) = (cells[length].parse::<f64>(), cells[area].parse::<f64>()) {
            seen += 1;
            assert!((um / 8.0 - 1.0).abs() < 0.03, "{line}");
            assert!((um2 / 50.27 - 1.0).abs() < 0.03, "{line}");
        }
    }
    assert!(seen > 2900, "{seen}");
}

#[test]
fn a_cell_that_does_not_fit_and_a_table_without_a_cell_are_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    std::fs::write(at.join("small.toml"), "[emulator.cell]\n").unwrap();
    std::fs::write(
        at.join("bead.toml"),
        "[cell.finder]\nthreshold_sigma = 6.0\n",
    )
    .unwrap();
    rig(at, "finder.toml", "[cell.finder]\nthreshold_sigma = 0.1");
    for (file, words) in [
        ("small.toml", ["cell.rest_um", "height_px"]),
        ("bead.toml", ["[cell]", "[emulator.cell]"]),
        ("finder.toml", ["threshold_sigma", "0.1"]),
    ] {
        let args = [
            "track",
            "--target",
            "0um",
            "--rig",
            file,
            "--duration",
            "1s",
        ];
        let (code, _, err) = cellpos(at, &args);
        assert_eq!(code, Some(2), "{file}: {err}");
        assert!(words.iter().all(|word| err.contains(word)), "{file}: {err}");
    }
}

/// A limit of the script ends a run: the run says which one, no person is blamed, and when it is resumed the cell is as tired as it was.
#[test]
fn a_tired_cell_stops_its_script_and_is_as_tired_when_it_is_resumed() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let rig = cell_rig().replace("fatigue_passages = 180", "fatigue_passages = 60");
    std::fs::write(at.join("cell.toml"), rig).unwrap();
    let script = "name = \"tired\"\n[stop]\nstretch_down = \"8%\"\n[[step]]\ndo = \"repeat\"\ntimes = 40\n\
                  [[step.step]]\ndo = \"move\"\nto = \"8um\"\nduration = \"200ms\"\n[[step.step]]\ndo = \"hold\"\nduration = \"300ms\"\n\
                  [[step.step]]\ndo = \"move\"\nto = \"0um\"\nduration = \"200ms\"\n[[step.step]]\ndo = \"hold\"\nduration = \"900ms\"\n";
    std::fs::write(at.join("tired.toml"), script).unwrap();
    let simulated = ["--clock", "virtual", "--frames", "off", "--json"];
    let args = [&["run", "tired.toml", "--rig", "cell.toml"], &simulated[..]].concat();
    let stopped = |args: &[&str]| {
        let (code, out, err) = cellpos(at, args);
        assert_eq!(code, Some(1), "{err}");
        serde_json::from_str::<serde_json::Value>(&out).expect(&err)
    };
    let first = stopped(&args);
    assert_eq!(first["outcome"], "stopped", "{first}");
    assert_eq!(first["ended"]["kind"], "stopped", "{first}");
    let seen = first["ended"]["seen"].as_str().unwrap();
    assert!(seen.contains("stretch_down"), "{seen}");
    let run = only_run(at);
    let report = json(at, &["report", run.to_str().unwrap(), "--json"]);
    let result = report["result"].as_str().unwrap();
    assert!(
        result.contains("stretch_down") && !result.contains("operator"),
        "{result}"
    );
    let before = values(&run, "length_peak_um");
    let _ = stopped(&["run", "--resume", run.to_str().unwrap(), "--json"]);
    let after = values(&run, "length_peak_um");
    let next = after[before.len()];
    let last = before[before.len() - 1];
    // A fresh cell would be a fifth longer.
    assert!(
        (next / last - 1.0).abs() < 0.03,
        "{next} um after {last} um"
    );
}
