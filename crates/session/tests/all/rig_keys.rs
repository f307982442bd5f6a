//! Every key that the types of rig.toml take is in docs/rig-toml.md, and the page names none that they do not take.
//!
//! The types name their keys: an unknown key is refused with the list of known ones, for each table and each `kind`.

use crate::rig_walk::all_below;
use cellpos_session::RigFile;
use cellpos_session::quantities::quantities;
use std::collections::BTreeSet;
use std::path::Path;

pub(crate) fn page() -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/rig-toml.md");
    std::fs::read_to_string(path).expect("docs/rig-toml.md")
}

/// The keys of the page's tables, from their first column.
fn documented() -> BTreeSet<String> {
    let page = page();
    let (_, tables) = page
        .split_once("## rig.toml, every key")
        .expect("the heading");
    let rows = tables.lines().filter(|line| line.starts_with("| `"));
    rows.flat_map(|line| {
        let keys = line.trim_matches('|').split('|').next().unwrap_or("");
        keys.split('`').skip(1).step_by(2).map(ToString::to_string)
    })
    .collect()
}

#[test]
fn every_key_of_the_types_is_in_the_page_and_the_page_names_no_other() {
    let mut all = BTreeSet::new();
    all_below("", &mut all);
    // Told in one line with its four coordinates.
    all.retain(|key| !key.starts_with("camera.region."));
    // The walk must have come to tables within tables and to choices.
    for key in [
        "emulator.faults.drop_rate",
        "vision.profile.edge_px",
        "camera.address",
        "tracking.certainty",
    ] {
        assert!(all.contains(key), "{key} was not found among {all:#?}");
    }
    // The kinds of a choice are listed with the choice.
    all.retain(|key| !matches!(key.as_str(), "vision.profile.kind" | "vision.noise.kind"));
    let documented = documented();
    let missing: Vec<_> = all.difference(&documented).collect();
    let unknown: Vec<_> = documented.difference(&all).collect();
    assert!(
        missing.is_empty() && unknown.is_empty(),
        "missing {missing:#?}, unknown {unknown:#?}"
    );
}

/// The keys that take a quantity with a unit, with their tables and the form of the quantity.
fn of_code() -> BTreeSet<(String, String)> {
    quantities()
        .map(|known| {
            let whole = match known.table {
                "" => known.with_unit.to_string(),
                table => format!("{table}.{}", known.with_unit),
            };
            (whole, known.plain.to_string())
        })
        .collect()
}

/// The page states the rule once; so it must hold for every quantity, with the endings that the page lists.
#[test]
fn a_quantity_with_its_unit_is_the_key_without_its_ending() {
    let page = page();
    for (key, plain) in of_code() {
        let name = key.rsplit('.').next().unwrap_or(&key);
        let ending = name.strip_prefix(&plain).expect("the same beginning");
        assert!(
            ending.starts_with('_') && page.contains(&format!("`{ending}`")),
            "{key}: {plain}, and docs/rig-toml.md has no ending `{ending}`"
        );
    }
}

#[test]
fn every_length_time_speed_and_frequency_may_have_its_unit() {
    let mut all = BTreeSet::new();
    all_below("", &mut all);
    let of_code: BTreeSet<String> = of_code().into_iter().map(|(key, _)| key).collect();
    let is_quantity = |key: &&String| {
        let units = ["_um", "_um_per_s", "_ms", "_us", "_s", "_hz", "_deg"];
        units.iter().any(|unit| key.ends_with(unit)) && !key.ends_with("_per_s")
            || key.ends_with("_um_per_s")
    };
    let without: Vec<&String> = all
        .iter()
        .filter(is_quantity)
        .filter(|key| !of_code.contains(*key))
        .collect();
    assert!(without.is_empty(), "{without:#?}");
    assert!(all.iter().filter(is_quantity).count() > 40);
}

#[test]
fn a_value_that_cannot_be_is_named_with_its_line() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("rig.toml");
    for (text, words) in [
        (
            "\n[limits]\nlow = \"0um\"\nhigh = \"40um\"\nslew_um_per_s = 1.0\npark = \"50um\"\n",
            ["rig.toml:6", "park_um"],
        ),
        (
            "[timing]\nperiod_us = 1000.0\noldest_ms = -1.0\n",
            ["rig.toml:3", "oldest_ms"],
        ),
        (
            "[emulator]\nseed = 1\nexposure = \"5ms\"\n",
            ["rig.toml:3", "exposure_ms"],
        ),
        (
            "[board]\nhigh = \"40um\"\npark = \"41um\"\n",
            ["rig.toml:3", "park_um"],
        ),
        (
            "[emulator]\nseed = 1\n[calibration]\npixel = \"0um\"\norigin_px = 1.0\nsign = 1.0\n",
            ["rig.toml:4", "pixel_um"],
        ),
    ] {
        std::fs::write(&path, text).expect("written");
        let error = RigFile::load(Some(&path)).expect_err("refused").text();
        assert!(words.iter().all(|word| error.contains(word)), "{error}");
    }
}

/// docs/real-time.md names the defaults of `[timing]` as "`key` (value)".
#[test]
fn the_page_of_times_names_the_defaults() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/real-time.md");
    let page = std::fs::read_to_string(path).expect("docs/real-time.md");
    let timing = toml::Table::try_from(RigFile::default().timing).expect("a table");
    let mut named = 0;
    let mut rest = page.as_str();
    while let Some((before, after)) = rest.split_once("` (") {
        rest = after;
        let key = before.rsplit('`').next().unwrap_or_default();
        let value = after.split(')').next().unwrap_or_default();
        let Some(default) = timing.get(key) else {
            continue;
        };
        let default = default
            .as_float()
            .or(default.as_integer().map(|n| n as f64));
        assert_eq!(value.parse().ok(), default, "docs/real-time.md: `{key}`");
        named += 1;
    }
    assert!(named >= 6, "only {named} defaults on docs/real-time.md");
}
