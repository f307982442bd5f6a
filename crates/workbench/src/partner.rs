//! What was measured of the slow actuator, written into the table `[partner]` of a rig file.

use cellpos_session::Failure;
use std::path::Path;
use toml_edit::{DocumentMut, value};

/// Writes keys of `[partner]`; everything else of the file, comments too, stays.
///
/// # Errors
/// The file cannot be read or written, or has no such table.
pub fn write_partner(rig: &Path, keys: &[(&str, f64)]) -> Result<(), Failure> {
    let refused = |error: &dyn std::fmt::Display| {
        Failure::bad_input(
            format!("{}: [partner] cannot be written: {error}", rig.display()),
            "the values are in the output: paste them; or make the file writable",
        )
    };
    let text = std::fs::read_to_string(rig).map_err(|error| refused(&error))?;
    let text = with_keys(&text, keys).map_err(|error| refused(&error))?;
    // Whoever reads the file meanwhile finds one or the other, whole. A link stays one.
    let path = rig.canonicalize().map_err(|error| refused(&error))?;
    let unfinished = path.with_extension("toml.part");
    std::fs::write(&unfinished, text)
        .and_then(|()| std::fs::rename(&unfinished, &path))
        .map_err(|error| refused(&error))
}

fn with_keys(text: &str, keys: &[(&str, f64)]) -> Result<String, String> {
    let mut document: DocumentMut = text
        .parse()
        .map_err(|error: toml_edit::TomlError| error.to_string())?;
    let table = document
        .get_mut("partner")
        .and_then(|item| item.as_table_like_mut())
        .ok_or("there is no table [partner]")?;
    for (key, number) in keys {
        // The same quantity may be there as a text with its unit.
        let bare = ["_ms", "_um"]
            .iter()
            .find_map(|unit| key.strip_suffix(unit));
        if let Some(bare) = bare {
            table.remove(bare);
        }
        table.insert(key, value(*number));
    }
    Ok(document.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

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
