//! Hides one effect after the other in a rig in real time and lets `reconcile --collect` find it: names, values, times.
//!
//! ```text
//! cargo build --release --workspace --bins && target/release/box-table SEED [TEXT] [--emulated] [--runs] [--keep FOLDER]
//! ```
//!
//! Each row runs what a user would: `firmware-sim`, then `rig new`, `calibrate` and `reconcile --collect`. Zero flow wanders by 2 to
//! 20 nm RMS over 5 to 50 s and drifts by up to 5 nm/s, as the seed draws it; the camera's clock runs off and it stalls once. TEXT
//! keeps the rows whose name contains it. With `--emulated` the same rig is the emulator's, on the virtual clock: the machine may be
//! busy, and a seed fixes every bit. With `--runs` ordinary runs take the place of the collection: a hold, a sine and a fatigue
//! script. `--keep` writes records, reports and results there.

#![forbid(unsafe_code)]

use cellpos_plant::Model;
use cellpos_tests::programs::{RigInABox, cellpos, said};
use cellpos_tests::truth::Random;
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// What is hidden: its name in the table, options of the box, the id, its parameters.
struct Row {
    name: &'static str,
    options: &'static [&'static str],
    id: &'static str,
    parameters: &'static [(&'static str, f64)],
}

const fn row(
    name: &'static str,
    id: &'static str,
    parameters: &'static [(&'static str, f64)],
) -> Row {
    Row {
        name,
        options: &[],
        id,
        parameters,
    }
}

const ROWS: [Row; 19] = [
    row("nothing", "", &[]),
    row("gain", "gain-error", &[("factor", 0.8)]),
    row("lag", "driver-lag", &[("bandwidth_hz", 80.0)]),
    row("slew", "slew-limit", &[("rate_um_per_s", 1500.0)]),
    row(
        "saturation",
        "saturation",
        &[("low_um", 19.5), ("high_um", 20.5)],
    ),
    row(
        "hysteresis",
        "pzt-hysteresis",
        &[
            ("fraction", 0.2),
            ("beta_per_um", 2.0),
            ("gamma_per_um", 0.5),
        ],
    ),
    row("creep", "pzt-creep", &[("per_decade", 0.06)]),
    row(
        "resonance",
        "pzt-resonance",
        &[("frequency_hz", 250.0), ("damping", 0.1)],
    ),
    row("backlash", "backlash", &[("width_um", 0.05)]),
    row("stiffening", "stiffening", &[("per_um2", 0.3)]),
    row(
        "relaxation",
        "pdms-relaxation",
        &[("time_s", 0.2), ("strength", 0.2)],
    ),
    row("bubble", "bubble", &[("lag_s", 0.004)]),
    row("leak", "leak", &[("corner_rad_per_s", 1.0)]),
    row("adhesion", "wall-adhesion", &[("speed_um_per_s", 40.0)]),
    row("drift", "gain-drift", &[("per_s", 0.003)]),
    row("hum", "mains-hum", &[("hz", 50.0), ("um", 0.06)]),
    row(
        "pump",
        "pump-pulsation",
        &[("hz", 5.3), ("um", 0.1), ("second", 0.3)],
    ),
    row(
        "shake",
        "camera-shake",
        &[("frequency_hz", 30.0), ("damping", 0.05), ("share", 0.1)],
    ),
    Row {
        name: "drops",
        options: &["--drop-frames", "5%"],
        id: "frame-drops",
        parameters: &[("rate", 0.05)],
    },
];

/// A fatigue test of a bead: the same two moves again and again, at two amplitudes.
const CYCLES: &str = "
name = \"cycles\"
[[step]]
do = \"repeat\"
times = 12
[[step.step]]
do = \"move\"
to = \"4um\"
duration = \"50ms\"
[[step.step]]
do = \"hold\"
duration = \"300ms\"
[[step.step]]
do = \"move\"
to = \"0um\"
duration = \"50ms\"
[[step.step]]
do = \"hold\"
duration = \"300ms\"
[[step.step]]
do = \"move\"
to = \"-1um\"
duration = \"100ms\"
[[step.step]]
do = \"hold\"
duration = \"300ms\"
";

/// Always in the loop's way: commands and frames take their time.
const ALWAYS: &str = "time-delay";

fn main() {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let after = |name: &str| {
        let at = words.iter().position(|word| word == name)?;
        words.get(at + 1).cloned()
    };
    let given = |name: &str| words.iter().any(|word| word == name);
    let (emulated, runs) = (given("--emulated"), given("--runs"));
    let kept = after("--keep").map(PathBuf::from);
    let plain: Vec<&String> = (words.iter().enumerate())
        .filter(|&(at, word)| !word.starts_with("--") && (at == 0 || words[at - 1] != "--keep"))
        .map(|(_, word)| word)
        .collect();
    let seed: u64 = (plain.first().and_then(|word| word.parse().ok()))
        .expect("box-table SEED [TEXT] [--emulated] [--runs] [--keep FOLDER]");
    let text = plain.get(1).map_or("", |word| word.as_str());

    println!("| hidden | said | value, with 95 % | time |\n|---|---|---|---|");
    let (mut right, mut inside, mut all) = (0, (0, 0), 0);
    for row in ROWS.iter().filter(|row| row.name.contains(text)) {
        let began = Instant::now();
        let temporary = tempfile::tempdir().expect("a folder for the row");
        let folder = match &kept {
            Some(kept) => kept.join(row.name),
            None => temporary.path().to_path_buf(),
        };
        std::fs::create_dir_all(&folder).expect("the folder of the row can be made");
        let said = match found(row, seed, emulated, runs, &folder) {
            Ok(json) => Said::of(row, &json),
            Err(why) => Said::nothing(why),
        };
        let seconds = began.elapsed().as_secs_f64();
        println!(
            "| {} | {} | {} | {seconds:.0} s |",
            row.name, said.names, said.values
        );
        all += 1;
        right += usize::from(said.right);
        inside.0 += said.inside.0;
        inside.1 += said.inside.1;
    }
    println!(
        "\n{right} of {all} named alone, {} of {} intervals hold the value",
        inside.0, inside.1
    );
}

/// What a row came to.
struct Said {
    names: String,
    values: String,
    right: bool,
    /// Intervals that hold the value, and all.
    inside: (usize, usize),
}

impl Said {
    fn nothing(why: String) -> Self {
        Self {
            names: "refused".to_owned(),
            values: why,
            right: false,
            inside: (0, 0),
        }
    }

    fn of(row: &Row, json: &Value) -> Self {
        let none = Vec::new();
        let effects = json["effects"].as_array().unwrap_or(&none);
        let mut inside = (0, 0);
        let mut names = Vec::new();
        let mut values = Vec::new();
        for effect in effects {
            let id = effect["id"].as_str().unwrap_or("?");
            names.push(id);
            if id == ALWAYS {
                continue;
            }
            for (key, parameter) in effect["parameters"].as_object().into_iter().flatten() {
                let [value, low, high] = [
                    &parameter["value"],
                    &parameter["ci95"][0],
                    &parameter["ci95"][1],
                ]
                .map(|v| v.as_f64().unwrap_or(f64::NAN));
                let truth = (row.parameters.iter())
                    .find(|(known, _)| id == row.id && known == key)
                    .map(|&(_, truth)| truth);
                let mut words = format!("{key} {value:.5} ({low:.5} to {high:.5})");
                if let Some(truth) = truth {
                    let holds = (low..=high).contains(&truth);
                    inside.0 += usize::from(holds);
                    inside.1 += 1;
                    if !holds {
                        words += &format!(" **for {truth}**");
                    }
                }
                values.push(words);
            }
        }
        let wanted: Vec<&str> = [ALWAYS, row.id]
            .into_iter()
            .filter(|id| !id.is_empty())
            .collect();
        let right = names.len() == wanted.len() && wanted.iter().all(|id| names.contains(id));
        let verdict = json["verdict"].as_str().unwrap_or("?");
        Self {
            names: format!(
                "{}{verdict}: {}",
                if right { "" } else { "**not alone** " },
                names.join(", ")
            ),
            values: values.join("; "),
            right,
            inside,
        }
    }
}

/// The table `[emulator]` of a rig whose zero flow wanders as the seed draws it, and the model with the hidden effect beside it.
fn world(row: &Row, seed: u64, folder: &Path) -> String {
    let mut random = Random::new(seed);
    let wander_um = random.between(0.002, 0.02);
    let time_s = random.between(5.0, 50.0);
    let drift_um_per_s = 0.005 * (2.0 * random.uniform() - 1.0);
    let mut model = Model::eq6().to_toml_string();
    if !row.parameters.is_empty() && row.options.is_empty() {
        model += &format!("\n[[effects]]\nid = \"{}\"\n", row.id);
        for (key, value) in row.parameters {
            model += &format!("{key} = {value:?}\n");
        }
    }
    std::fs::write(folder.join("hidden.toml"), model).expect("the model can be written");
    format!(
        "[emulator]\nseed = {seed}\nideal = false\nmodel = \"hidden.toml\"\nzero_flow_wander_um = {wander_um}\n\
         zero_flow_wander_time_s = {time_s}\nzero_flow_drift_um_per_s = {drift_um_per_s}\n"
    )
}

/// Runs the chain of a row and returns what `reconcile --json` said.
fn found(row: &Row, seed: u64, emulated: bool, runs: bool, folder: &Path) -> Result<Value, String> {
    let run = |line: &str| {
        let output = cellpos(folder, line).output().expect("the program starts");
        if output.status.success() {
            return Ok(output.stdout);
        }
        Err(format!("{line}: {}", said(&output)))
    };
    let write = |name: &str, text: &[u8]| {
        std::fs::write(folder.join(name), text).expect("the row's folder can be written")
    };
    let world = world(row, seed, folder);
    let rig = if emulated {
        write("rig.toml", world.as_bytes());
        None
    } else {
        write("box.toml", world.as_bytes());
        let seed = seed.to_string();
        let mut options = vec!["--rig", "box.toml", "--seed", &seed, "--duration", "600s"];
        options.extend(["--stall-camera", "45s,30ms"]);
        options.extend(row.options);
        let rig = RigInABox::start(folder, &options);
        write(
            "rig.toml",
            &run("rig new --serial pzt --camera camera.sock")?,
        );
        run("calibrate --rig rig.toml --pixel 0.1um --out calibration.toml")?;
        Some(rig)
    };
    let source = if runs {
        write("cycles.toml", CYCLES.as_bytes());
        let emulator = " --clock virtual --frames off";
        let common = format!(
            "--rig rig.toml --model eq6{}",
            if emulated { emulator } else { "" }
        );
        for (number, line) in [
            "track --target 0um --duration 10s",
            "track --target 0um --sine 1um@7Hz --duration 15s",
            "run cycles.toml",
        ]
        .into_iter()
        .enumerate()
        {
            // Two emulated runs of one seed would have the same noise.
            let own = if emulated {
                format!(" --seed {}", 10 * seed + number as u64)
            } else {
                String::new()
            };
            run(&format!("{line} {common}{own}"))?;
        }
        "--data runs"
    } else {
        "--rig rig.toml --collect records"
    };
    let began = Instant::now();
    let ended = run(&format!(
        "reconcile --model eq6 {source} --out augmented.toml --report gap.html --json said.json"
    ));
    eprintln!(
        "{}: reconcile took {:.0} s",
        row.name,
        began.elapsed().as_secs_f64()
    );
    drop(rig);
    ended?;
    let json = std::fs::read(folder.join("said.json")).map_err(|error| error.to_string())?;
    serde_json::from_slice(&json).map_err(|error| error.to_string())
}
