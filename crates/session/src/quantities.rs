//! Quantities with units in rig.toml (`park = "20um"`), beside bare numbers with the unit in the key (`park_um = 20.0`).
//!
//! The text is rewritten to bare numbers before it is read, line for line, so that every later message names the right line.

use crate::{Failure, toml_file};
use cellpos_units::{Hertz, Micrometers, MicrometersPerSecond, Seconds};
use serde::de::DeserializeOwned;
use std::ops::Range;
use std::path::Path;
use toml::de::{DeTable, DeValue};

/// The quantities that may be written with a unit: table (empty: none), key, and the key with its unit.
pub const QUANTITIES: [(&str, &str, &str); 20] = [
    ("", "first_neutral", "first_neutral_um"),
    ("", "near", "near_um"),
    ("actuator", "watchdog", "watchdog_ms"),
    ("actuator", "hold_watchdog", "hold_watchdog_ms"),
    ("camera", "rate", "rate_hz"),
    ("camera", "exposure", "exposure_us"),
    ("calibration", "pixel", "pixel_um"),
    ("limits", "low", "low_um"),
    ("limits", "high", "high_um"),
    ("limits", "park", "park_um"),
    ("limits", "slew", "slew_um_per_s"),
    ("timing", "period", "period_us"),
    ("timing", "budget", "budget_us"),
    ("timing", "solver", "solver_us"),
    ("timing", "camera_delay", "camera_delay_ms"),
    ("timing", "oldest", "oldest_ms"),
    ("timing", "board_silence", "board_silence_ms"),
    ("tracking", "coast_limit", "coast_limit_s"),
    ("arming", "pulse", "pulse_um"),
    ("sample", "channel_width", "channel_width_um"),
];

/// Reads a file in which quantities may have units.
///
/// # Errors
/// The file cannot be read; a quantity without a unit, or with one of another kind.
pub fn read<T: DeserializeOwned>(path: &Path) -> Result<T, Failure> {
    let text = std::fs::read_to_string(path).map_err(|error| {
        Failure::bad_input(
            format!("{}: {error}", path.display()),
            "give the path of a TOML file",
        )
    })?;
    let name = path.display().to_string();
    toml_file::parse(&bare(&text, &name)?, &name)
}

/// The line of a key in a file, counted from 1: of a table (empty: none), or wherever it stands first (`None`). A key with its
/// unit is found where the quantity is written without, too.
pub fn line_of(text: &str, table: Option<&str>, key: &str) -> Option<usize> {
    let plain = (QUANTITIES.iter())
        .find(|(of, _, with_unit)| *with_unit == key && table.is_none_or(|table| table == *of))
        .map(|(_, plain, _)| *plain);
    let mut inside = "";
    for (at, line) in text.lines().enumerate() {
        let line = line.trim();
        if let Some(header) = line.strip_prefix('[') {
            inside = header.split(']').next().unwrap_or("").trim();
            // A table that is a key of another one, or of none.
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

/// The line of the first key of a table that a message names.
pub(crate) fn line_named(text: &str, table: &str, message: &str) -> Option<usize> {
    let is_of_a_word = |c: char| c.is_ascii_alphanumeric() || c == '_';
    let words = message.split(|c| !is_of_a_word(c));
    let mut keys = words.filter(|word| word.len() > 2);
    keys.find_map(|key| line_of(text, Some(table), key))
}

/// The text with bare numbers.
fn bare(text: &str, name: &str) -> Result<String, Failure> {
    // What is no TOML is the reader's to say.
    let Ok(document) = DeTable::parse(text) else {
        return Ok(text.to_string());
    };
    let mut changes: Vec<(Range<usize>, String)> = Vec::new();
    let mut change = |table: &str, entries: &DeTable<'_>| -> Result<(), Failure> {
        for (key, value) in entries {
            let known = QUANTITIES
                .iter()
                .find(|(of, bare, _)| *of == table && *bare == key.get_ref().as_ref());
            if let (Some((_, _, with_unit)), DeValue::String(quantity)) = (known, value.get_ref()) {
                let number = number(with_unit, quantity).map_err(|problem| {
                    let line = 1 + text[..key.span().start].matches('\n').count();
                    Failure::bad_input(
                        format!("{name}:{line}: {} = {quantity:?}: {problem}", key.get_ref()),
                        format!("or write it bare: {with_unit} = ..."),
                    )
                })?;
                changes.push((key.span(), (*with_unit).to_string()));
                changes.push((value.span(), number));
            }
        }
        Ok(())
    };
    let root = document.get_ref();
    change("", root)?;
    for (key, value) in root {
        if let DeValue::Table(entries) = value.get_ref() {
            change(key.get_ref().as_ref(), entries)?;
        }
    }
    changes.sort_by_key(|(span, _)| std::cmp::Reverse(span.start));
    let mut text = text.to_string();
    for (span, with) in changes {
        text.replace_range(span, &with);
    }
    Ok(text)
}

/// The number in the unit that the key ends in.
fn number(key: &str, quantity: &str) -> Result<String, String> {
    let say = |error: &dyn std::fmt::Display| error.to_string();
    let unit = if key.ends_with("um_per_s") {
        "um/s"
    } else {
        key.rsplit('_').next().unwrap_or("")
    };
    let (value, scale) = match unit {
        "um/s" => {
            let speed = quantity.parse::<MicrometersPerSecond>();
            (speed.map_err(|e| say(&e))?.0, 1.0)
        }
        "um" => (quantity.parse::<Micrometers>().map_err(|e| say(&e))?.0, 1.0),
        "hz" => (quantity.parse::<Hertz>().map_err(|e| say(&e))?.0, 1.0),
        "us" => (quantity.parse::<Seconds>().map_err(|e| say(&e))?.0, 1e6),
        "ms" => (quantity.parse::<Seconds>().map_err(|e| say(&e))?.0, 1e3),
        _ => (quantity.parse::<Seconds>().map_err(|e| say(&e))?.0, 1.0),
    };
    // Decimal units leave a rounding error in the last digits; whole milliseconds are whole numbers.
    let value = (value * scale * 1e9).round() / 1e9;
    Ok(if key.ends_with("watchdog_ms") && value.fract() == 0.0 {
        format!("{value:.0}")
    } else {
        format!("{value:?}")
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantities_become_bare_numbers_on_the_same_lines() {
        let text = "near = \"-1.5um\" # here\n[actuator]\nkind = \"serial\"\nwatchdog = \"20ms\"\n[camera]\nrate = \"1kHz\"\n\
                    [calibration]\npixel = \"100nm\"\n[timing]\nperiod = \"1ms\"\ncamera_delay = \"2000us\"\nbudget_us = 500.0\n";
        let bare = bare(text, "rig.toml").unwrap_or_else(|error| panic!("{error}"));
        let expected = "near_um = -1.5 # here\n[actuator]\nkind = \"serial\"\nwatchdog_ms = 20\n[camera]\nrate_hz = 1000.0\n\
                        [calibration]\npixel_um = 0.1\n[timing]\nperiod_us = 1000.0\ncamera_delay_ms = 2.0\nbudget_us = 500.0\n";
        assert_eq!(bare, expected);
    }

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
    }

    #[test]
    fn a_quantity_of_another_kind_is_named_with_line_and_key() {
        for (text, words) in [
            ("\n[limits]\npark = \"20ms\"\n", ["rig.toml:3", "park"]),
            ("[timing]\nperiod = \"1000\"\n", ["rig.toml:2", "period"]),
        ] {
            let error = bare(text, "rig.toml").expect_err("refused").text();
            assert!(words.iter().all(|word| error.contains(word)), "{error}");
        }
    }
}
