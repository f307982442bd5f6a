//! Quantities with units in TOML files (`park = "20um"`), or as bare numbers with the unit in the key (`park_um = 20.0`).
//!
//! The text is first rewritten to bare numbers, line for line, so that every later message names the right line. The caller says
//! which keys are quantities ([`Quantity`]); the rest of the text is not changed.

use cellpos_numeric::units::{Degrees, Hertz, Micrometers, MicrometersPerSecond, Seconds};
use std::ops::Range;
use toml::de::{DeTable, DeValue};

/// A key that may be written with a unit in its value.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Quantity {
    /// Table with its parents, as `emulator.cell`; empty: none. A list of tables counts as a table.
    pub table: &'static str,
    /// Key of a value with a unit: `park`.
    pub plain: &'static str,
    /// Key of a bare number, which ends in the unit: `park_um`.
    pub with_unit: &'static str,
}

impl Quantity {
    /// A quantity of a table: its key with a value that has a unit, and its key with a bare number.
    pub const fn new(table: &'static str, plain: &'static str, with_unit: &'static str) -> Self {
        Self {
            table,
            plain,
            with_unit,
        }
    }
}

/// A quantity without a unit, or with one of another kind.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{key} = {value}: {problem}")]
pub struct QuantityError {
    /// Line of the key, from 1.
    pub line: usize,
    /// Key as written.
    pub key: String,
    /// Value as written.
    pub value: String,
    /// The error, and what to write instead.
    pub problem: String,
    /// Key of a bare number.
    pub with_unit: &'static str,
}

/// The text with bare numbers. Text that is not TOML comes back unchanged; its reader reports the error.
///
/// ```
/// use cellpos_plant::quantities::{Quantity, bare};
/// let limits = [Quantity::new("limits", "park", "park_um")];
/// let text = "[limits]\npark = \"0.02mm\" # middle\n";
/// assert_eq!(bare(text, &limits).unwrap(), "[limits]\npark_um = 20 # middle\n");
/// assert_eq!(bare("[limits]\npark = \"20\"\n", &limits).unwrap_err().line, 2);
/// ```
///
/// # Errors
/// [`QuantityError`] for the first value that is not a quantity of the kind that its key needs.
pub fn bare(text: &str, quantities: &[Quantity]) -> Result<String, QuantityError> {
    let Ok(document) = DeTable::parse(text) else {
        return Ok(text.to_string());
    };
    let mut changes: Vec<(Range<usize>, String)> = Vec::new();
    in_table(text, "", document.get_ref(), quantities, &mut changes)?;
    changes.sort_by_key(|(span, _)| std::cmp::Reverse(span.start));
    let mut text = text.to_string();
    for (span, with) in changes {
        text.replace_range(span, &with);
    }
    Ok(text)
}

fn in_table(
    text: &str,
    table: &str,
    entries: &DeTable<'_>,
    quantities: &[Quantity],
    changes: &mut Vec<(Range<usize>, String)>,
) -> Result<(), QuantityError> {
    for (key, value) in entries {
        let name = key.get_ref().as_ref();
        let known = quantities
            .iter()
            .find(|known| known.table == table && known.plain == name);
        let refused = |with_unit, problem| QuantityError {
            line: 1 + text[..key.span().start].matches('\n').count(),
            key: name.to_string(),
            value: text[value.span()].to_string(),
            problem,
            with_unit,
        };
        match value.get_ref() {
            DeValue::String(quantity) => {
                let Some(&Quantity { with_unit, .. }) = known else {
                    continue;
                };
                let number =
                    number(with_unit, quantity).map_err(|problem| refused(with_unit, problem))?;
                changes.push((key.span(), with_unit.to_string()));
                changes.push((value.span(), number));
            }
            DeValue::Table(inner) => {
                in_table(text, &below(table, name), inner, quantities, changes)?;
            }
            DeValue::Array(list) => {
                let below = below(table, name);
                for item in list {
                    if let DeValue::Table(inner) = item.get_ref() {
                        in_table(text, &below, inner, quantities, changes)?;
                    }
                }
            }
            DeValue::Integer(_) | DeValue::Float(_) => {
                if let Some(&Quantity { with_unit, .. }) = known {
                    let unit = with_unit[name.len()..].trim_start_matches('_');
                    let unit = unit.replace("_per_", "/");
                    let problem = format!("has no unit: write \"{}{unit}\"", &text[value.span()]);
                    return Err(refused(with_unit, problem));
                }
            }
            _ => {}
        }
    }
    Ok(())
}

fn below(table: &str, name: &str) -> String {
    match table {
        "" => name.to_string(),
        table => format!("{table}.{name}"),
    }
}

/// The number in the unit that a key ends in.
fn number(key: &str, quantity: &str) -> Result<String, String> {
    fn of<T: std::str::FromStr<Err: std::fmt::Display>>(text: &str) -> Result<T, String> {
        text.parse::<T>().map_err(|error| error.to_string())
    }
    let unit = key.rsplit('_').next().unwrap_or("");
    let value = match unit {
        _ if key.ends_with("_um_per_s") => of::<MicrometersPerSecond>(quantity)?.0,
        "um" => of::<Micrometers>(quantity)?.0,
        "hz" => of::<Hertz>(quantity)?.0,
        "deg" => of::<Degrees>(quantity)?.0,
        "us" => of::<Seconds>(quantity)?.0 * 1e6,
        "ms" => of::<Seconds>(quantity)?.0 * 1e3,
        _ => of::<Seconds>(quantity)?.0,
    };
    // Decimal units leave a rounding error in the last digits; keys of integers need a whole number.
    let value = (value * 1e9).round() / 1e9;
    Ok(if value.fract() == 0.0 && value.abs() < 1e15 {
        format!("{value:.0}")
    } else {
        format!("{value:?}")
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const SOME: [Quantity; 6] = [
        Quantity::new("", "near", "near_um"),
        Quantity::new("board", "watchdog", "watchdog_ms"),
        Quantity::new("timing", "period", "period_us"),
        Quantity::new("limits", "slew", "slew_um_per_s"),
        Quantity::new("calibration", "tilt", "tilt_deg"),
        Quantity::new("faults.event", "at", "at_s"),
    ];

    #[test]
    fn quantities_become_bare_numbers_on_the_same_lines_and_nothing_else_changes() {
        let text = "near = \"-1.5um\" # here\n[board]\nnear = \"word\"\nwatchdog = \"0.02s\"\n[timing]\nperiod = \"0.2ms\"\n\
                    budget_us = 500.0\n[limits]\nslew = \"20um/ms\"\n[calibration]\ntilt = \"0.5deg\"\n\
                    [[faults.event]]\nat = \"2min\"\n[[faults.event]]\nkind = \"at\"\nat = \"5ms\"\n";
        let expected = "near_um = -1.5 # here\n[board]\nnear = \"word\"\nwatchdog_ms = 20\n[timing]\nperiod_us = 200\n\
                    budget_us = 500.0\n[limits]\nslew_um_per_s = 20000\n[calibration]\ntilt_deg = 0.5\n\
                    [[faults.event]]\nat_s = 120\n[[faults.event]]\nkind = \"at\"\nat_s = 0.005\n";
        assert_eq!(bare(text, &SOME).as_deref(), Ok(expected));
        let inline = "faults = { event = [{ at = \"1s\" }] }\n";
        let expected = "faults = { event = [{ at_s = 1 }] }\n";
        assert_eq!(bare(inline, &SOME).as_deref(), Ok(expected));
        assert_eq!(bare("no = = toml", &SOME).as_deref(), Ok("no = = toml"));
    }

    #[test]
    fn a_quantity_of_another_kind_is_named_with_line_key_and_value() {
        for (text, line, key, value) in [
            (
                "\n[board]\nwatchdog = \"20um\"\n",
                3,
                "watchdog",
                "\"20um\"",
            ),
            ("[timing]\nperiod = \"1000\"\n", 2, "period", "\"1000\""),
            ("[[faults.event]]\n\nat = \"\"\n", 3, "at", "\"\""),
            ("[limits]\nslew = 20.5\n", 2, "slew", "20.5"),
        ] {
            let error = bare(text, &SOME).expect_err("refused");
            assert_eq!(
                (error.line, error.key.as_str(), error.value.as_str()),
                (line, key, value)
            );
            assert!(!error.problem.is_empty() && error.with_unit.starts_with(key));
        }
    }

    #[test]
    fn a_number_without_its_unit_is_refused_with_the_text_to_write() {
        let error = bare("near = 3\n[limits]\nslew_um_per_s = 2\n", &SOME).expect_err("refused");
        assert_eq!(error.to_string(), "near = 3: has no unit: write \"3um\"");
        let error = bare("[limits]\nslew = 2\n", &SOME).expect_err("refused");
        assert!(error.problem.ends_with("\"2um/s\""), "{error}");
        // The same word in another table is a different key.
        assert!(bare("[board]\nnear = 3\n", &SOME).is_ok());
    }
}
