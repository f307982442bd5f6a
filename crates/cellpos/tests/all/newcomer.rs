//! README and the reference pages as a newcomer reads them: every block marked `sh`, in order, in one folder, twice.

use std::path::{Path, PathBuf};
use std::process::Command;

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

/// The pages in the order in which they are read.
fn pages() -> Vec<PathBuf> {
    let mut pages = vec![root().join("README.md")];
    let mut docs: Vec<PathBuf> = std::fs::read_dir(root().join("docs"))
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|end| end == "md"))
        .collect();
    docs.sort();
    pages.extend(docs);
    pages
}

/// The blocks of a page that are marked `sh`.
fn blocks(page: &Path) -> Vec<String> {
    let text = std::fs::read_to_string(page).unwrap();
    let mut blocks = Vec::new();
    let mut open: Option<String> = None;
    for line in text.lines() {
        match (&mut open, line.trim_end()) {
            (None, "```sh") => open = Some(String::new()),
            (Some(block), "```") => {
                blocks.push(std::mem::take(block));
                open = None;
            }
            (Some(block), line) => {
                block.push_str(line);
                block.push('\n');
            }
            (None, _) => {}
        }
    }
    blocks
}

/// What is of the sources and not of the program: building, testing, benches.
fn is_of_the_sources(block: &str) -> bool {
    block
        .lines()
        .any(|line| line.trim_start().starts_with("cargo ") || line.contains("export PATH"))
}

/// A folder as a newcomer has it: the examples, and nothing else.
fn folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let copied = Command::new("cp")
        .arg("-r")
        .arg(root().join("examples"))
        .arg(folder.path())
        .status()
        .unwrap();
    assert!(copied.success());
    folder
}

fn run(folder: &Path, block: &str) -> Result<(), String> {
    let program = Path::new(env!("CARGO_BIN_EXE_cellpos"));
    let path = format!(
        "{}:{}",
        program.parent().unwrap().display(),
        std::env::var("PATH").unwrap_or_default()
    );
    let out = Command::new("bash")
        .args(["-euo", "pipefail", "-c", block])
        .env("PATH", path)
        .current_dir(folder)
        .output()
        .unwrap();
    if out.status.success() {
        return Ok(());
    }
    Err(format!(
        "{block}\n{}\n{}\n{}",
        out.status,
        String::from_utf8_lossy(&out.stdout),
        String::from_utf8_lossy(&out.stderr)
    ))
}

/// Whether a block is done in a few seconds by a program that is not optimised.
fn is_quick(block: &str) -> bool {
    const SLOW: [&str; 8] = [
        "identify",
        "circle",
        "paper",
        "reconcile",
        "firmware-sim",
        "run examples/scripts/fatigue.toml",
        "--learn",
        "cell.toml",
    ];
    // Rendered frames take their time.
    let rendered = block
        .lines()
        .any(|line| line.contains("cellpos track") && !line.contains("--frames off"));
    !rendered && !SLOW.iter().any(|word| block.contains(word))
}

#[test]
fn the_quick_blocks_of_every_page_run_twice_in_one_folder() {
    let folder = folder();
    // What earlier, slower blocks of the pages leave behind for these.
    let before = "cellpos track --target 0um --duration 2s --clock virtual --frames off --name hold\n\
                  cellpos run examples/scripts/step.toml --clock virtual --frames off --name fatigue-dry\n\
                  cp examples/model.toml model.toml\n";
    run(folder.path(), before).unwrap();
    let mut ran = 0;
    for round in 1..=2 {
        for page in pages() {
            for block in blocks(&page) {
                if is_of_the_sources(&block) || !is_quick(&block) || block.contains("model.toml") {
                    continue;
                }
                ran += 1;
                if let Err(said) = run(folder.path(), &block) {
                    panic!("{}, round {round}:\n{said}", page.display());
                }
            }
        }
    }
    assert!(
        ran >= 14,
        "only {ran} blocks were run: are the pages still marked with sh?"
    );
}

#[test]
#[ignore = "all blocks, some minutes: cargo build --release -p cellpos-firmware-sim && cargo test --release -p cellpos --test all newcomer -- --ignored"]
fn every_block_of_every_page_runs_twice_in_one_folder() {
    let rig_in_a_box = Path::new(env!("CARGO_BIN_EXE_cellpos")).with_file_name("firmware-sim");
    assert!(
        rig_in_a_box.is_file(),
        "build it first, in the same profile: cargo build -p cellpos-firmware-sim"
    );
    let folder = folder();
    let mut failed = Vec::new();
    for round in 1..=2 {
        for page in pages() {
            for block in blocks(&page) {
                if is_of_the_sources(&block) {
                    continue;
                }
                let began = std::time::Instant::now();
                let done = run(folder.path(), &block);
                eprintln!(
                    "{:6.1} s  {}  {}",
                    began.elapsed().as_secs_f64(),
                    page.file_name().unwrap().to_string_lossy(),
                    block.lines().next().unwrap_or("")
                );
                if let Err(said) = done {
                    failed.push(format!("{}, round {round}:\n{said}", page.display()));
                }
            }
        }
    }
    assert!(failed.is_empty(), "{}", failed.join("\n\n"));
}

#[test]
fn several_runs_where_one_is_meant_get_a_sentence() {
    let folder = folder();
    let make = "for i in 1 2; do cellpos track --target 0um --duration 1s --clock virtual --frames off --name two; done";
    run(folder.path(), make).unwrap();
    let said = run(folder.path(), "cellpos replay runs/*-two*").unwrap_err();
    assert!(
        said.contains("latest-two") || said.contains("latest-NAME"),
        "{said}"
    );
    run(folder.path(), "cellpos replay latest-two").unwrap();
}
