//! The JSON objects of the commands.

use super::{kept, misfits, write, writes};
use crate::common::{cellpos, succeed};
use serde_json::{Map, Value, json};
use std::path::Path;

/// Tables with keys of the user's or of the rig's: versions, configurations, provenance.
const OPEN: [&str; 7] = [
    "parameters",
    "config",
    "versions",
    "intervals",
    "provenance",
    "data",
    "inputs",
];

/// The schema of one value.
fn infer(value: &Value, key: &str) -> Value {
    match value {
        Value::Null => of_types(&["null".to_owned()]),
        Value::Bool(_) => json!({ "type": ["boolean"] }),
        Value::Number(_) => json!({ "type": ["number"] }),
        Value::String(_) => json!({ "type": ["string"] }),
        Value::Array(items) => {
            let all = items.iter().map(|item| infer(item, key));
            match all.reduce(|a, b| merged(&a, &b)) {
                Some(items) => json!({ "type": ["array"], "items": items }),
                None => json!({ "type": ["array"] }),
            }
        }
        Value::Object(_) if OPEN.contains(&key) => json!({ "type": ["object"] }),
        Value::Object(object) => {
            let properties: Map<String, Value> = object
                .iter()
                .map(|(key, value)| (key.clone(), infer(value, key)))
                .collect();
            let required: Vec<&String> = object.keys().collect();
            json!({ "type": ["object"], "properties": properties, "required": required })
        }
    }
}

fn words(schema: &Value, key: &str) -> Vec<String> {
    let list = schema[key].as_array().into_iter().flatten();
    list.filter_map(Value::as_str).map(str::to_owned).collect()
}

/// A schema of these types. Of a value that was null in every run it is not known what else it may be: it is left open.
fn of_types(types: &[String]) -> Value {
    if types == ["null"] {
        json!({ "description": "null in the runs that this was made from, and open" })
    } else {
        json!({ "type": types })
    }
}

/// The types of a schema that [`of_types`] made.
fn types(schema: &Value) -> Vec<String> {
    let types = words(schema, "type");
    if types.is_empty() {
        vec!["null".to_owned()]
    } else {
        types
    }
}

/// What both schemas allow.
fn merged(a: &Value, b: &Value) -> Value {
    let mut both = types(a);
    both.extend(types(b));
    both.sort();
    both.dedup();
    let mut out = of_types(&both);
    match (a.get("items"), b.get("items")) {
        (Some(a), Some(b)) => out["items"] = merged(a, b),
        (Some(one), None) | (None, Some(one)) => out["items"] = one.clone(),
        (None, None) => {}
    }
    match (a["properties"].as_object(), b["properties"].as_object()) {
        (Some(first), Some(second)) => {
            let mut all = first.clone();
            for (key, schema) in second {
                let both = all
                    .get(key)
                    .map_or_else(|| schema.clone(), |known| merged(known, schema));
                all.insert(key.clone(), both);
            }
            let others = words(b, "required");
            let required: Vec<String> = words(a, "required")
                .into_iter()
                .filter(|key| others.contains(key))
                .collect();
            out["properties"] = all.into();
            out["required"] = json!(required);
        }
        (Some(_), None) | (None, Some(_)) => {
            let one = if a.get("properties").is_some() { a } else { b };
            out["properties"] = one["properties"].clone();
            out["required"] = one["required"].clone();
        }
        (None, None) => {}
    }
    out
}

/// Holds an object against its schema.
pub(crate) fn hold(line: &str, object: &Value) {
    let name = object["schema"]
        .as_str()
        .unwrap_or_else(|| panic!("{line}: no schema"));
    assert!(object["version"].is_u64(), "{line}: no version");
    if writes() {
        let mut schema = match kept(name) {
            Some(kept) => merged(&kept, &infer(object, "")),
            None => infer(object, ""),
        };
        schema["$schema"] = json!("http://json-schema.org/draft-07/schema#");
        schema["title"] = json!(name);
        write(name, &schema);
    }
    let schema = kept(name).unwrap_or_else(|| panic!("docs/schemas has no {name}.json"));
    let mut found = Vec::new();
    misfits(&schema, object, name, &mut found);
    assert!(found.is_empty(), "{line}\n{}", found.join("\n"));
}

fn folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let examples = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples");
    for name in ["rig.toml", "model.toml", "cell.toml"] {
        std::fs::copy(examples.join(name), folder.path().join(name)).unwrap();
    }
    let wave = "[[step]]\ndo = \"sine\"\namplitude = \"1um\"\nfrequency = \"20Hz\"\ncycles = 40\n";
    std::fs::write(folder.path().join("wave.toml"), wave).unwrap();
    let passages = "[[step]]\ndo = \"repeat\"\ntimes = 12\n[[step.step]]\ndo = \"move\"\nto = \"8um\"\nduration = \"200ms\"\n\
                    [[step.step]]\ndo = \"hold\"\nduration = \"300ms\"\n[[step.step]]\ndo = \"move\"\nto = \"0um\"\nduration = \"200ms\"\n\
                    [[step.step]]\ndo = \"hold\"\nduration = \"300ms\"\n";
    std::fs::write(folder.path().join("passages.toml"), passages).unwrap();
    let wild = "[[step]]\ndo = \"move\"\nto = \"900um\"\nduration = \"2ms\"\n";
    std::fs::write(folder.path().join("wild.toml"), wild).unwrap();
    let emulated = "[actuator]\nkind = \"emulated\"\n[camera]\nkind = \"emulated\"\n";
    std::fs::write(folder.path().join("emulated.toml"), emulated).unwrap();
    // A bead that goes the other way: arming refuses it.
    let plant = "working_point_um = 20.0\n[plant]\nnum = [-400.0]\nden = [1.0, 0.0]\n";
    std::fs::write(folder.path().join("backwards-plant.toml"), plant).unwrap();
    let backwards = "[emulator]\nmodel = \"backwards-plant.toml\"\n";
    std::fs::write(folder.path().join("backwards.toml"), backwards).unwrap();
    folder
}

/// The result of a replay that does not come out the same.
fn replay_of_another_controller(at: &Path) -> Value {
    let runs = std::fs::read_dir(at.join("runs")).unwrap();
    let hold = runs
        .map(|run| run.unwrap().path())
        .find(|run| run.to_str().unwrap().ends_with("-hold"))
        .unwrap();
    let copy = at.join("runs/20200101T000000Z-changed");
    std::fs::create_dir(&copy).unwrap();
    std::fs::copy(hold.join("ticks.arrow"), copy.join("ticks.arrow")).unwrap();
    let meta = std::fs::read_to_string(hold.join("run.toml")).unwrap();
    let mut meta: toml::Table = meta.parse().unwrap();
    meta["controller"]["pi"]["kp_um_per_um"] = toml::Value::Float(0.1);
    meta["versions"]["cellpos"] = toml::Value::String("0.0.9".into());
    std::fs::write(copy.join("run.toml"), meta.to_string()).unwrap();
    let ran = cellpos(at, "replay latest-changed --json");
    assert_eq!(ran.code, Some(1), "{}", ran.err);
    let said = ran.json();
    assert!(
        said["identical"].as_u64() < said["ticks"].as_u64(),
        "{said}"
    );
    said
}

#[test]
fn the_objects_of_quick_commands_fit_their_schemas() {
    let folder = folder();
    let at = folder.path();
    for line in [
        "track --target 0um --controller pi --duration 4s --clock virtual --frames off --name hold",
        "track --target 0um --sine 2um@20Hz --learn --controller mpc --duration 3s --clock virtual --frames off --name sine",
        "run wave.toml --clock virtual --frames off --name wave",
        "run wave.toml --cells 2 --clock virtual --frames off",
        "run passages.toml --rig cell.toml --cells 2 --clock virtual --frames off",
        "report latest-hold",
        "report latest-wave",
        "report latest-hold latest-wave --out comparison.html",
        "export latest-wave --out wave.csv",
        "replay latest-hold",
        "bundle latest-hold --out packed",
        "bundle --verify packed",
        "check wave.toml",
        "design --model eq6",
        "design --model eq6 --controller pi",
        "design --model eq6 --controller mpc",
        "design --model eq6 --controller lead",
        "simulate --model eq6 --input latest-hold --out simulated.csv",
        "rig check rig.toml",
        "board --rig emulated.toml --pings 50",
        "jog --rig emulated.toml --to 20.2um",
        "camera",
        "camera --rig emulated.toml --snapshot seen.png",
        "generate --out share",
    ] {
        hold(line, &succeed(at, &format!("{line} --json")).json());
    }
    hold(
        "replay of a run that another version recorded with other gains",
        &replay_of_another_controller(at),
    );
    // An error is an object, too. Broken limits and an unfit machine are results.
    for (line, code) in [
        ("track --target 900um", 2),
        ("check wild.toml", 1),
        (
            "track --target 0um --duration 2s --clock virtual --frames off --rig backwards.toml",
            1,
        ),
        (
            "run wave.toml --clock virtual --frames off --rig backwards.toml",
            1,
        ),
        ("no-such-command", 2),
    ] {
        let ran = cellpos(at, &format!("{line} --json"));
        assert_eq!(ran.code, Some(code), "{line}: {}", ran.err);
        hold(line, &ran.json());
    }
    let ran = cellpos(at, "doctor --for 100ms --why --json");
    assert!(matches!(ran.code, Some(0 | 1)));
    hold("doctor", &ran.json());
}

#[test]
#[ignore = "long: run with --release -- --include-ignored"]
fn the_objects_of_slow_commands_fit_their_schemas() {
    let folder = folder();
    let at = folder.path();
    succeed(
        at,
        "track --target 0um --sine 3um@10Hz --duration 6s --clock virtual --frames off --name sine",
    );
    succeed(
        at,
        "track --target 0um --duration 6s --clock virtual --frames off --seed 2 --name hold",
    );
    for line in [
        "identify --clock virtual --seed 3 --frames off --out fitted.toml",
        "reconcile --model eq6 --data latest-sine latest-hold",
        "circle --frames off --effort 0.3 --duration 3s",
        "paper",
        "camera --duration 1s",
        "calibrate --rig emulated.toml --pixel 0.1um --pairs 20 --out calibration.toml",
    ] {
        let ran = cellpos(at, &format!("{line} --json"));
        assert!(matches!(ran.code, Some(0 | 1)), "{line}: {}", ran.err);
        hold(line, &ran.json());
    }
}
