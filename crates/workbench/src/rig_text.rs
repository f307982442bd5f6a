//! Changes a part of a rig file's text and nothing else, not even comments.

use cellpos_session::Failure;
use std::path::Path;
use toml_edit::DocumentMut;

/// Changes `part` of a rig file. Another reader finds either the whole old file or the whole new one. A link remains a link.
///
/// # Errors
/// The file cannot be read or written, is not TOML, or `change` refuses. It is then unchanged.
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
