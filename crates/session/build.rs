//! The commit that the program is built from, for `--version` and run.toml. A package of sources without its history sets
//! `CELLPOS_COMMIT`.

use std::process::Command;

fn git(arguments: &[&str]) -> Option<String> {
    let output = Command::new("git").args(arguments).output().ok()?;
    let text = String::from_utf8(output.stdout).ok()?;
    output
        .status
        .success()
        .then(|| text.trim().to_owned())
        .filter(|text| !text.is_empty())
}

fn main() {
    println!("cargo:rerun-if-env-changed=CELLPOS_COMMIT");
    println!("cargo:rerun-if-changed=build.rs");
    // Every commit adds a line to this log and an edit does not, so an edit does not build this crate again.
    if let Some(log) = git(&["rev-parse", "--git-path", "logs/HEAD"]) {
        println!("cargo:rerun-if-changed={log}");
    }
    let given = std::env::var("CELLPOS_COMMIT").ok();
    let commit = given
        .filter(|commit| !commit.is_empty())
        .or_else(|| git(&["rev-parse", "--short=12", "HEAD"]));
    println!(
        "cargo:rustc-env=CELLPOS_COMMIT={}",
        commit.as_deref().unwrap_or("unknown commit")
    );
}
