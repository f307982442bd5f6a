//! `cellpos identify` and `cellpos paper` as a user runs them: through frames, on the virtual clock.

use crate::script_runs::{cellpos, json};
use serde_json::Value;
use std::path::Path;

#[test]
fn identify_through_frames_finds_eq6_its_delay_and_what_it_cannot_tell() {
    let folder = tempfile::tempdir().unwrap();
    let result = json(
        folder.path(),
        &[
            "identify",
            "--seed",
            "3",
            "--clock",
            "virtual",
            "--json",
            "--out",
            "model.toml",
            "--report",
            "report.html",
        ],
    );
    let parameter = |name: &str| &result["parameters"][name];
    let gain = parameter("gain_per_s");
    let truth = 428.13;
    assert!(
        (gain["value"].as_f64().unwrap() / truth - 1.0).abs() < 0.01,
        "{gain}"
    );
    let end = |i: usize| gain["ci95"][i].as_f64().unwrap();
    assert!(end(0) < truth && truth < end(1), "{gain}");
    assert!((parameter("delay_ms")["value"].as_f64().unwrap() - 2.0).abs() < 0.05);
    for name in ["far_zero_rad_per_s", "slow_pole_rad_per_s"] {
        assert_eq!(
            parameter(name)["verdict"],
            "not identifiable from this band"
        );
    }
    let lines = result["frequencies"].as_array().unwrap();
    assert_eq!(lines.len(), 10);
    for line in lines {
        let miss = |a: &str, b: &str| (line[a].as_f64().unwrap() - line[b].as_f64().unwrap()).abs();
        assert!(miss("gain_db", "eq6_gain_db") < 0.2, "{line}");
        assert!(miss("phase_deg", "eq6_phase_deg") < 1.0, "{line}");
    }
    // A good rig with a good model is warned of nothing.
    assert_eq!(result["warnings"].as_array().unwrap().len(), 0, "{result}");
    let model = cellpos_plant::Model::load_file(&folder.path().join("model.toml")).unwrap();
    assert!((model.plant.gain_db(cellpos_plant::Hertz(10.0)).0 - 16.26).abs() < 0.1);
    assert!(folder.path().join("report-figures/bode.svg").exists());
}

#[test]
fn a_model_with_a_literal_63_per_s_is_flagged_as_a_factor_of_two_pi() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(
        folder.path().join("eq5.toml"),
        "working_point_um = 20.0\n\n[plant]\nnum = [63.0]\nden = [1.0, 0.0]\n",
    )
    .unwrap();
    let result = json(
        folder.path(),
        &[
            "identify",
            "--model",
            "eq5.toml",
            "--frames",
            "off",
            "--frequency",
            "5Hz,20Hz,60Hz,150Hz",
            "--ideal",
            "--bootstrap",
            "0",
            "--led-edges",
            "0",
            "--json",
            "--out",
            "m.toml",
            "--report",
            "r.html",
        ],
    );
    let warnings = result["warnings"].as_array().unwrap();
    let flagged = |w: &Value| {
        let text = w.as_str().unwrap();
        text.contains("2 pi 63") && text.contains("396/s")
    };
    assert_eq!(
        warnings.iter().filter(|w| flagged(w)).count(),
        1,
        "{result}"
    );
}

#[test]
fn a_hysteretic_piezo_is_told_of_and_never_becomes_an_unstable_plant() {
    let folder = tempfile::tempdir().unwrap();
    let law = cellpos_plant::effects::bouc_wen(0.3, 0.9, 0.2);
    let model = cellpos_plant::Model::eq6().with_effect(law);
    std::fs::write(folder.path().join("piezo.toml"), model.to_toml_string()).unwrap();
    let line = "identify --model piezo.toml --seed 5 --frames off --bootstrap 0 --json --out m.toml --report r.html";
    let args: Vec<&str> = line.split(' ').collect();
    let result = json(folder.path(), &args);
    let warnings = result["warnings"].as_array().unwrap();
    let told = |part: &str| warnings.iter().any(|w| w.as_str().unwrap().contains(part));
    assert!(told("does not"), "{warnings:?}");
    let written = cellpos_plant::Model::load_file(&folder.path().join("m.toml")).unwrap();
    let poles = written.plant.poles();
    assert!(poles.iter().all(|p| p.re <= 1e-9), "{poles:?}");
}

#[test]
fn the_same_seed_gives_the_same_result_to_the_bit() {
    let folder = tempfile::tempdir().unwrap();
    let args = [
        "identify",
        "--seed",
        "11",
        "--frames",
        "off",
        "--bootstrap",
        "50",
        "--force",
        "--json",
        "--out",
        "m.toml",
        "--report",
        "r.html",
    ];
    assert_eq!(json(folder.path(), &args), json(folder.path(), &args));
}

#[test]
fn paper_reproduces_the_table_and_names_the_papers_errors() {
    let folder = tempfile::tempdir().unwrap();
    let result = json(
        folder.path(),
        &["paper", "--json", "--report", "paper.html"],
    );
    let table = result["table"].as_array().unwrap();
    for row in table {
        assert_eq!(row["holds"], true, "{row}");
    }
    let row = |key: &str| {
        table
            .iter()
            .find(|r| r["key"] == key)
            .unwrap_or_else(|| panic!("no row {key}"))
    };
    let ours = |key: &str| row(key)["ours"].as_f64().unwrap();
    for key in [
        "eq5",
        "a10",
        "r2",
        "fft_10hz",
        "fft_10hz_compensated",
        "aliases",
    ] {
        assert_eq!(row(key)["verdict"], "the paper is inconsistent", "{key}");
    }
    for key in ["far_zero", "slow_pole"] {
        assert_eq!(
            row(key)["verdict"],
            "not identifiable from 2-300 Hz",
            "{key}"
        );
    }
    assert!((ours("recorded_amplitude_averaged") - 0.858).abs() < 0.003);
    assert!((0.80..0.90).contains(&ours("recorded_amplitude_peaks")));
    assert!((ours("a10") + 24.8).abs() < 0.2);
    assert!((ours("delay") - 2.0).abs() < 0.05);
    let figures = [
        "fig4-traces",
        "fig5a-record",
        "fig5b-amplitude",
        "fig6-delay-test",
        "fig7-bode",
        "fig8-fit",
        "fig-a1-complex-plane",
    ];
    for figure in figures {
        for kind in ["svg", "csv"] {
            let path = folder.path().join(format!("paper-figures/{figure}.{kind}"));
            assert!(path.exists(), "{figure}.{kind}");
        }
    }
}

#[test]
fn a_measured_piezo_record_is_identified_by_column_numbers_and_its_harmonics_are_named() {
    let data = Path::new(env!("MEASURED_DATA")).join("piezo-picma/Model_Vi_Do.dat");
    let folder = tempfile::tempdir().unwrap();
    let path = data.display().to_string();
    let args = [
        "identify", "--data", &path, "--input", "1", "--output", "5", "--rate", "200Hz", "--hold",
        "none", "--json",
    ];
    let result = json(folder.path(), &args);
    let file = &result["files"][0];
    let line = &file["lines"][0];
    assert!((line["frequency_hz"].as_f64().unwrap() - 1.0).abs() < 0.01);
    assert!(
        (line["lag_ms"].as_f64().unwrap() - 33.0).abs() < 2.0,
        "{line}"
    );
    assert_eq!(file["harmonics_remain"], true);
    assert!(
        file["message"]
            .as_str()
            .unwrap()
            .contains("no linear model")
    );
}

#[test]
fn wrong_arguments_end_with_code_2_and_a_sentence() {
    let folder = tempfile::tempdir().unwrap();
    let args = [
        "identify", "--data", "x.csv", "--input", "1", "--output", "2", "--rate", "1kHz",
    ];
    let (code, _, err) = cellpos(folder.path(), &args);
    assert_eq!(code, Some(2), "{err}");
    assert!(err.contains("x.csv"), "{err}");
    let (code, _, err) = cellpos(folder.path(), &["identify", "--frequency", "600Hz"]);
    assert_eq!(code, Some(2), "{err}");
    assert!(err.contains("480Hz"), "{err}");
    let (code, _, err) = cellpos(folder.path(), &["identify", "--bead-amplitude", "8"]);
    assert_eq!(code, Some(2));
    assert!(err.contains("needs a unit"), "{err}");
}

/// Gain of a model at a frequency \[Hz\].
fn gain_at(model: &Value, hz: f64) -> f64 {
    let polynomial = |key: &str| {
        // Real and imaginary part of a polynomial in s = i w, by Horner's rule.
        let w = std::f64::consts::TAU * hz;
        let coefficients = model[key].as_array().unwrap();
        let value = coefficients.iter().fold((0.0, 0.0), |(re, im), c| {
            (c.as_f64().unwrap() - w * im, w * re)
        });
        f64::hypot(value.0, value.1)
    };
    polynomial("num") / polynomial("den")
}

#[test]
fn the_run_of_a_sweep_of_sines_in_closed_loop_tells_the_plant() {
    sweep_in_closed_loop(&["pi"]);
}

#[test]
#[ignore = "nightly: the other law; the fast one has the simpler"]
fn the_run_of_a_sweep_of_sines_tells_the_plant_under_a_law_with_a_model_too() {
    sweep_in_closed_loop(&["lqg"]);
}

fn sweep_in_closed_loop(laws: &[&str]) {
    let folder = tempfile::tempdir().unwrap();
    let script =
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/scripts/sine-sweep.toml");
    let script = script.to_str().unwrap();
    for &law in laws {
        #[rustfmt::skip]
        let ran = cellpos(folder.path(), &[
            "run", script, "--clock", "virtual", "--frames", "off", "--seed", "5", "--controller", law, "--name", law,
        ]);
        assert_eq!(ran.0, Some(0), "{}\n{}", ran.1, ran.2);
        let run = std::fs::read_dir(folder.path().join("runs"))
            .unwrap()
            .map(|run| run.unwrap().path())
            .find(|run| run.to_str().unwrap().ends_with(law))
            .unwrap();
        let result = json(
            folder.path(),
            &["identify", "--data", run.to_str().unwrap(), "--json"],
        );
        let model = &result["files"][0]["models"][0];
        // Eq. (6): 16.26 dB at 10 Hz, 1.67 at 50 Hz, -5.99 at 120 Hz.
        for (hz, db) in [(10.0, 16.26), (50.0, 1.67), (120.0, -5.99)] {
            let ratio = gain_at(model, hz) / 10f64.powf(db / 20.0);
            assert!(
                (ratio - 1.0).abs() < 0.1,
                "{law}, {hz} Hz: {ratio} of {model}"
            );
        }
    }
}
