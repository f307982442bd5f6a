//! Records of plants that are not this rig's, in chains of commands, as somebody uses them who has read `--help`.

use crate::script_runs::cellpos;
use serde_json::Value;
use std::fmt::Write as _;
use std::path::Path;

fn done(folder: &Path, args: &[&str]) -> String {
    let (code, out, err) = cellpos(folder, args);
    assert_eq!(code, Some(0), "{args:?}\n{out}\n{err}");
    out
}

/// Numbers between -1 and 1 that look like chance and are always the same.
fn chance(k: usize) -> f64 {
    let x = (k as f64 * 12.9898 + 4.1).sin() * 43_758.545_3;
    2.0 * (x - x.floor()) - 1.0
}

/// Power steps of half a minute, the whole twice, into a heater with a lag of 40 s, 6 s late; its thermometer is noisy.
fn heater(rows: usize) -> (Vec<f64>, Vec<f64>) {
    let power = |k: usize| 30.0 + 25.0 * chance(k % (rows / 2) / 15);
    let mut warm = 31.0;
    let temperature = (0..rows).map(|k| {
        let seen = warm + 0.02 * chance(9_000 + k) + 0.02 * chance(70_000 + k);
        for i in 0..100 {
            let at = (k as f64 + f64::from(i) / 100.0 - 3.0).max(0.0);
            warm += 0.02 * (20.0 + 0.4 * power(at.floor() as usize) - warm) / 40.0;
        }
        seen
    });
    let output = temperature.collect();
    ((0..rows).map(power).collect(), output)
}

/// As a logger in Germany writes it.
fn german((power, temperature): &(Vec<f64>, Vec<f64>)) -> String {
    let mut text = "Zeit [min];Leistung [W];Temperatur [\u{b0}C]\n".to_owned();
    for (k, (u, y)) in power.iter().zip(temperature).enumerate() {
        let row = format!("{:.6};{u:.4};{y:.4}", 2.0 * k as f64 / 60.0);
        writeln!(text, "{}", row.replace('.', ",")).unwrap();
    }
    text
}

/// The columns of that file, as options.
const COLUMNS: [&str; 4] = [
    "--input-column",
    "Leistung",
    "--output-column",
    "Temperatur",
];

/// A folder with that file, `heater.csv`.
fn with_heater(rows: usize) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("heater.csv"), german(&heater(rows))).unwrap();
    folder
}

#[test]
fn a_heater_goes_from_its_logger_through_identify_simulate_and_reconcile_and_back() {
    let folder = with_heater(900);
    let here = folder.path();
    let with = |first: &[&'static str], last: &[&'static str]| [first, &COLUMNS[..], last].concat();

    let base = [
        "identify",
        "--data",
        "heater.csv",
        "--base",
        "order=1,delay",
    ];
    let said = done(here, &with(&base, &["--json", "--out", "base.toml"]));
    let base: Value = serde_json::from_str(&said).unwrap();
    let base = &base["base"];
    let number = |key: &str| base[key].as_f64().unwrap();
    assert!((number("delay_ms") / 6000.0 - 1.0).abs() < 0.02, "{base}");
    let lag_s = 1.0 / base["den"][1].as_f64().unwrap();
    assert!((lag_s / 40.0 - 1.0).abs() < 0.01, "{base}");

    // The simulated record has the user's names, and lies where the measured one does.
    let simulate = ["simulate", "--model", "base.toml", "--input", "heater.csv"];
    done(here, &with(&simulate, &["--out", "simulated.csv"]));
    let text = std::fs::read_to_string(here.join("simulated.csv")).unwrap();
    assert!(
        text.starts_with("time_s,Leistung,Temperatur\n"),
        "{text:.60}"
    );
    let simulated: Vec<f64> = (text.lines().skip(1))
        .map(|line| line.rsplit(',').next().unwrap().parse().unwrap())
        .collect();
    let measured = heater(900).1;
    let off = (measured.iter().zip(&simulated).skip(150))
        .map(|(m, s)| (m - s).abs())
        .fold(0.0, f64::max);
    assert!(off < 0.3, "{off}");

    // Nothing is missing, whether the base comes from a file or from its form.
    for base in [["--model", "base.toml"], ["--base", "order=1,delay"]] {
        let reconcile = ["reconcile", "--data", "heater.csv", base[0], base[1]];
        let said = done(
            here,
            &with(&reconcile, &["--out", "augmented.toml", "--force"]),
        );
        assert!(
            said.contains("verdict: nothing-missing"),
            "{base:?}\n{said}"
        );
        assert!(!said.contains(" um"), "{said}");
    }
    // The other commands read the files of reconcile.
    let again = [
        "simulate",
        "--model",
        "augmented.toml",
        "--input",
        "heater.csv",
    ];
    done(here, &with(&again, &["--out", "again.csv"]));
    let again = std::fs::read_to_string(here.join("again.csv")).unwrap();
    assert_eq!(again.lines().count(), 901);
    let once_more = [
        "reconcile",
        "--data",
        "simulated.csv",
        "--model",
        "augmented.toml",
    ];
    let said = done(here, &with(&once_more, &[]));
    assert!(!said.contains("named"), "{said}");
}

#[test]
fn a_base_that_is_a_little_off_is_fitted_again_and_no_effect_is_made_of_it() {
    let folder = with_heater(900);
    let here = folder.path();
    let identify = [
        "identify",
        "--data",
        "heater.csv",
        "--base",
        "order=1,delay",
    ];
    done(
        here,
        &[&identify[..], &COLUMNS, &["--out", "base.toml"]].concat(),
    );
    let mut model = cellpos_plant::Model::load_file(&here.join("base.toml")).unwrap();
    let (num, den) = (model.plant.num()[0], model.plant.den()[1]);
    model.plant =
        cellpos_plant::TransferFunction::new(vec![1.06 * num], vec![1.0, 1.1 * den]).unwrap();
    std::fs::write(here.join("off.toml"), model.to_toml_string()).unwrap();
    let reconcile = ["reconcile", "--data", "heater.csv", "--model", "off.toml"];
    let said = done(here, &[&reconcile[..], &COLUMNS].concat());
    assert!(
        !said.contains("verdict: named") && !said.contains("verdict: ambiguous"),
        "{said}"
    );
}

#[test]
fn what_cannot_be_read_says_what_would_be_right() {
    let folder = with_heater(200);
    let here = folder.path();
    let fails = |args: &[&str], says: &[&str]| {
        let (code, out, err) = cellpos(here, args);
        assert_eq!(code, Some(2), "{args:?}\n{out}\n{err}");
        let err = err.split_whitespace().collect::<Vec<_>>().join(" ");
        for words in says {
            assert!(err.contains(words), "{args:?}: {words:?} is not in {err}");
        }
    };
    let named = [
        "identify",
        "--data",
        "heater.csv",
        "--input",
        "Power",
        "--output",
        "Temperatur",
    ];
    fails(&named, &["Leistung [W]", "number from 1"]);
    let form = [
        "--input",
        "Leistung",
        "--output",
        "Temperatur",
        "--base",
        "order=2,dead",
    ];
    fails(
        &[&["identify", "--data", "heater.csv"][..], &form].concat(),
        &["order=2,delay"],
    );
    let both = [
        "reconcile",
        "--data",
        "heater.csv",
        "--model",
        "eq6",
        "--base",
        "order=1",
    ];
    fails(&both, &["--model"]);
}

/// A fan: its speed varies with the square of the voltage, with a lag of half a second. Levels, all twice.
fn fan(rows: usize) -> String {
    let volts = |k: usize| 5.5 + 4.5 * chance(k % (rows / 2) / 40);
    let mut rpm = 900.0;
    let mut text = "time_s,U [V],n [rpm]\n".to_owned();
    for k in 0..rows {
        let seen = rpm + 3.0 * chance(11_000 + k) + 3.0 * chance(90_000 + k);
        writeln!(text, "{:.2},{:.4},{seen:.2}", 0.05 * k as f64, volts(k)).unwrap();
        let target = 30.0 * volts(k) * volts(k);
        rpm = target + (rpm - target) * (-0.1f64).exp();
    }
    text
}

#[test]
#[ignore = "nightly: 4 s of a debug build; the fast ones have a heater, and an effect of one's own"]
fn a_fan_whose_speed_goes_with_the_square_gets_no_name_and_then_its_own() {
    let folder = tempfile::tempdir().unwrap();
    let here = folder.path();
    std::fs::write(here.join("fan.csv"), fan(1600)).unwrap();
    let args = [
        "reconcile",
        "--base",
        "order=1",
        "--data",
        "fan.csv",
        "--input",
        "U",
        "--output",
        "n",
    ];
    let said = done(
        here,
        &[&args[..], &["--out", "fan.toml", "--json"]].concat(),
    );
    let found: Value = serde_json::from_str(&said).unwrap();
    assert_eq!(found["verdict"], "unknown", "{found}");
    let formula = found["hypothesis"]["formula"].as_str().unwrap();
    assert!(formula.contains("[1/V] d^2"), "{formula}");
    // Its proposal, run again unchanged, gives a name.
    let again = [
        &args[..],
        &["--effects", "fan.effects.toml", "--max-effects", "1"],
        &["--out", "named.toml", "--json"],
    ];
    let said = done(here, &again.concat());
    let found: Value = serde_json::from_str(&said).unwrap();
    assert_eq!(found["verdict"], "named", "{found}");
    let c1 = &found["effects"][0]["parameters"]["c1"];
    assert_eq!(c1["unit"], "1/V");
    let low = c1["ci95"][0].as_f64().unwrap();
    assert!(low > 0.05, "as uncertain as that it is no number: {c1}");
}
