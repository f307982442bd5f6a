//! Every command of the README and of docs/ does what it says: each block marked `sh` is run by a shell.

use cellpos_tests::programs;
use std::path::{Path, PathBuf};
use std::process::Command;

/// `cargo run -- ...` is the program under test; what builds and tests has been done by whoever runs this.
const PRELUDE: &str = r#"
set -eu
cargo() {
    case "$1" in
        run) shift; while [ "$1" != "--" ]; do shift; done; shift; cellpos "$@" ;;
        build | test) ;;
        *) echo "the test does not know cargo $1" >&2; return 1 ;;
    esac
}
# Where the machine is not fit for real time, saying so is what doctor is for.
cellpos() {
    if [ "$1" = doctor ]; then command cellpos "$@" || [ $? -eq 1 ]; else command cellpos "$@"; fi
}
"#;

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// The blocks of a page that are marked `sh`, joined.
fn commands(page: &str) -> String {
    let mut text = String::new();
    let mut inside = false;
    for line in page.lines() {
        match line.trim_end() {
            "```sh" => inside = true,
            "```" => inside = false,
            line if inside => {
                text.push_str(line);
                text.push('\n');
            }
            _ => {}
        }
    }
    text
}

fn copy_folder(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).unwrap();
    for entry in std::fs::read_dir(from).unwrap().flatten() {
        let target = to.join(entry.file_name());
        if entry.file_type().unwrap().is_dir() {
            copy_folder(&entry.path(), &target);
        } else if entry.file_type().unwrap().is_file() {
            std::fs::copy(entry.path(), target).unwrap();
        }
    }
}

/// Runs the blocks of a page as one shell script, in a folder with a copy of examples/. A machine that stalls for longer
/// than the board's watchdog waits ends a real-time run in Safe, as it must: then once more, twice at most.
fn run_page(page: &str) -> PathBuf {
    for _ in 0..2 {
        match try_page(page) {
            Ok(folder) => return folder,
            Err(problem) => println!("{problem}\nonce more"),
        }
    }
    try_page(page).unwrap_or_else(|problem| panic!("{problem}"))
}

fn try_page(page: &str) -> Result<PathBuf, String> {
    let text = std::fs::read_to_string(root().join(page)).unwrap();
    let script = commands(&text);
    assert!(script.contains("cellpos "), "{page} has no commands");
    let folder = tempfile::tempdir().unwrap().keep();
    copy_folder(&root().join("examples"), &folder.join("examples"));
    let path = format!(
        "{}:{}",
        programs::folder().display(),
        std::env::var("PATH").unwrap_or_default()
    );
    let output = Command::new("sh")
        .arg("-c")
        .arg(format!("{PRELUDE}\n{script}"))
        .current_dir(&folder)
        .env("PATH", path)
        .output()
        .unwrap();
    if output.status.success() {
        return Ok(folder);
    }
    Err(format!(
        "{page}: {}\n{}\n{}",
        output.status,
        programs::stdout(&output),
        String::from_utf8_lossy(&output.stderr)
    ))
}

#[test]
fn every_command_of_the_readme_runs() {
    let folder = run_page("README.md");
    for left_behind in [
        "hold.csv",
        "model.toml",
        "identify.html",
        "controller.toml",
        "simulated.csv",
        "paper.html",
    ] {
        assert!(folder.join(left_behind).is_file(), "no {left_behind}");
    }
    std::fs::remove_dir_all(folder).unwrap();
}

#[test]
fn every_command_of_the_page_on_control_runs() {
    let folder = run_page("docs/control.md");
    let runs = std::fs::read_dir(folder.join("runs")).unwrap();
    let learned = runs
        .flatten()
        .filter(|run| run.path().join("learned.toml").is_file());
    assert_eq!(learned.count(), 2);
    std::fs::remove_dir_all(folder).unwrap();
}

#[test]
fn the_blocks_of_a_page_are_found() {
    let page = "a\n```sh\none\ntwo\n```\nb\n```toml\nx = 1\n```\n```sh\nthree\n```\n";
    assert_eq!(commands(page), "one\ntwo\nthree\n");
}
