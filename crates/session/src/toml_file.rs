//! Reading TOML files with errors that show the place and say what would be right.

use crate::Failure;
use cellpos_plant::Position;
use miette::{LabeledSpan, NamedSource};
use serde::de::DeserializeOwned;
use std::path::Path;

/// Reads a file into a type; the type itself refuses unknown keys.
pub fn read<T: DeserializeOwned>(path: &Path) -> Result<T, Failure> {
    /// Far beyond any configuration.
    const MOST_BYTES: u64 = 1 << 24;
    let text = cellpos_table::read_text(path, MOST_BYTES).map_err(|error| {
        Failure::bad_input(
            format!("{}: {error}", path.display()),
            "give the path of a TOML file",
        )
    })?;
    parse(&text, &path.display().to_string())
}

/// Reads a text; `name` is for the messages.
pub fn parse<T: DeserializeOwned>(text: &str, name: &str) -> Result<T, Failure> {
    toml::from_str(text).map_err(|error| {
        let missing = (error.message().strip_prefix("missing field `"))
            .and_then(|rest| rest.strip_suffix('`'));
        let message = cellpos_plant::in_words(error.message());
        let span = error.span().unwrap_or(0..0);
        let line = Position::of(text, span.clone()).line;
        let help = match (missing, cellpos_numeric::units::nearest_in(&message)) {
            (Some(key), _) => format!(
                "write {key} = ... into this table, or leave a table of a rig.toml out for the emulated rig's; the files under \
                 examples/ are commented"
            ),
            (None, Some(known)) => format!("did you mean `{known}`?"),
            (None, None) => "see the commented files under examples/".to_string(),
        };
        let report = miette::miette!(
            labels = vec![LabeledSpan::at(span, "here")],
            help = help,
            "{name}:{line}: {message}"
        )
        .with_source_code(NamedSource::new(name, text.to_string()));
        Failure::BadInput(report)
    })
}
