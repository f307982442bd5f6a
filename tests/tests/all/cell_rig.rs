//! A cell on a rig with its own camera: the empty channel is recorded first, then the cell is followed against it.

use crate::rig_in_a_box::median_error_nm;
use cellpos_record::RunReader;
use cellpos_tests::programs::{RigInABox, cellpos, stdout};
use serde_json::Value;
use std::path::Path;
use std::process::Output;

/// The same world twice: with the cell flushed out of view, and in it.
fn write_rigs(folder: &Path) {
    let box_of = |start_um: f64| {
        format!(
            "[emulator]\npixel_um = 0.2\nheight_px = 64\nstart_um = {start_um:?}\n[emulator.cell]\n"
        )
    };
    std::fs::write(folder.join("empty-box.toml"), box_of(200.0)).unwrap();
    std::fs::write(folder.join("cell-box.toml"), box_of(-8.0)).unwrap();
    // Patient with stalls of the machine.
    let rig = |cell: &str| {
        format!(
            "[actuator]\nkind = \"serial\"\nport = \"pzt\"\nwatchdog_ms = 500\n\
             [camera]\nkind = \"socket\"\nsocket = \"camera.sock\"\n{cell}\
             [calibration]\npixel_um = 0.2\norigin_px = 127.5\nsign = 1.0\n\
             [timing]\noldest_ms = 60.0\nfaults_in_a_row = 200\nbudget_us = 1000.0\n"
        )
    };
    std::fs::write(
        folder.join("rig.toml"),
        rig("[cell]\nbackground = \"empty.tif\"\n"),
    )
    .unwrap();
    std::fs::write(folder.join("unknown.toml"), rig("[cell]\n")).unwrap();
}

fn run(folder: &Path, line: &str) -> Output {
    cellpos(folder, line).output().unwrap()
}

fn error(output: &Output) -> String {
    assert_eq!(output.status.code(), Some(2), "{}", stdout(output));
    // Long lines are broken by the printer.
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    text.replace('│', " ")
        .split_whitespace()
        .collect::<Vec<_>>()
        .join(" ")
}

#[test]
fn a_cell_is_followed_over_a_socket_against_a_background_recorded_before() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    write_rigs(at);
    let track = "track --target 0um --duration 4s --json --rig";

    let filming = RigInABox::start(at, &["--rig", "cell-box.toml"]);
    let text = error(&run(at, &format!("{track} unknown.toml")));
    assert!(
        text.contains("[cell] background") && text.contains("cellpos background"),
        "{text}"
    );
    let text = error(&run(at, &format!("{track} rig.toml")));
    assert!(text.contains("empty.tif"), "{text}");
    filming.finish();
    std::fs::remove_file(at.join("camera.sock")).ok();
    std::fs::remove_file(at.join("pzt")).ok();

    let flushed = RigInABox::start(at, &["--rig", "empty-box.toml"]);
    let output = run(
        at,
        "background --rig rig.toml --out empty.tif --frames 60 --json",
    );
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    let taken: Value = serde_json::from_str(&stdout(&output)).unwrap();
    assert_eq!(
        (&taken["frames"], &taken["width_px"], &taken["height_px"]),
        (&60.into(), &256.into(), &64.into())
    );
    assert!(
        (taken["noise_grey"].as_f64().unwrap() - 1.9).abs() < 0.1,
        "{taken}"
    );
    let again = error(&run(at, "background --rig rig.toml --out empty.tif"));
    assert!(again.contains("exists already"), "{again}");
    flushed.finish();
    std::fs::remove_file(at.join("camera.sock")).ok();
    std::fs::remove_file(at.join("pzt")).ok();

    let filming = RigInABox::start(at, &["--rig", "cell-box.toml"]);
    let output = run(at, &format!("{track} rig.toml"));
    filming.finish();
    let text = stdout(&output);
    assert_eq!(
        output.status.code(),
        Some(0),
        "{text}{}",
        String::from_utf8_lossy(&output.stderr)
    );
    let summary: Value = serde_json::from_str(&text).unwrap();
    let run = at.join(summary["run"].as_str().unwrap());
    // On an idle machine 60 nm RMS, or 40 nm in the median.
    let median_nm = median_error_nm(&run);
    assert!(median_nm < 400.0, "{median_nm} nm: {text}");
    let reader = RunReader::open(&run).unwrap();
    let meta = reader.meta().unwrap();
    assert!(
        meta.inputs
            .iter()
            .any(|input| input.path.ends_with("empty.tif")),
        "{:?}",
        meta.inputs
    );
    let (ticks, _) = reader.ticks().unwrap();
    let lengths: Vec<f64> = ticks
        .iter()
        .map(|tick| tick.length_um)
        .filter(|um| um.is_finite())
        .collect();
    assert!(lengths.len() > 1000, "{}", lengths.len());
    assert!(lengths.iter().all(|um| (um / 8.0 - 1.0).abs() < 0.05));
}
