//! The commands of the pages run, and those that cannot run here exist.

use super::{blocks, pages, read, root};
use cellpos_tests::programs;
use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;
use std::time::Instant;

/// The caller of the tests has built and installed everything.
const PRELUDE: &str = r#"
set -euo pipefail
cargo() {
    case "$1" in
        run) shift; while [ "$1" != "--" ]; do shift; done; shift; cellpos "$@" ;;
        build) ;;
        test) [ "$*" = "test --workspace" ] ;; # this very run
        *) echo "the test does not know cargo $1" >&2; return 1 ;;
    esac
}
"#;

fn copy_folder(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).unwrap();
    for entry in std::fs::read_dir(from).unwrap().flatten() {
        let target = to.join(entry.file_name());
        if entry.file_type().unwrap().is_dir() {
            copy_folder(&entry.path(), &target);
        } else {
            std::fs::copy(entry.path(), target).unwrap();
        }
    }
}

/// The commands of a page that run here: the quick ones, or all.
fn script(page: &str, slow: bool) -> String {
    let runs = |info: &str| info == "sh" || slow && info == "sh slow";
    let found = blocks(&read(page));
    found
        .iter()
        .filter(|block| runs(&block.info))
        .map(|block| block.text.as_str())
        .collect()
}

/// What a run says that a stall of the machine ended, as it must.
const STALLED: [&str; 3] = ["cellpos doctor", "was suspended", "watchdog"];

fn run(page: &str, script: &str) -> Result<(), String> {
    match try_page(page, script) {
        Err(why) if in_real_time(script) && STALLED.iter().any(|said| why.contains(said)) => {
            println!("{why}");
            Ok(())
        }
        tried => tried,
    }
}

fn try_page(page: &str, script: &str) -> Result<(), String> {
    let folder = tempfile::tempdir().unwrap();
    for shown in ["examples", "tests/data/piezo-picma"] {
        copy_folder(&root().join(shown), &folder.path().join(shown));
    }
    let path = format!(
        "{}:{}",
        programs::folder().display(),
        std::env::var("PATH").unwrap_or_default()
    );
    let began = Instant::now();
    let output = Command::new("bash")
        .arg("-c")
        .arg(format!("{PRELUDE}\n{script}"))
        .current_dir(&folder)
        .env("PATH", path)
        .output()
        .unwrap();
    println!("{:6.1} s  {page}", began.elapsed().as_secs_f64());
    if output.status.success() {
        return Ok(());
    }
    Err(format!(
        "{page}: {}\n{}\n{}",
        output.status,
        programs::stdout(&output),
        String::from_utf8_lossy(&output.stderr)
    ))
}

/// A page holds a bead in real time, or judges the machine.
fn in_real_time(script: &str) -> bool {
    cellpos_lines(script).iter().any(|line| {
        let real = ["track", "run", "identify", "doctor"];
        let simulated = ["--clock virtual", "--dry", "--data"];
        real.contains(&line.split_whitespace().nth(1).unwrap_or_default())
            && !simulated.iter().any(|how| line.contains(how))
    }) || script.contains("cargo run")
}

/// All pages. Those in real time run one after another, alone among the tests in real time; the others meanwhile.
fn run_pages(slow: bool) {
    let with_commands: Vec<(String, String)> = pages()
        .into_iter()
        .map(|page| (script(&page, slow), page))
        .filter(|(script, page)| {
            // The slow ones alone: the quick pages have their own test.
            !script.is_empty() && (!slow || *script != self::script(page, false))
        })
        .map(|(script, page)| (page, script))
        .collect();
    assert!(
        with_commands.len() >= 4,
        "are the pages still marked with sh?"
    );
    let (real, simulated): (Vec<_>, Vec<_>) =
        (with_commands.iter()).partition(|(_, script)| in_real_time(script));
    let run_all = |pages: Vec<&(String, String)>| -> Vec<String> {
        pages
            .into_iter()
            .filter_map(|(page, script)| run(page, script).err())
            .collect()
    };
    let failed = std::thread::scope(|scope| {
        let meanwhile = scope.spawn(|| run_all(simulated));
        let alone = programs::alone();
        let mut failed = run_all(real);
        drop(alone);
        failed.extend(meanwhile.join().unwrap());
        failed
    });
    assert!(failed.is_empty(), "{}", failed.join("\n\n"));
}

#[test]
fn the_commands_of_every_page_run() {
    run_pages(false);
}

#[test]
#[ignore = "minutes: fatigue run, circle, paper: cargo test --workspace --test all book:: -- --ignored"]
fn the_slow_commands_of_the_pages_run() {
    run_pages(true);
}

/// `cellpos` commands of a text, one a line; a backslash at the end continues the line.
fn cellpos_lines(text: &str) -> Vec<String> {
    let joined = text.replace("\\\n", " ");
    let lines = joined.lines().map(|line| line.trim_start_matches("$ "));
    lines
        .map(|line| line.trim_start_matches("nohup "))
        .filter(|line| line.starts_with("cellpos "))
        .map(|line| line.split(" #").next().unwrap_or(line).to_owned())
        .collect()
}

#[test]
fn commands_that_need_hardware_have_the_options_that_the_pages_give_them() {
    let mut helps: BTreeMap<String, String> = BTreeMap::new();
    let mut checked = 0;
    for page in pages() {
        for block in blocks(&read(&page)) {
            if !matches!(block.info.as_str(), "" | "text" | "console" | "sh slow") {
                continue;
            }
            for line in cellpos_lines(&block.text) {
                let mut words = line.split_whitespace().skip(1);
                let mut command = words.next().unwrap_or("").to_owned();
                if command == "rig" {
                    command += " ";
                    command += words.next().unwrap_or("");
                }
                let help = helps.entry(command.clone()).or_insert_with(|| {
                    let folder = tempfile::tempdir().unwrap();
                    let out = programs::cellpos(folder.path(), &format!("{command} --help"))
                        .output()
                        .unwrap();
                    assert!(out.status.success(), "{page}: cellpos {command}");
                    programs::stdout(&out)
                });
                for option in words.filter(|word| word.starts_with("--")) {
                    let known = help
                        .split(|c: char| !(c.is_ascii_alphanumeric() || c == '-'))
                        .any(|word| word == option);
                    assert!(
                        known,
                        "{page}:{}: cellpos {command} has no {option}",
                        block.line
                    );
                    checked += 1;
                }
            }
        }
    }
    assert!(checked > 40, "only {checked} options were found");
}

#[test]
fn lines_that_go_on_are_one_command() {
    let text = "$ cellpos a --x 1 \\\n    --y 2\n$ sudo apt\ncellpos b   # why\n";
    assert_eq!(
        cellpos_lines(text),
        ["cellpos a --x 1      --y 2", "cellpos b  "]
    );
}
