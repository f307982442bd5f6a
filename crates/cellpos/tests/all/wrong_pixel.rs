//! A wrong calibration is reported: rehearsed on the emulated rig, whose pixels are 0.1 um.

use serde_json::Value;
use std::process::Command;

/// A held bead with a pixel size in rig.toml: the JSON, and what was said meanwhile.
fn hold(pixel: &str) -> (Value, String) {
    let folder = tempfile::tempdir().unwrap();
    let rig = format!("[calibration]\npixel = \"{pixel}\"\norigin_px = 127.5\nsign = 1.0\n");
    std::fs::write(folder.path().join("rig.toml"), rig).unwrap();
    let out = Command::new(env!("CARGO_BIN_EXE_cellpos"))
        .args("track --target 0um --rig rig.toml --duration 1500ms --clock virtual".split(' '))
        .args(["--no-record", "--json"])
        .current_dir(folder.path())
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&out.stderr).into_owned();
    assert!(out.status.success(), "{said}");
    (serde_json::from_slice(&out.stdout).unwrap(), said)
}

/// The warning about the gain, if there is one.
fn warning(result: &Value) -> Option<&str> {
    let warnings = result["warnings"].as_array().expect("a list");
    warnings
        .iter()
        .filter_map(Value::as_str)
        .find(|text| text.contains("pixel size"))
}

#[test]
fn a_pixel_size_wrong_by_a_factor_is_told_with_the_one_that_would_be_right() {
    for (pixel, stated) in [("150nm", 0.15), ("0.0667um", 0.0667)] {
        let (result, said) = hold(pixel);
        let text = warning(&result).unwrap_or_else(|| panic!("{pixel}: {result}"));
        let (_, behind) = text.split_once("; ").expect("the right one");
        let right: f64 = behind.split(' ').next().unwrap().parse().expect("a number");
        // As good as one pulse against Brownian motion.
        assert!((right / 0.1 - 1.0).abs() < 0.15, "{text}");
        assert!(text.contains(&format!("pixel_um = {stated}")), "{text}");
        // At once, and not only when the run is over.
        assert!(
            said.contains("WARNING: ") && said.contains("pixel size"),
            "{said}"
        );
    }
}

#[test]
fn a_right_pixel_size_is_not_doubted() {
    let (result, said) = hold("100nm");
    assert_eq!(warning(&result), None);
    assert!(!said.contains("pixel size"), "{said}");
}
