//! `cellpos run --resume` after cuts of all kinds.

use crate::script_runs::*;
use cellpos_plant::effects;
use serde_json::Value;
use std::path::Path;

#[test]
fn learning_takes_the_error_of_a_script_down_and_is_gone_on_from_after_a_cut() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    // Two motions that take turns, and one too short to be learned. The chip leaks, which the model does not know: the bead stays
    // behind both.
    let text = "name = \"turns\"\nlearn = true\n[stop]\nafter_cycles = 104\n[[step]]\ndo = \"repeat\"\ntimes = 4\n\
                [[step.step]]\ndo = \"sine\"\namplitude = \"2um\"\nfrequency = \"20Hz\"\ncycles = 30\nramp_in = 2\nramp_out = 2\n\
                [[step.step]]\ndo = \"triangle\"\namplitude = \"4um\"\nfrequency = \"10Hz\"\ncycles = 20\n\
                [[step]]\ndo = \"sine\"\namplitude = \"1um\"\nfrequency = \"5Hz\"\ncycles = 4\n";
    std::fs::write(at.join("turns.toml"), text).unwrap();
    let (code, run, err) = run_beside(at, "turns.toml", effects::leak(80.0));
    assert_eq!(code, Some(0), "{err}");
    let learned = run["learned"].as_array().unwrap();
    assert_eq!(learned.len(), 2, "{run}");
    for one in learned {
        let um = |name: &str| one["table"][name].as_f64().unwrap();
        let (before, after) = (um("error_before_um"), um("error_after_um"));
        assert!(after < 0.5 * before, "{one}");
        assert_eq!(one["table"]["retreats"], 0);
    }
    // Cycles of the first motion: its error in the first turn and in the last.
    let folder = only_run(at);
    let rms: Vec<f64> = column(&folder, "rms_um")
        .iter()
        .map(|cell| cell.parse().unwrap())
        .collect();
    assert_eq!(rms.len(), 104);
    let mean =
        |range: std::ops::Range<usize>| rms[range.clone()].iter().sum::<f64>() / range.len() as f64;
    // The ramps of a turn are not learned on: from its third cycle to its last but three.
    assert!(mean(57..75) < 0.5 * mean(2..4), "{rms:?}");
    let replay = json(at, &["replay", folder.to_str().unwrap(), "--json"]);
    assert_eq!(replay["ticks"], replay["identical"], "{replay}");
    let kept = std::fs::read_to_string(folder.join("learned.toml")).unwrap();
    assert!(kept.contains("sine of 2 um at 20 Hz") && kept.contains("triangle of 4 um at 10 Hz"));

    // The end of the run is cut off, as by a crash.
    let meta = std::fs::read_to_string(folder.join("run.toml")).unwrap();
    let end = meta.find("[end]").expect("an end");
    std::fs::write(folder.join("run.toml"), &meta[..end]).unwrap();
    let cycles = std::fs::read_to_string(folder.join("cycles.csv")).unwrap();
    let rows: Vec<&str> = cycles.lines().take(51).collect();
    std::fs::write(folder.join("cycles.csv"), rows.join("\n") + "\n").unwrap();
    let resumed = json(at, &["run", "--resume", folder.to_str().unwrap(), "--json"]);
    assert_eq!(resumed["cycles_done"], 104, "{resumed}");
    let rms: Vec<f64> = column(&folder, "rms_um")
        .iter()
        .map(|cell| cell.parse().unwrap())
        .collect();
    // Known from the first cycles on: the addition of the session before is in force.
    assert!(
        rms[53..56].iter().sum::<f64>() / 3.0 < 0.5 * rms[2..4].iter().sum::<f64>() / 2.0,
        "{rms:?}"
    );
    let before = &learned[0]["table"]["cycles"].as_f64().unwrap();
    let after = resumed["learned"][0]["table"]["cycles"].as_f64().unwrap();
    assert!(after > *before, "{before} {after}");
}

#[test]
fn a_run_whose_table_is_damaged_is_not_gone_on_with_and_a_torn_last_line_is_no_damage() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    script(at, 40);
    json(at, &["run", "quick.toml", "--dry", "--json"]);
    let run = only_run(at);
    let meta = std::fs::read_to_string(run.join("run.toml")).unwrap();
    std::fs::write(run.join("run.toml"), &meta[..meta.find("[end]").unwrap()]).unwrap();
    let table = std::fs::read_to_string(run.join("cycles.csv")).unwrap();
    let name = run.to_str().unwrap();
    std::fs::write(run.join("cycles.csv"), format!("{table}what is this\n")).unwrap();
    let (code, _, err) = cellpos(at, &["run", "--resume", name]);
    assert_eq!(code, Some(2), "{err}");
    assert!(err.contains("was it changed"), "{err}");
    // Cut off in the middle of its twentieth row.
    let end = table.match_indices('\n').nth(19).unwrap().0 + 30;
    std::fs::write(run.join("cycles.csv"), &table[..end]).unwrap();
    json(at, &["run", "--resume", name, "--json"]);
    assert_eq!(numbers(&run, "cycle"), (0..40).collect::<Vec<u64>>());
    let sessions = numbers(&run, "session");
    assert_eq!((sessions[18], sessions[19]), (1, 2));
    let report = json(at, &["report", name, "--json"]);
    assert_eq!(
        (&report["sessions"], &report["cycles"]),
        (&2.into(), &40.into())
    );
    let page = std::fs::read_to_string(run.join("report.html")).unwrap();
    assert!(page.contains("The last of 2 sessions came to its end"));
}

#[test]
fn a_run_that_an_older_version_began_is_gone_on_with_and_its_table_takes_on_the_new_columns() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    std::fs::write(at.join("cell.toml"), cell_rig()).unwrap();
    script(at, 40);
    json(
        at,
        &["run", "quick.toml", "--dry", "--rig", "cell.toml", "--json"],
    );
    let run = only_run(at);
    let name = run.to_str().unwrap();
    let meta = std::fs::read_to_string(run.join("run.toml")).unwrap();
    std::fs::write(run.join("run.toml"), &meta[..meta.find("[end]").unwrap()]).unwrap();
    // Half of the table, as it was before areas were measured.
    let table = std::fs::read_to_string(run.join("cycles.csv")).unwrap();
    let head = table.lines().next().unwrap();
    let known: Vec<bool> = head
        .split(',')
        .map(|name| !name.starts_with("area_"))
        .collect();
    let old = |line: &str| {
        let cells = line.split(',').zip(&known).filter(|(_, known)| **known);
        cells.map(|(cell, _)| cell).collect::<Vec<_>>().join(",") + "\n"
    };
    let older: String = table.lines().take(21).map(old).collect();
    std::fs::write(run.join("cycles.csv"), &older).unwrap();
    assert_eq!(json(at, &["report", name, "--json"])["cycles"], 20);

    json(at, &["run", "--resume", name, "--json"]);
    let renewed = std::fs::read_to_string(run.join("cycles.csv")).unwrap();
    assert_eq!(renewed.lines().next(), Some(head));
    let kept: String = renewed.lines().take(21).map(old).collect();
    assert_eq!(kept, older, "what was there stays as it was");
    assert_eq!(numbers(&run, "cycle"), (0..40).collect::<Vec<u64>>());
    let areas = column(&run, "area_half_um2");
    assert!(areas[..20].iter().all(String::is_empty), "{areas:?}");
    // A sphere of 8 um that is never pressed into the constriction.
    let disc_um2 = std::f64::consts::FRAC_PI_4 * 64.0;
    for area in &areas[20..] {
        let um2: f64 = area.parse().unwrap();
        assert!((um2 / disc_um2 - 1.0).abs() < 0.02, "{um2}");
    }

    // A newer one's column is not dropped: the run is not gone on with.
    std::fs::write(run.join("run.toml"), &meta[..meta.find("[end]").unwrap()]).unwrap();
    let newer = renewed.replacen("flags", "odour,flags", 1);
    std::fs::write(run.join("cycles.csv"), &newer).unwrap();
    let (code, _, err) = cellpos(at, &["run", "--resume", name]);
    assert_eq!(code, Some(2), "{err}");
    assert!(
        err.contains("cycles.csv: column `odour`") && err.contains("newer version"),
        "{err}"
    );
    assert_eq!(
        std::fs::read_to_string(run.join("cycles.csv")).unwrap(),
        newer
    );
    json(at, &["report", name, "--json"]);
    let page = std::fs::read_to_string(run.join("report.html")).unwrap();
    assert!(page.contains("column `odour` is not known"));
}

/// Turns a run into the remains of a crash: no end, the first cycles of its table, and the beginning of its records.
fn crash(run: &Path, cycles: usize, share: f64) {
    let meta = std::fs::read_to_string(run.join("run.toml")).unwrap();
    std::fs::write(run.join("run.toml"), &meta[..meta.find("[end]").unwrap()]).unwrap();
    let table = std::fs::read_to_string(run.join("cycles.csv")).unwrap();
    let rows: Vec<&str> = table.lines().take(1 + cycles).collect();
    std::fs::write(run.join("cycles.csv"), rows.join("\n") + "\n").unwrap();
    let ticks = std::fs::OpenOptions::new()
        .write(true)
        .open(run.join("ticks.arrow"))
        .unwrap();
    let length = ticks.metadata().unwrap().len();
    ticks.set_len((length as f64 * share) as u64).unwrap();
}

#[test]
fn the_time_of_a_resumed_script_is_that_of_all_its_sessions() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let text = "name = \"timed\"\n[stop]\nafter = \"5s\"\n[[step]]\ndo = \"wait\"\nfor = \"position\"\nabove = \"9um\"\n\
                timeout = \"3s\"\non_timeout = \"continue\"\n[[step]]\ndo = \"sine\"\namplitude = \"1um\"\n\
                frequency = \"10Hz\"\ncycles = 100\n";
    std::fs::write(at.join("timed.toml"), text).unwrap();
    // Ticks in which the time of the script ran: running, waiting, paused.
    let ran = |run: &Path| {
        let mut args = vec![
            "export",
            run.to_str().unwrap(),
            "--out",
            "ticks.csv",
            "--force",
        ];
        if run.join("sessions").exists() {
            args.extend(["--session", "1"]);
        }
        let (code, _, err) = cellpos(at, &args);
        assert_eq!(code, Some(0), "{err}");
        let ticks = std::fs::read_to_string(at.join("ticks.csv")).unwrap();
        let mut lines = ticks.lines();
        let head = lines.next().unwrap();
        let stage = head.split(',').position(|name| name == "stage").unwrap();
        lines
            .filter(|line| {
                ["running", "waiting", "paused"].contains(&line.split(',').nth(stage).unwrap())
            })
            .count()
    };
    json(at, &["run", "timed.toml", "--dry", "--json"]);
    let run = only_run(at);
    assert!(ran(&run).abs_diff(5000) <= 1, "{}", ran(&run));
    // Three seconds of waiting, one of ten cycles, and the part of the next ones that was on the disk.
    crash(&run, 10, 0.85);
    let before = ran(&run);
    assert!((3500..4900).contains(&before), "{before}");
    let resumed = json(at, &["run", "--resume", run.to_str().unwrap(), "--json"]);
    assert_eq!(resumed["stage"], "stopped: time is up", "{resumed}");
    let session = std::fs::read_dir(run.join("sessions"))
        .unwrap()
        .next()
        .unwrap()
        .unwrap()
        .path();
    let all = before + ran(&session);
    assert!(all.abs_diff(5000) <= 2, "{before} of {all} before");
    let replay = json(at, &["replay", session.to_str().unwrap(), "--json"]);
    assert_eq!(replay["ticks"], replay["identical"], "{replay}");
}

#[test]
fn a_run_is_gone_on_with_from_any_folder() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let (lab, elsewhere) = (at.join("lab"), at.join("elsewhere"));
    std::fs::create_dir(&lab).unwrap();
    std::fs::create_dir(&elsewhere).unwrap();
    std::fs::write(
        lab.join("world.toml"),
        cellpos_plant::Model::eq6().to_toml_string(),
    )
    .unwrap();
    std::fs::write(lab.join("rig.toml"), "[emulator]\nmodel = \"world.toml\"\n").unwrap();
    script(at, 40);
    let rig = "lab/rig.toml";
    let args = ["run", "quick.toml", "--rig", rig, "--clock", "virtual"];
    json(at, &[&args[..], &["--frames", "off", "--json"]].concat());
    let run = only_run(at);
    crash(&run, 20, 0.6);
    json(
        &elsewhere,
        &["run", "--resume", run.to_str().unwrap(), "--json"],
    );
    assert_eq!(numbers(&run, "cycle"), (0..40).collect::<Vec<u64>>());
    // The inputs are packed from any folder, too.
    let bundle = json(
        &elsewhere,
        &["bundle", run.to_str().unwrap(), "--out", "packed", "--json"],
    );
    assert_eq!(
        bundle["inputs_missing"],
        Value::Array(Vec::new()),
        "{bundle}"
    );
}
