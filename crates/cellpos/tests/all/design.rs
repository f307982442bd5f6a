//! `cellpos design` as a user runs it.

use crate::common::{cellpos, number, succeed};
use serde_json::Value;
use std::path::Path;

fn within_2_percent(value: &Value, key: &str, expected: f64) {
    let found = number(value, key);
    assert!(
        (found / expected - 1.0).abs() < 0.02,
        "{key}: {found} instead of {expected}"
    );
}

const HERE: &str = env!("CARGO_MANIFEST_DIR");

#[test]
fn published_gains_on_eq6_have_the_published_margins() {
    let ran = succeed(
        Path::new(HERE),
        "design --model eq6 --delay 2.5ms --kp 0.46 --ki 19.5 --json",
    );
    let report = ran.json();
    within_2_percent(&report, "pm_deg", 48.7);
    within_2_percent(&report, "gm_db", 10.6);
    within_2_percent(&report, "delay_margin_ms", 4.66);
    within_2_percent(&report, "ms", 1.58);
    within_2_percent(&report, "mt", 1.30);
}

#[test]
fn a_search_keeps_its_limits_and_is_at_least_as_good_as_the_published_gains() {
    let report = succeed(
        Path::new(HERE),
        "design --model eq6 --delay 2.5ms --controller pi --json",
    )
    .json();
    assert!(number(&report, "ms") <= 1.6 + 1e-6 && number(&report, "mt") <= 1.3 + 1e-6);
    let controller = &report["controller"];
    assert!(number(controller, "ki_per_s") >= 19.5);
    assert!(number(controller, "kp_um_per_um") >= 0.46);
    let step = &report["step"];
    assert!(number(step, "settling_5_percent_ms") < 60.0);
    assert!(number(step, "overshoot_percent") < 15.0);
}

#[test]
fn every_controllers_default_is_stable_from_half_to_twice_the_gain_with_one_more_sample() {
    for controller in ["pi", "lead", "lqg", "mpc"] {
        let line = format!(
            "design --model eq6 --delay 2.5ms --controller {controller} --stable-over-spread --json"
        );
        let ran = cellpos(Path::new(HERE), &line);
        let report = ran.json();
        let rows = report["spread"].as_array().unwrap();
        assert_eq!(rows.len(), 10, "five gains, two delays");
        let unstable = rows.iter().filter(|row| row["stable"] == false).count();
        let broken = report["limits_broken"].as_array().unwrap();
        if unstable == 0 {
            assert_eq!((ran.code, broken.len()), (Some(0), 0), "{controller}");
        } else {
            // Then the program says no, and why.
            assert_eq!(ran.code, Some(1), "{controller}");
            assert!(broken.iter().any(|b| b["key"] == "stable_over_spread"));
            assert!(ran.err.contains("margin does not hold"), "{}", ran.err);
            assert_eq!(controller, "lead", "the others are stable by default");
        }
    }
}

#[test]
fn a_broken_limit_is_exit_code_1_and_named() {
    let ran = cellpos(
        Path::new(HERE),
        "design --model eq6 --delay 2.5ms --kp 0.46 --ki 19.5 --min-pm 60 --json",
    );
    assert_eq!(ran.code, Some(1));
    let report = ran.json();
    assert_eq!(report["limits_broken"][0]["key"], "min_pm_deg");
    assert!(ran.err.contains("LIMIT BROKEN: min_pm_deg"), "{}", ran.err);
    let unstable = cellpos(
        Path::new(HERE),
        "design --model eq6 --delay 2.5ms --kp 3 --ki 100 --json",
    );
    assert_eq!(unstable.code, Some(1), "an unstable loop is never fine");
    assert_eq!(unstable.json()["limits_broken"][0]["key"], "stable");
}

#[test]
fn bad_input_is_exit_code_2() {
    for line in [
        "design --delay 2.5",
        "design --model nowhere.toml",
        "design --kp 0.4",
        "design --delay 0.1ms",
        "design --controller lqg --setpoint-weight 0.5",
    ] {
        assert_eq!(cellpos(Path::new(HERE), line).code, Some(2), "{line}");
    }
}

#[test]
fn a_gain_of_63_per_second_is_flagged_as_63_per_hertz() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("eq5.toml");
    let eq6 = std::fs::read_to_string(Path::new(HERE).join("../../examples/model.toml")).unwrap();
    let literal: String = {
        let model = cellpos_plant::Model::from_toml_str(&eq6, "model.toml").unwrap();
        let plant = cellpos_plant::TransferFunction::integrator(63.0).unwrap();
        cellpos_plant::Model { plant, ..model }.to_toml_string()
    };
    std::fs::write(&path, literal).unwrap();
    let ran = cellpos(
        folder.path(),
        "design --model eq5.toml --delay 2.5ms --json",
    );
    let report = ran.json();
    let warnings = report["warnings"].to_string();
    assert!(
        warnings.contains("63") && (warnings.contains("396") || warnings.contains("2 pi")),
        "{warnings}"
    );
}

#[test]
fn a_designed_controller_is_the_one_that_track_then_runs() {
    let folder = tempfile::tempdir().unwrap();
    let overshoot = |weight: &str| {
        succeed(
            folder.path(),
            &format!("design --delay 2.5ms --setpoint-weight {weight} --out c{weight}.toml"),
        );
        let ran = succeed(
            folder.path(),
            &format!(
                "track --target 10um --duration 0.3s --clock virtual --frames off --no-record --json --controller c{weight}.toml"
            ),
        );
        let report = ran.json();
        assert!(number(&report["step"], "settling_ms") < 40.0, "{report}");
        number(&report["step"], "overshoot_percent")
    };
    let (low, high) = (overshoot("0.6"), overshoot("0.85"));
    assert!(
        high > low + 3.0,
        "set-point weights 0.6 and 0.85: {low} %, {high} %"
    );
}

#[test]
fn a_controller_file_is_checked_as_it_stands_and_written_for_another_delay() {
    let folder = tempfile::tempdir().unwrap();
    let here = folder.path();
    for law in ["pi", "lead", "lqg", "mpc"] {
        let designed = succeed(
            here,
            &format!("design --delay 2.5ms --controller {law} --out {law}.toml --json"),
        )
        .json();
        let checked = succeed(here, &format!("design --controller {law}.toml --json")).json();
        for key in ["ms", "mt", "pm_deg", "predicted_rms_nm", "delay_ms"] {
            assert_eq!(number(&checked, key), number(&designed, key), "{law} {key}");
        }
    }
    // What is written in the file is what is judged: less weight on the effort holds better with less margin.
    let text = std::fs::read_to_string(here.join("lqg.toml")).unwrap();
    std::fs::write(
        here.join("bold.toml"),
        text.replace("effort = 3.8", "effort = 0.3"),
    )
    .unwrap();
    let figures = |line: &str| {
        let json = cellpos(here, line).json();
        (number(&json, "predicted_rms_nm"), number(&json, "ms"))
    };
    let (bold, own) = (
        figures("design --controller bold.toml --json"),
        figures("design --controller lqg.toml --json"),
    );
    assert!(bold.0 < own.0 && bold.1 > own.1, "{bold:?} {own:?}");
    succeed(
        here,
        "design --controller bold.toml --delay 3.2ms --out slow.toml",
    );
    let slow = std::fs::read_to_string(here.join("slow.toml")).unwrap();
    assert!(
        slow.contains("delay_ms = 3.2") && slow.contains("effort = 0.3"),
        "{slow}"
    );
    let refused = cellpos(here, "design --controller bold.toml --kp 0.4 --ki 10");
    assert_eq!(refused.code, Some(2));
    assert!(
        refused.err.contains("in controller.toml already"),
        "{}",
        refused.err
    );
}

#[test]
fn a_controller_for_a_rig_has_the_limits_of_the_rig() {
    let folder = tempfile::tempdir().unwrap();
    let rig = "[limits]\nlow = \"2um\"\nhigh = \"38um\"\nslew = \"20um/ms\"\npark = \"20um\"\n";
    std::fs::write(folder.path().join("rig.toml"), rig).unwrap();
    succeed(folder.path(), "design --rig rig.toml --out c.toml");
    let written = std::fs::read_to_string(folder.path().join("c.toml")).unwrap();
    let limits = "[limits]\nlow_um = 2.0\nhigh_um = 38.0\nslew_um_per_s = 20000.0\npark_um = 20.0";
    assert!(written.contains(limits), "{written}");
}

#[test]
fn without_a_law_it_designs_that_of_a_run_and_the_gains_beside_it_are_made_for_the_plant() {
    let folder = tempfile::tempdir().unwrap();
    let here = folder.path();
    std::fs::write(
        here.join("rig.toml"),
        "[actuator]\nkind = \"emulated-pressure\"\n",
    )
    .unwrap();
    let file = |name: &str| -> toml::Table {
        let text = std::fs::read_to_string(here.join(name)).unwrap();
        text.parse().unwrap()
    };
    succeed(here, "design --rig rig.toml --out c.toml");
    succeed(here, "design --rig rig.toml --controller pi --out pi.toml");
    succeed(
        here,
        "design --rig rig.toml --controller mpc --out mpc.toml",
    );
    assert_eq!(file("c.toml")["controller"].as_str(), Some("lqg"));
    assert_eq!(file("mpc.toml")["controller"].as_str(), Some("mpc"));
    for name in ["c.toml", "mpc.toml"] {
        for key in ["kp_um_per_um", "ki_per_s"] {
            assert_eq!(
                file(name)["pi"][key],
                file("pi.toml")["pi"][key],
                "{name}: {key}"
            );
        }
    }
}

#[test]
fn a_controller_file_without_dither_is_a_loop_that_does_not_adapt_and_that_is_said() {
    let folder = tempfile::tempdir().unwrap();
    succeed(
        folder.path(),
        "design --controller lqg --out controller.toml",
    );
    let path = folder.path().join("controller.toml");
    let text = std::fs::read_to_string(&path).unwrap();
    let text = text.replace("[estimator]", "[estimator]\ndither_percent = 0.0");
    std::fs::write(&path, text).unwrap();
    let line = "track --target 0um --clock virtual --controller controller.toml --duration 1s --no-record --json";
    let ran = succeed(folder.path(), line);
    assert!(ran.err.contains("dither_percent = 0"), "{}", ran.err);
    assert!(ran.json()["adaptation"].is_null(), "{}", ran.json());
}
