//! Running scripts with the program as a user does, and reading what they leave.
#![allow(dead_code, reason = "each test file uses what it needs")]

use crate::common::hide;
use cellpos_plant::Effect;
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::Command;

/// The program with arguments, to be run in a folder.
pub(crate) fn command(folder: &Path, args: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cellpos"));
    command.args(args).current_dir(folder);
    command
}

/// Exit code, standard output and standard error of the program.
pub(crate) fn cellpos(folder: &Path, args: &[&str]) -> (Option<i32>, String, String) {
    let out = command(folder, args).output().unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    (out.status.code(), text(out.stdout), text(out.stderr))
}

/// The JSON object of a command that must succeed.
pub(crate) fn json(folder: &Path, args: &[&str]) -> Value {
    let (code, out, err) = cellpos(folder, args);
    assert_eq!(code, Some(0), "{args:?}: {out}\n{err}");
    serde_json::from_str(&out).unwrap()
}

/// The worked examples.
pub(crate) fn examples() -> Vec<PathBuf> {
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

/// The example rig with a cell.
pub(crate) fn cell_rig() -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/cell.toml");
    std::fs::read_to_string(path).unwrap()
}

/// Cell `column` of every row of a run's per-cycle table.
pub(crate) fn column(run: &Path, column: &str) -> Vec<String> {
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

/// The same as whole numbers.
pub(crate) fn numbers(run: &Path, name: &str) -> Vec<u64> {
    column(run, name)
        .iter()
        .map(|cell| cell.parse().unwrap())
        .collect()
}

/// The one run folder.
pub(crate) fn only_run(folder: &Path) -> PathBuf {
    let mut runs = std::fs::read_dir(folder.join("runs")).unwrap();
    let run = runs.next().unwrap().unwrap().path();
    assert!(runs.next().is_none(), "one run");
    run
}

/// A script of 20 Hz cycles about the middle.
pub(crate) fn script(folder: &Path, cycles: u32) {
    let text = format!(
        "name = \"quick\"\n[[step]]\ndo = \"sine\"\namplitude = \"1um\"\nfrequency = \"20Hz\"\ncycles = {cycles}\n\
         [[step]]\ndo = \"hold\"\nduration = \"100ms\"\n"
    );
    std::fs::write(folder.join("quick.toml"), text).unwrap();
}

/// Runs a script with PI on an emulated rig whose plant hides an effect.
pub(crate) fn run_beside(
    folder: &Path,
    script: &str,
    effect: Effect,
) -> (Option<i32>, Value, String) {
    hide(folder, "other.toml", effect);
    std::fs::write(
        folder.join("rig.toml"),
        "[emulator]\nmodel = \"other.toml\"\n",
    )
    .unwrap();
    let line =
        format!("run {script} --rig rig.toml --controller pi --clock virtual --frames off --json");
    let (code, out, err) = cellpos(folder, &line.split(' ').collect::<Vec<_>>());
    (code, serde_json::from_str(&out).unwrap_or_default(), err)
}
