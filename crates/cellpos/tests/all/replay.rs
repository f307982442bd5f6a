//! What a replay claims: the rows that it replayed, and no other.

use crate::common::{Ran, cellpos, number, succeed};
use std::path::{Path, PathBuf};

const FAST: &str = "--clock virtual --frames off --json";

fn held(folder: &Path, options: &str) -> PathBuf {
    succeed(
        folder,
        &format!("track --target 0um --duration 20s --name held {options} {FAST}"),
    );
    let mut runs = std::fs::read_dir(folder.join("runs")).unwrap().flatten();
    runs.next().unwrap().path()
}

/// Result of a replay as text and as JSON; both end with the same code.
fn replay(folder: &Path, run: &Path) -> (Ran, Ran) {
    let line = format!("replay {}", run.display());
    let (text, json) = (
        cellpos(folder, &line),
        cellpos(folder, &format!("{line} --json")),
    );
    assert_eq!(text.code, json.code, "{}\n{}", text.out, json.out);
    (text, json)
}

fn edit(run: &Path, change: impl Fn(String) -> String) {
    let path = run.join("run.toml");
    let text = std::fs::read_to_string(&path).unwrap();
    let changed = change(text.clone());
    assert_ne!(changed, text);
    std::fs::write(path, changed).unwrap();
}

#[test]
fn a_whole_run_is_reproduced_and_nothing_else_is_said() {
    let folder = tempfile::tempdir().unwrap();
    let run = held(folder.path(), "");
    let (text, json) = replay(folder.path(), &run);
    assert_eq!(text.code, Some(0), "{}", text.out);
    assert_eq!(
        text.out,
        "20000 of 20000 ticks identical: every command reproduced to the bit\n"
    );
    let json = json.json();
    assert_eq!(json["complete"], true, "{json}");
    assert_eq!(number(&json, "missing_rows"), 0.0);
}

#[test]
fn rows_behind_a_gap_are_said_to_be_not_replayed() {
    let folder = tempfile::tempdir().unwrap();
    let run = held(folder.path(), "");
    let path = run.join("ticks.arrow");
    let mut bytes = std::fs::read(&path).unwrap();
    // A few rows in the middle are not what was written.
    let middle = bytes.len() / 2;
    bytes[middle..middle + 64]
        .iter_mut()
        .for_each(|b| *b ^= 0x55);
    std::fs::write(&path, bytes).unwrap();
    let (text, json) = replay(folder.path(), &run);
    assert_eq!(text.code, Some(1), "{}", text.out);
    assert!(text.out.contains("after that gap"), "{}", text.out);
    let json = json.json();
    let session = &json["sessions"][0];
    assert!(session["ended_at_gap"].is_object(), "{json}");
    assert!(
        number(session, "replayed") < number(session, "ticks"),
        "{json}"
    );
    assert_eq!(session["replayed"], session["identical"], "{json}");
    assert!(number(&json, "missing_rows") > 0.0, "{json}");
}

#[test]
fn the_end_of_a_run_that_was_killed_is_said_to_be_not_replayed() {
    let folder = tempfile::tempdir().unwrap();
    let run = held(folder.path(), "");
    edit(&run, |text| text[..text.find("[end]").unwrap()].to_owned());
    let ticks = std::fs::File::options()
        .write(true)
        .open(run.join("ticks.arrow"))
        .unwrap();
    let length = ticks.metadata().unwrap().len();
    ticks.set_len(length * 7 / 10).unwrap();
    let (text, json) = replay(folder.path(), &run);
    // All that is there was reproduced; that it is not all is said.
    assert_eq!(text.code, Some(0), "{}", text.out);
    let said = [
        "that the record has",
        "not replayed",
        "the record has no end",
    ];
    assert!(said.iter().all(|s| text.out.contains(s)), "{}", text.out);
    let json = json.json();
    assert_eq!(json["complete"], false, "{json}");
    assert!(
        number(&json["sessions"][0], "unreadable_bytes") > 0.0,
        "{json}"
    );
}

#[test]
fn rows_that_the_run_lost_at_its_end_are_said_to_be_not_replayed() {
    let folder = tempfile::tempdir().unwrap();
    let run = held(folder.path(), "");
    // As a full disk leaves it: the end of the run is not in the record, and counted.
    edit(&run, |text| {
        text.replace("rows_lost = 0", "rows_lost = 321")
    });
    let (text, json) = replay(folder.path(), &run);
    assert_eq!(text.code, Some(1), "{}", text.out);
    assert!(text.out.contains("not replayed: 321 rows"), "{}", text.out);
    let json = json.json();
    assert_eq!(number(&json["sessions"][0], "lost_rows"), 321.0, "{json}");
    assert_eq!(number(&json, "missing_rows"), 321.0, "{json}");
}

#[test]
fn another_controller_is_named_by_its_first_difference_and_another_law_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let run = held(folder.path(), "--controller pi");
    let meta = std::fs::read_to_string(run.join("run.toml")).unwrap();
    edit(&run, |text| {
        let at = text.find("\nkp_um_per_um = ").unwrap() + "\nkp_um_per_um = ".len();
        let end = at + text[at..].find('\n').unwrap();
        format!("{}0.31{}", &text[..at], &text[end..])
    });
    let (text, json) = replay(folder.path(), &run);
    assert_eq!(text.code, Some(1), "{}", text.out);
    assert!(
        text.out.contains("first difference at tick"),
        "{}",
        text.out
    );
    assert!(json.json()["first_mismatch"].is_object());

    std::fs::write(run.join("run.toml"), meta).unwrap();
    edit(&run, |text| match text.find("law_columns") {
        Some(_) => text.replacen("law_columns = [", "law_columns = [\"mine\", ", 1),
        None => text.replacen("clock = ", "law_columns = [\"mine\"]\nclock = ", 1),
    });
    let (text, json) = replay(folder.path(), &run);
    assert_eq!(text.code, Some(2), "{}", text.out);
    assert!(text.err.contains("mine"), "{}", text.err);
    assert!(json.out.contains("mine"), "{}", json.out);
}

#[test]
fn each_session_of_a_resumed_run_is_replayed_and_judged_by_itself() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    std::fs::write(
        at.join("quick.toml"),
        "name = \"quick\"\n[[step]]\ndo = \"sine\"\namplitude = \"1um\"\nfrequency = \"20Hz\"\ncycles = 60\n",
    )
    .unwrap();
    succeed(at, &format!("run quick.toml {FAST}"));
    let mut runs = std::fs::read_dir(at.join("runs")).unwrap().flatten();
    let run = runs.next().unwrap().path();
    // Killed in the middle, and gone on with.
    edit(&run, |text| text[..text.find("[end]").unwrap()].to_owned());
    let ticks = std::fs::File::options()
        .write(true)
        .open(run.join("ticks.arrow"))
        .unwrap();
    let length = ticks.metadata().unwrap().len();
    ticks.set_len(length / 2).unwrap();
    let table = std::fs::read_to_string(run.join("cycles.csv")).unwrap();
    let rows: Vec<&str> = table.lines().take(1 + 20).collect();
    std::fs::write(run.join("cycles.csv"), rows.join("\n") + "\n").unwrap();
    succeed(at, &format!("run --resume {} --json", run.display()));
    let (text, json) = replay(at, &run);
    assert_eq!(text.code, Some(0), "{}", text.out);
    let lines: Vec<&str> = text.out.lines().collect();
    assert!(lines[0].starts_with("session 1: "), "{}", text.out);
    assert!(lines[1].contains("the record has no end"), "{}", text.out);
    assert!(lines[2].starts_with("session 2: "), "{}", text.out);
    assert!(
        lines[2].ends_with("every command reproduced to the bit"),
        "{}",
        text.out
    );
    let json = json.json();
    assert_eq!(json["sessions"][0]["complete"], false, "{json}");
    assert_eq!(json["sessions"][1]["complete"], true, "{json}");
}
