//! Writes the measurement of the slow actuator into the table `[partner]` of a rig file.

use crate::rig_text::change;
use cellpos_session::Failure;
use std::path::Path;
use toml_edit::{DocumentMut, value};

/// Writes keys of `[partner]` and changes nothing else in the file, not even comments.
///
/// # Errors
/// The file cannot be read or written, or has no such table.
pub fn write_partner(rig: &Path, keys: &[(&str, f64)]) -> Result<(), Failure> {
    change(rig, "[partner]", |document| set(document, keys))
}

fn set(document: &mut DocumentMut, keys: &[(&str, f64)]) -> Result<(), String> {
    let table = document
        .get_mut("partner")
        .and_then(|item| item.as_table_like_mut())
        .ok_or("there is no table [partner]")?;
    for (key, number) in keys {
        // The file may hold the same quantity as a text with its unit.
        let bare = ["_ms", "_um"]
            .iter()
            .find_map(|unit| key.strip_suffix(unit));
        if let Some(bare) = bare {
            table.remove(bare);
        }
        table.insert(key, value(*number));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn with_keys(text: &str, keys: &[(&str, f64)]) -> Result<String, String> {
        let mut document: DocumentMut = text.parse().expect("TOML");
        set(&mut document, keys).map(|()| document.to_string())
    }

    #[test]
    fn keys_are_replaced_and_the_rest_stays() {
        let text = "# mine\n[partner]\nkind = \"program\" # the pump\nlag = \"20ms\"\ngain = 1.0\n\n[limits]\nlow_um = 0.0\n";
        let got = with_keys(text, &[("gain", 0.8), ("lag_ms", 50.5)]).expect("a table");
        assert_eq!(
            got,
            "# mine\n[partner]\nkind = \"program\" # the pump\ngain = 0.8\nlag_ms = 50.5\n\n[limits]\nlow_um = 0.0\n"
        );
        assert!(with_keys("[limits]\n", &[]).is_err());
    }
}
