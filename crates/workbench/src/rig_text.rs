//! Changes to the text of a rig file that leave everything else in it, comments too, as it is.

use cellpos_session::Failure;
use std::path::Path;
use toml_edit::DocumentMut;

/// Changes `part` of a rig file. Whoever reads the file meanwhile finds the old one or the new one, whole; a link stays one.
///
/// # Errors
/// The file cannot be read or written, is no TOML, or `change` refuses. It stays as it was.
pub(crate) fn change<T>(
    rig: &Path,
    part: &str,
    change: impl FnOnce(&mut DocumentMut) -> Result<T, String>,
) -> Result<T, Failure> {
    let refused = |error: &dyn std::fmt::Display| {
        Failure::bad_input(
            format!("{}: {part} cannot be written: {error}", rig.display()),
            "the values are in the output: paste them; or make the file writable",
        )
    };
    let text = std::fs::read_to_string(rig).map_err(|error| refused(&error))?;
    let mut document: DocumentMut = text
        .parse()
        .map_err(|error: toml_edit::TomlError| refused(&error))?;
    let changed = change(&mut document).map_err(|error| refused(&error))?;
    let path = rig.canonicalize().map_err(|error| refused(&error))?;
    let unfinished = path.with_extension("toml.part");
    std::fs::write(&unfinished, document.to_string())
        .and_then(|()| std::fs::rename(&unfinished, &path))
        .map_err(|error| refused(&error))?;
    Ok(changed)
}
