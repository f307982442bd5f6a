//! docs/rig.md as a newcomer follows it: the chain from `rig new` to a held bead, copied from the page, with `firmware-sim` as
//! the only hardware. Also: the files on the page equal the installed ones.

use cellpos_tests::programs::{self, RigInABox};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

fn page() -> String {
    std::fs::read_to_string(root().join("docs/rig.md")).expect("docs/rig.md")
}

/// The commands of the block behind the mark, one a line.
fn chain() -> Vec<String> {
    let page = page();
    let (_, behind) = page.split_once("<!-- chain -->\n```\n").expect("the mark");
    let (block, _) = behind.split_once("\n```").expect("the end of the block");
    block.lines().map(ToString::to_string).collect()
}

fn run(folder: &Path, line: &str) -> Output {
    let path = format!(
        "{}:{}",
        programs::folder().display(),
        std::env::var("PATH").unwrap_or_default()
    );
    Command::new("bash")
        .args(["-euo", "pipefail", "-c", line])
        .env("PATH", path)
        .current_dir(folder)
        .output()
        .expect("bash")
}

#[test]
fn the_chain_has_every_command_in_its_order() {
    let words: Vec<String> = chain()
        .iter()
        .map(|line| {
            let mut words = line.split_whitespace().skip(1);
            let first = words.next().unwrap_or("");
            match (first, words.next()) {
                ("rig", Some(second)) => format!("rig {second}"),
                _ => first.to_string(),
            }
        })
        .collect();
    let expected = [
        "rig new",
        "rig check",
        "board",
        "jog",
        "camera",
        "calibrate",
        "identify",
        "design",
        "track",
    ];
    assert_eq!(words, expected);
}

#[test]
#[ignore = "long: identifies in real time, a minute to three: cargo test --workspace --test all rig_page:: -- --ignored --nocapture"]
fn a_newcomer_comes_from_the_box_to_a_held_bead_with_the_commands_of_the_page() {
    let folder = tempfile::tempdir().expect("a folder");
    let rig = RigInABox::start(folder.path(), &["--duration", "600s"]);
    for line in chain() {
        let began = std::time::Instant::now();
        let out = run(folder.path(), &line);
        println!("{:6.1} s  {line}", began.elapsed().as_secs_f64());
        assert!(
            out.status.success(),
            "{line}\n{}\n{}",
            String::from_utf8_lossy(&out.stdout),
            String::from_utf8_lossy(&out.stderr)
        );
    }
    for name in [
        "rig.toml",
        "frame.png",
        "calibration.toml",
        "model.toml",
        "controller.toml",
    ] {
        assert!(folder.path().join(name).is_file(), "{name}");
    }
    let calibration = std::fs::read_to_string(folder.path().join("calibration.toml")).unwrap();
    assert!(
        calibration.contains("axis = \"x\"\nsign = 1\n"),
        "the box's own: {calibration}"
    );
    // Held for the last second of the five, and parked afterwards.
    let rows = rig.finish();
    let moved = |um: f64| (um - 20.0).abs() > 1e-3;
    let last = rows
        .iter()
        .rposition(|row| row.state == "Running" && moved(row.applied_um));
    let last = last.expect("the loop moved the PZT");
    let held = &rows[last.saturating_sub(1000)..last];
    let rms_um =
        (held.iter().map(|row| row.bead_um.powi(2)).sum::<f64>() / held.len() as f64).sqrt();
    println!("held within {rms_um:.3} um RMS");
    assert!(rms_um < 2.0, "{rms_um} um");
    let end = rows.last().expect("rows");
    assert!((end.applied_um - 20.0).abs() < 0.01, "{end:?}");
}

#[test]
fn the_page_shows_the_files_that_are_installed() {
    let page = page();
    for name in ["60-cellpos.rules", "cellpos-limits.conf"] {
        let text = std::fs::read_to_string(root().join("packaging").join(name)).expect(name);
        let rules: Vec<&str> = text.lines().filter(|line| !line.starts_with('#')).collect();
        assert!(rules.len() >= 2, "{name}");
        let (_, behind) = page.split_once(&format!("`packaging/{name}`")).expect(name);
        let (_, block) = behind.split_once("```\n").expect(name);
        let (block, _) = block.split_once("\n```").expect(name);
        assert_eq!(block.lines().collect::<Vec<_>>(), rules, "{name}");
    }
}
