//! The column `default` of docs/rig-toml.md is what the types take for a key that is left out.

use crate::rig_keys::page;
use cellpos_session::RigFile;
use std::collections::{BTreeMap, BTreeSet};
use toml::Value;

/// Each table of each kind with the keys that it cannot do without, and no other.
const LEAST: [&str; 13] = [
    "",
    "[actuator]\nkind = \"serial\"\nport = \"p\"\n",
    "[actuator]\nkind = \"program\"\nsocket = \"p\"\n",
    "[actuator]\nkind = \"emulated-pressure\"\n",
    "[camera]\nkind = \"socket\"\nsocket = \"p\"\n",
    "[camera]\nkind = \"industrial\"\naddress = \"p\"\n",
    "[partner]\nkind = \"emulated-pressure\"\n",
    "[calibration]\npixel_um = 0.1\norigin_px = 0.0\nsign = 1\n",
    "[tracking]\n[cell]\n[emulator.cell]\n",
    "[vision]\nwindow_px = 21\nprofile = { kind = \"ring\", edge_px = 5.0 }\n",
    "[vision]\nwindow_px = 21\nprofile = { kind = \"gaussian\", sigma_px = 5.0 }\n",
    "[vision]\nwindow_px = 21\nprofile = { kind = \"ring\", edge_px = 5.0 }\n[vision.learning]\n",
    "[vision]\nwindow_px = 21\nprofile = { kind = \"ring\", edge_px = 5.0 }\n\
     noise = { kind = \"known\", read_sd_grey = 1.0, shot_grey_per_electron = 1.0, black_level_grey = 0.0 }\n",
];

type Values = BTreeMap<String, BTreeSet<String>>;

/// The values below a key, as the page writes them.
fn gather(at: &str, value: &Value, all: &mut Values) {
    let text = match value {
        Value::Table(table) => {
            for (key, value) in table {
                let whole = match at {
                    "" => key.clone(),
                    at => format!("{at}.{key}"),
                };
                gather(&whole, value, all);
            }
            return;
        }
        Value::Float(number) => number.to_string(),
        Value::String(text) => format!("`{text}`"),
        Value::Boolean(yes) => format!("`{yes}`"),
        other => other.to_string(),
    };
    all.entry(at.to_owned()).or_default().insert(text);
}

fn of_file(text: &str) -> Values {
    let file: RigFile = toml::from_str(text).unwrap_or_else(|error| panic!("{text}: {error}"));
    let mut all = Values::new();
    gather("", &Value::try_from(&file).expect("a table"), &mut all);
    all
}

/// What the types fill in, and which keys they do not do without.
fn defaults() -> (Values, BTreeSet<String>) {
    let (mut filled, mut needed) = (Values::new(), BTreeSet::new());
    let values = "0.0, ".repeat(32);
    let table = format!(
        "[vision]\nwindow_px = 21\nprofile = {{ kind = \"table\", radius_px = 5.0, knot_px = 1.0, values = [{values}] }}\n"
    );
    for text in LEAST.into_iter().chain([table.as_str()]) {
        let mut given = Values::new();
        gather(
            "",
            &text.parse::<toml::Table>().expect("TOML").into(),
            &mut given,
        );
        // Each key that is given is needed: without it the types refuse the rest.
        for key in given.keys() {
            let name = key.rsplit('.').next().unwrap_or(key);
            let without = text.replacen(&format!("{name} = "), "unknown_key = ", 1);
            assert!(toml::from_str::<RigFile>(&without).is_err(), "{key}");
        }
        for (key, values) in of_file(text) {
            if !given.contains_key(&key) {
                filled.entry(key).or_default().extend(values);
            }
        }
        needed.extend(given.into_keys());
    }
    // A real rig on a good day, where no key of it is given.
    let file = RigFile::default();
    let world = of_file("");
    let real = format!("{:?}", file.emulator.imperfections());
    let pairs = real.trim_end_matches([' ', '}']).split(['{', ',']);
    for (key, value) in pairs.filter_map(|pair| pair.trim().split_once(": ")) {
        let key = format!("emulator.{key}");
        assert!(!world.contains_key(&key), "{key}");
        let number: f64 = value.parse().expect("a number");
        filled.entry(key).or_default().insert(number.to_string());
    }
    (filled, needed)
}

#[test]
fn the_defaults_of_the_page_are_those_of_the_types() {
    // What the types leave open, and the program fills in.
    const OPEN: [&str; 4] = [
        "camera.latency_ms",
        "partner.emulated_gain",
        "partner.emulated_regulator_ms",
        "partner.emulated_compliance_ms",
    ];
    let (filled, needed) = defaults();
    let page = page();
    let (_, tables) = page.split_once("## rig.toml, every key").expect("tables");
    let mut wrong = vec![];
    for line in tables.lines().filter(|line| line.starts_with("| `")) {
        let cells: Vec<&str> = line.trim_matches('|').split('|').map(str::trim).collect();
        let [keys, default, _] = cells[..] else {
            panic!("{line}: three columns");
        };
        let keys: Vec<&str> = keys.split('`').skip(1).step_by(2).collect();
        let said: Vec<&str> = default.split(", ").collect();
        for (n, key) in keys.iter().enumerate() {
            let said = said.get(n).or(said.first().filter(|_| said.len() == 1));
            let said: BTreeSet<String> = (said.iter())
                .flat_map(|text| text.split("; ").map(ToOwned::to_owned))
                .collect();
            let of_kinds = ["actuator.kind", "camera.kind"].contains(key);
            let expected = match filled.get(*key) {
                Some(values) => values.clone(),
                None if needed.contains(*key) && !of_kinds => BTreeSet::from(["needed".to_owned()]),
                None => BTreeSet::from(["\u{2013}".to_owned()]),
            };
            let table = needed
                .iter()
                .any(|below| below.starts_with(&format!("{key}.")));
            if said != expected && !OPEN.contains(key) && !table {
                wrong.push(format!("{key}: {said:?}, the types: {expected:?}"));
            }
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
}
