//! Every kind of run through every command that reads one; what is missing or damaged around a run.

use crate::common::{cellpos, succeed};
use cellpos_numeric::parallel::map;
use cellpos_record::export::columns::OF_LAWS;
use serde_json::Value;
use std::path::{Path, PathBuf};

const FAST: &str = "--clock virtual --frames off --json";

/// The one folder below `runs` that a command has made.
fn made(folder: &Path, line: &str) -> PathBuf {
    let list = || -> Vec<PathBuf> {
        let entries = std::fs::read_dir(folder.join("runs")).into_iter().flatten();
        entries.flatten().map(|entry| entry.path()).collect()
    };
    let before = list();
    succeed(folder, line);
    let mut new = list();
    new.retain(|run| !before.contains(run));
    assert_eq!(new.len(), 1, "{line}");
    new.remove(0)
}

fn script(folder: &Path) {
    let text = "name = \"quick\"\n[[step]]\ndo = \"sine\"\namplitude = \"1um\"\nfrequency = \"20Hz\"\ncycles = 120\n\
                [[step]]\ndo = \"hold\"\nduration = \"100ms\"\n";
    std::fs::write(folder.join("quick.toml"), text).unwrap();
}

/// The remains of a program that is killed while it writes.
const HALF_MADE: &str = ".ticks.parquet.1.part";

/// Turns a run into the remains of a kill: no end, and the beginning of its records.
fn killed(run: &Path, share: f64) {
    let meta = std::fs::read_to_string(run.join("run.toml")).unwrap();
    std::fs::write(run.join("run.toml"), &meta[..meta.find("[end]").unwrap()]).unwrap();
    let _ = std::fs::remove_file(run.join("ticks.parquet"));
    std::fs::write(run.join(HALF_MADE), "PAR1").unwrap();
    let ticks = std::fs::OpenOptions::new()
        .write(true)
        .open(run.join("ticks.arrow"))
        .unwrap();
    let length = ticks.metadata().unwrap().len();
    ticks.set_len((length as f64 * share) as u64).unwrap();
}

/// A run of a script that was killed and gone on with.
fn resumed(folder: &Path) -> PathBuf {
    let run = made(folder, &format!("run quick.toml --name resumed {FAST}"));
    killed(&run, 0.6);
    let table = std::fs::read_to_string(run.join("cycles.csv")).unwrap();
    let rows: Vec<&str> = table.lines().take(1 + 20).collect();
    std::fs::write(run.join("cycles.csv"), rows.join("\n") + "\n").unwrap();
    succeed(folder, &format!("run --resume {} --json", run.display()));
    run
}

fn lines(path: &Path) -> u64 {
    std::fs::read_to_string(path).unwrap().lines().count() as u64
}

/// The CSV has the control law's own columns, and docs/data.md describes them.
fn has_the_laws_columns(kind: &str, run: &Path, csv: &Path) {
    let text = std::fs::read_to_string(csv).unwrap();
    let head: Vec<&str> = text.lines().next().unwrap().split(',').collect();
    let meta = std::fs::read_to_string(run.join("run.toml")).unwrap();
    let meta: toml::Table = meta.parse().unwrap();
    for name in meta["law_columns"].as_array().unwrap() {
        let name = name.as_str().unwrap();
        assert!(head.contains(&name), "{kind}: {name}");
        let known = OF_LAWS.iter().any(|(known, _)| *known == name);
        assert!(known, "docs/data.md does not say what {name} is");
    }
}

/// A run compared with a model, and a model fitted to it: a result, or a sentence that says what such a record lacks.
fn compared(at: &Path, kind: &str, run: &Path) {
    let path = run.display();
    let ran = cellpos(
        at,
        &format!(
            "reconcile --model eq6 --data {path} --max-effects 1 --report {path}-gap.html --json"
        ),
    );
    let said = ran.json();
    match ran.code {
        Some(0) => {
            let page = std::fs::read_to_string(format!("{path}-gap.html")).unwrap();
            for session in std::fs::read_dir(run.join("sessions"))
                .into_iter()
                .flatten()
            {
                let name = session.unwrap().file_name();
                assert!(
                    page.contains(name.to_str().unwrap()),
                    "{kind}: {name:?} was left out"
                );
            }
        }
        code => {
            let message = said["error"]["message"].as_str().unwrap_or("");
            assert!(
                code == Some(2) && message.contains("at least 5 s"),
                "{kind}: {said}"
            );
        }
    }
    let ran = cellpos(
        at,
        &format!("identify --data {path} --json --out {path}-model.toml"),
    );
    let said = ran.json();
    let fits = matches!(ran.code, Some(0 | 1)) || !said["error"]["message"].is_null();
    assert!(fits && !ran.err.contains("panicked"), "{kind}: {}", ran.err);
    // The CSV of the run says the same: it shows where the loop was closed, and in which session.
    let of_csv = cellpos(at, &format!("identify --data {path}.csv --json"));
    let without_names = |object: Value| -> Vec<Value> {
        let mut files = object["files"].as_array().cloned().unwrap_or_default();
        for file in &mut files {
            file["file"] = Value::Null;
        }
        files
    };
    let (of_csv, of_run) = (without_names(of_csv.json()), without_names(said));
    assert_eq!(of_csv.len(), of_run.len(), "{kind}: {}", ran.err);
    for (csv, run) in of_csv.iter().zip(&of_run) {
        assert_eq!(csv, run, "{kind}");
    }
}

#[test]
fn every_kind_of_run_goes_through_every_command_that_reads_one() {
    // A run of two sessions, one of a cell through frames, and one without an end: what the others lack or have is among it.
    through_every_command(|kind| ["resumed", "cell", "killed"].contains(&kind));
}

#[test]
#[ignore = "nightly: models are fitted to every kind; the fast one fits them to three"]
fn every_kind_of_run_is_compared_with_a_model() {
    through_every_command(|_| true);
}

/// A run of each kind.
fn one_of_each_kind(at: &Path) -> [(&'static str, PathBuf); 8] {
    script(at);
    let cell = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/cell.toml");
    let learn = "--sine 2um@20Hz --learn --duration 6s --name learned";
    // So long that a whole block of its records lies before the cut: half of it leaves no row.
    let cut = made(
        at,
        &format!("track --target 1um --duration 20s --name cut {FAST}"),
    );
    killed(&cut, 0.8);
    let bare = made(
        at,
        &format!("track --target 1um --duration 3s --name bare {FAST}"),
    );
    // Without a summary: as a version that knew none, or a disk that was full at the end, leaves it.
    let meta = std::fs::read_to_string(bare.join("run.toml")).unwrap();
    let end = meta.find("[end.summary]").unwrap();
    std::fs::write(bare.join("run.toml"), &meta[..end]).unwrap();
    [
        (
            "track",
            made(at, &format!("track --target 1um --duration 6s {FAST}")),
        ),
        (
            "learned",
            made(at, &format!("track --target 0um {learn} {FAST}")),
        ),
        ("script", made(at, &format!("run quick.toml {FAST}"))),
        (
            "script that learns",
            made(
                at,
                &format!("run quick.toml --learn --name learning {FAST}"),
            ),
        ),
        ("resumed", resumed(at)),
        (
            "cell",
            made(
                at,
                &format!(
                    "track --target 0um --duration 3s --name cell --rig {} --clock virtual --json",
                    cell.display()
                ),
            ),
        ),
        ("killed", cut),
        ("without a summary", bare),
    ]
}

/// Every kind exported, replayed and reported, and those that are asked for compared with a model.
fn through_every_command(is_compared: impl Fn(&str) -> bool + Sync) {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let runs = one_of_each_kind(at);
    map(&runs, 2, |(kind, run)| {
        let path = run.display();
        let exported: Value = succeed(at, &format!("export {path} --json")).json();
        let rows = exported["rows"].as_u64().unwrap();
        assert!(rows > 1500, "{kind}: {exported}");
        let csv = PathBuf::from(format!("{path}.csv"));
        assert_eq!(lines(&csv), 1 + rows, "{kind}");
        has_the_laws_columns(kind, run, &csv);
        let parquet: Value = succeed(at, &format!("export {path} --format parquet --json")).json();
        assert_eq!(parquet["rows"], rows, "{kind}");

        let replay = succeed(at, &format!("replay {path} --json")).json();
        assert_eq!(replay["ticks"], rows, "{kind}: {replay}");
        assert_eq!(replay["identical"], rows, "{kind}: {replay}");

        succeed(at, &format!("report {path} --json"));
        assert!(run.join("report.html").is_file(), "{kind}");

        let bundle = succeed(at, &format!("bundle {path} --json")).json();
        assert_eq!(
            bundle["inputs_missing"].as_array().map(Vec::len),
            Some(0),
            "{kind}: {bundle}"
        );
        succeed(at, &format!("bundle --verify {path}-bundle"));
        let half_made = Path::new(&format!("{path}-bundle")).join(HALF_MADE);
        assert!(!half_made.exists(), "{kind}: {}", half_made.display());

        let simulated = format!("{path}-simulated.csv");
        succeed(
            at,
            &format!("simulate --model eq6 --input {path} --out {simulated}"),
        );
        if is_compared(kind) {
            compared(at, kind, run);
        }
    });
    let (_, resumed) = &runs[4];
    let of_sessions = succeed(at, &format!("export {} --force --json", resumed.display())).json();
    assert_eq!(of_sessions["sessions"], 2);
    let csv = std::fs::read_to_string(format!("{}.csv", resumed.display())).unwrap();
    let times: Vec<f64> = csv
        .lines()
        .skip(1)
        .map(|line| line.split(',').next().unwrap().parse().unwrap())
        .collect();
    assert!(
        times.windows(2).all(|pair| pair[1] > pair[0]),
        "one axis of time"
    );
}

#[test]
fn a_run_whose_table_of_cycles_is_gone_goes_on_where_its_ticks_end() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    script(at);
    let run = made(at, &format!("run quick.toml {FAST}"));
    let whole = std::fs::read_to_string(run.join("cycles.csv")).unwrap();
    killed(&run, 0.6);
    std::fs::remove_file(run.join("cycles.csv")).unwrap();
    succeed(at, &format!("run --resume {} --json", run.display()));
    let cycles: Vec<String> = std::fs::read_to_string(run.join("cycles.csv"))
        .unwrap()
        .lines()
        .map(str::to_owned)
        .collect();
    let numbers: Vec<usize> = cycles[1..]
        .iter()
        .map(|line| line.split(',').next().unwrap().parse().unwrap())
        .collect();
    assert_eq!(numbers, (0..120).collect::<Vec<usize>>());
    let first: Vec<&str> = whole.lines().take(11).collect();
    assert_eq!(
        cycles[..11],
        first,
        "the rows that the run had are the rows that the ticks give"
    );
}

#[test]
fn what_was_learned_is_expendable() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    script(at);
    let run = made(at, &format!("run quick.toml --learn {FAST}"));
    let learned = run.join("learned.toml");
    let text = std::fs::read_to_string(&learned).unwrap();
    std::fs::write(&learned, &text[..text.len() / 2]).unwrap();
    let ran = succeed(at, &format!("report {} --json", run.display()));
    assert!(
        ran.err.contains("learned.toml") && ran.err.contains("ignored"),
        "{}",
        ran.err
    );
    killed(&run, 0.6);
    let table = std::fs::read_to_string(run.join("cycles.csv")).unwrap();
    let rows: Vec<&str> = table.lines().take(1 + 20).collect();
    std::fs::write(run.join("cycles.csv"), rows.join("\n") + "\n").unwrap();
    succeed(at, &format!("run --resume {} --json", run.display()));
}

#[cfg(unix)]
#[test]
fn a_bundle_follows_links_when_it_is_packed_and_trusts_none_when_it_is_verified() {
    use std::os::unix::fs::symlink;
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let run = made(at, &format!("track --target 0um --duration 1s {FAST}"));
    std::fs::write(at.join("notes.txt"), "notes").unwrap();
    symlink(at.join("notes.txt"), run.join("notes.txt")).unwrap();
    // A folder of the name that an earlier version used for its half-made bundles is somebody's.
    std::fs::create_dir(at.join("packed.part")).unwrap();
    std::fs::write(at.join("packed.part/mine"), "mine").unwrap();
    succeed(at, &format!("bundle {} --out packed", run.display()));
    assert!(at.join("packed.part/mine").is_file());
    let copy = at.join("packed/notes.txt");
    assert!(!copy.is_symlink() && std::fs::read_to_string(&copy).unwrap() == "notes");
    succeed(at, "bundle --verify packed");

    let manifest = at.join("packed/MANIFEST.sha256");
    let honest = std::fs::read_to_string(&manifest).unwrap();
    std::fs::remove_file(&copy).unwrap();
    symlink(at.join("notes.txt"), &copy).unwrap();
    let ran = cellpos(at, "bundle --verify packed");
    assert_eq!(ran.code, Some(1), "{}", ran.out);
    assert!(ran.out.contains("notes.txt"), "{}", ran.out);
    std::fs::remove_file(&copy).unwrap();
    std::fs::write(&copy, "notes").unwrap();
    let line = honest
        .lines()
        .find(|line| line.ends_with("notes.txt"))
        .unwrap();
    let outside = line.replace("notes.txt", "../notes.txt");
    std::fs::write(&manifest, format!("{honest}{outside}\n")).unwrap();
    let ran = cellpos(at, "bundle --verify packed");
    assert_eq!(ran.code, Some(1), "{}", ran.out);
    assert!(ran.out.contains("leads out of the bundle"), "{}", ran.out);
}

#[test]
fn a_device_is_no_script_and_a_script_gives_the_terminal_no_orders() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    if Path::new("/dev/zero").exists() {
        let ran = cellpos(at, "check /dev/zero");
        assert_eq!(ran.code, Some(2));
        assert!(ran.err.contains("device"), "{}", ran.err);
    }
    std::fs::write(
        at.join("evil.toml"),
        "name = \"a\\u001b]0;owned\\u0007\"\n# \u{1b}[2J\nwrong = 1\n",
    )
    .unwrap();
    for line in [
        "check evil.toml",
        "run evil.toml --dry",
        "design --model evil.toml",
    ] {
        let ran = cellpos(at, line);
        assert_eq!(ran.code, Some(2), "{line}: {}{}", ran.out, ran.err);
        let orders = [&ran.out, &ran.err].map(|text| {
            text.contains('\u{7}') || text.contains("\u{1b}[2J") || text.contains("\u{1b}]")
        });
        assert_eq!(orders, [false, false], "{line}");
    }
}

#[test]
fn several_runs_where_one_is_meant_get_a_sentence() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let make = format!("track --target 0um --duration 1s --name two {FAST}");
    let [one, other] = [made(at, &make), made(at, &make)];
    for command in ["replay", "export", "watch"] {
        // As a shell hands over runs/*-two*.
        let line = format!("{command} {} {}", one.display(), other.display());
        let ran = cellpos(at, &line);
        assert_eq!(ran.code, Some(2), "{line}: {}", ran.err);
        let said = ran.err.split_whitespace().collect::<Vec<_>>().join(" ");
        assert!(
            said.contains("this command takes one") && said.contains("latest-NAME"),
            "{line}: {said}"
        );
    }
    succeed(at, "replay latest-two");
}
