//! The quantities of rig.toml that may be written with a unit (`park = "20um"`), and the lines of its keys.

use crate::{Failure, toml_file};
use cellpos_plant::quantities::{Quantity, bare};
use serde::de::DeserializeOwned;
use std::path::Path;

const fn q(table: &'static str, plain: &'static str, with_unit: &'static str) -> Quantity {
    Quantity::new(table, plain, with_unit)
}

/// The quantities of the host's own tables.
const OF_THE_HOST: [Quantity; 37] = [
    q("", "first_neutral", "first_neutral_um"),
    q("", "near", "near_um"),
    q("actuator", "watchdog", "watchdog_ms"),
    q("actuator", "period", "period_ms"),
    q("actuator", "regulator", "regulator_ms"),
    q("actuator", "compliance", "compliance_ms"),
    q("actuator", "hold_watchdog", "hold_watchdog_ms"),
    q("partner", "period", "period_ms"),
    q("partner", "low", "low_um"),
    q("partner", "high", "high_um"),
    q("partner", "slew", "slew_um_per_s"),
    q("partner", "park", "park_um"),
    q("partner", "lag", "lag_ms"),
    q("partner", "delay", "delay_ms"),
    q("partner", "mid", "mid_um"),
    q("partner", "watchdog", "watchdog_ms"),
    q("partner", "hold_watchdog", "hold_watchdog_ms"),
    q("partner", "emulated_regulator", "emulated_regulator_ms"),
    q("partner", "emulated_compliance", "emulated_compliance_ms"),
    q("camera", "rate", "rate_hz"),
    q("camera", "exposure", "exposure_us"),
    q("camera", "latency", "latency_ms"),
    q("calibration", "pixel", "pixel_um"),
    q("calibration", "tilt", "tilt_deg"),
    q("limits", "low", "low_um"),
    q("limits", "high", "high_um"),
    q("limits", "park", "park_um"),
    q("limits", "slew", "slew_um_per_s"),
    q("timing", "period", "period_us"),
    q("timing", "budget", "budget_us"),
    q("timing", "solver", "solver_us"),
    q("timing", "camera_delay", "camera_delay_ms"),
    q("timing", "oldest", "oldest_ms"),
    q("timing", "board_silence", "board_silence_ms"),
    q("tracking", "coast_limit", "coast_limit_s"),
    q("arming", "pulse", "pulse_um"),
    q("sample", "channel_width", "channel_width_um"),
];

/// All quantities of rig.toml: those of the host's tables, and of `[board]` and `[emulator]`.
pub fn quantities() -> impl Iterator<Item = Quantity> {
    OF_THE_HOST.into_iter().chain(cellpos_emulator::QUANTITIES)
}

/// Reads a file in which quantities may have units.
///
/// # Errors
/// The file cannot be read; a quantity without a unit, or with one of another kind.
pub fn read<T: DeserializeOwned>(path: &Path) -> Result<T, Failure> {
    let text = cellpos_table::read_text(path, 16 << 20).map_err(|error| {
        Failure::bad_input(
            format!("{}: {error}", path.display()),
            "give the path of a TOML file",
        )
    })?;
    let name = path.display().to_string();
    let known: Vec<Quantity> = quantities().collect();
    let text = bare(&text, &known).map_err(|error| {
        Failure::bad_input(
            format!("{name}:{}: {error}", error.line),
            format!("or write it bare: {} = ...", error.with_unit),
        )
    })?;
    toml_file::parse(&text, &name)
}

/// The line of a key in a file, counted from 1: in a table (empty: outside of tables), or at its first occurrence (`None`). A key
/// with a unit in its name also finds the quantity without it.
pub fn line_of(text: &str, table: Option<&str>, key: &str) -> Option<usize> {
    let plain = quantities()
        .find(|known| known.with_unit == key && table.is_none_or(|table| table == known.table))
        .map(|known| known.plain);
    let mut inside = "";
    for (at, line) in text.lines().enumerate() {
        let line = line.trim();
        if line.starts_with('[') {
            inside = line
                .trim_start_matches('[')
                .split(']')
                .next()
                .unwrap_or("")
                .trim();
            // A table written as a key of another table, or at the top.
            let (of, name) = inside.rsplit_once('.').unwrap_or(("", inside));
            if name == key && table.is_none_or(|table| table == of) {
                return Some(at + 1);
            }
            continue;
        }
        let name = line.split(['=', '#']).next().unwrap_or("").trim();
        let (of, name) = name.rsplit_once('.').unwrap_or((inside, name));
        if (name == key || Some(name) == plain) && table.is_none_or(|table| table == of) {
            return Some(at + 1);
        }
    }
    None
}

/// The line of the first key of a table, or of a table in it (`cell.rest_um`), that a message names.
pub(crate) fn line_named(text: &str, table: &str, message: &str) -> Option<usize> {
    let is_of_a_word = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '.';
    let words = message
        .split(|c| !is_of_a_word(c))
        .map(|word| word.trim_matches('.'));
    let mut keys = words.filter(|word| word.len() > 2);
    keys.find_map(|word| match word.rsplit_once('.') {
        Some((below, key)) => {
            let whole = if table.is_empty() {
                below.to_string()
            } else {
                format!("{table}.{below}")
            };
            line_of(text, Some(&whole), key)
        }
        None => line_of(text, Some(table), word),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_is_found_in_its_own_table_with_or_without_its_unit() {
        let text = "near = \"1um\"\n[emulator]\nrate_hz = 1.0\n[camera] # one\nkind = \"socket\"\n  rate = \"1kHz\" # of it\n\
                    [vision.profile]\nkind = \"ring\"\n";
        for (table, key, line) in [
            (Some(""), "near_um", Some(1)),
            (Some("emulator"), "rate_hz", Some(3)),
            (Some("camera"), "rate_hz", Some(6)),
            (Some(""), "camera", Some(4)),
            (Some("vision"), "profile", Some(7)),
            (Some("vision.profile"), "kind", Some(8)),
            (Some("limits"), "low_um", None),
            (None, "kind", Some(5)),
        ] {
            assert_eq!(line_of(text, table, key), line, "{table:?} {key}");
        }
        let message = "rig.toml: near_um = 99: must be in view";
        assert_eq!(line_named(text, "", message), Some(1));
        let text = "[emulator.cell]\ngain = 1.0\nrest = \"1m\"\n[[emulator.faults.event]]\nkind = \"x\"\nat = \"1s\"\n";
        let message = "`cell.rest_um` is 1000000, must be less. Or so.";
        assert_eq!(line_named(text, "emulator", message), Some(3));
        assert_eq!(
            line_of(text, Some("emulator.faults.event"), "at_s"),
            Some(6)
        );
    }

    #[test]
    fn a_quantity_of_another_kind_is_named_with_file_line_and_key() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("rig.toml");
        for (text, words) in [
            (
                "\n[limits]\npark = \"20ms\"\n",
                ["rig.toml:3", "park = \"20ms\"", "park_um"],
            ),
            (
                "[board]\nramp = \"1000\"\n",
                ["rig.toml:2", "ramp = \"1000\"", "ramp_um_per_s"],
            ),
        ] {
            std::fs::write(&path, text).expect("written");
            let error = read::<toml::Table>(&path).expect_err("refused");
            let text = format!("{error:?} {}", error.text());
            assert!(words.iter().all(|word| text.contains(word)), "{text}");
        }
    }
}
