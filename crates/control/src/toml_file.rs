//! Reading the TOML files of this crate: controller files and limits files. One way in, so that every refusal names the
//! file, the place, the key, the value and what would be right.

use crate::error::BuildError;
use cellpos_plant::{PlantError, Position};
use serde::de::DeserializeOwned;
use std::path::Path;
use thiserror::Error;

/// A file that cannot be used.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("{file}: {reason}")]
    Unreadable {
        /// The file.
        file: String,
        /// Why.
        reason: String,
    },
    /// The text does not parse, or has an unknown key or a value of the wrong type.
    #[error(
        "{file}:{line}:{column}: {}{message}{}",
        written.as_ref().map(|s| format!("`{s}`: ")).unwrap_or_default(),
        suggestion.as_ref().map(|s| format!(" (did you mean `{s}`?)")).unwrap_or_default()
    )]
    Text {
        /// The file.
        file: String,
        /// Line, from 1.
        line: usize,
        /// Column, from 1.
        column: usize,
        /// The line as it stands, key and value, where the message does not name the key.
        written: Option<String>,
        /// What is wrong.
        message: String,
        /// A key that was perhaps meant.
        suggestion: Option<String>,
    },
    /// A value is out of range, or the controller does not fit the plant.
    #[error("{file}: {error}")]
    Build {
        /// The file.
        file: String,
        /// Which value, and what would be right.
        error: BuildError,
    },
    /// `controller = "lead"` without `[pi.lead]`.
    #[error(
        "{file}: controller = \"lead\" needs [pi.lead] with zero_hz and pole_hz (`cellpos design --controller lead` finds them)"
    )]
    MissingLead {
        /// The file.
        file: String,
    },
    /// The model cannot be used in a loop.
    #[error("model: {0}")]
    Plant(#[from] PlantError),
}

impl ConfigError {
    /// A refused value, in a file.
    pub(crate) fn build(file: &str) -> impl FnOnce(BuildError) -> Self {
        let file = file.to_owned();
        move |error| Self::Build { file, error }
    }
}

/// A type that a TOML file holds.
pub(crate) trait TomlFile: DeserializeOwned {
    /// Refuses values out of range.
    fn check_values(&self) -> Result<(), BuildError>;
}

/// Reads a file and checks its values.
pub(crate) fn load<T: TomlFile>(path: &Path) -> Result<T, ConfigError> {
    let file = path.display().to_string();
    /// No controller comes near it.
    const MOST_BYTES: u64 = 1 << 24;
    match cellpos_table::read_text(path, MOST_BYTES) {
        Ok(text) => parse(&text, &file),
        Err(error) => Err(ConfigError::Unreadable {
            file,
            reason: error.to_string(),
        }),
    }
}

/// Reads a text and checks its values; `file` is for the messages only.
pub(crate) fn parse<T: TomlFile>(text: &str, file: &str) -> Result<T, ConfigError> {
    let this: T = toml::from_str(text).map_err(|error| text_error(text, file, &error))?;
    this.check_values().map_err(ConfigError::build(file))?;
    Ok(this)
}

fn text_error(text: &str, file: &str, error: &toml::de::Error) -> ConfigError {
    let Position { line, column, .. } = Position::of(text, error.span().unwrap_or(0..0));
    let message = cellpos_plant::in_words(error.message());
    // "unknown field `a`" and "missing field `a`" name the key; "is the text "a", must be a number" does not.
    let written = if message.contains('`') {
        None
    } else {
        text.lines()
            .nth(line - 1)
            .map(|line| line.trim().to_owned())
    };
    ConfigError::Text {
        file: file.to_owned(),
        line,
        column,
        written,
        suggestion: cellpos_numeric::units::nearest_in(&message).map(str::to_owned),
        message,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::error::check;

    #[derive(Debug, serde::Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Sample {
        speed_um_per_s: f64,
    }

    impl TomlFile for Sample {
        fn check_values(&self) -> Result<(), BuildError> {
            let v = self.speed_um_per_s;
            check("speed_um_per_s", "um/s", v, v > 0.0, "positive")
        }
    }

    #[test]
    fn every_refusal_names_the_file_the_key_and_what_would_be_right() {
        for (text, message) in [
            (
                "\nspeed_um_per_ms = 1.0",
                "s.toml:2:1: unknown field `speed_um_per_ms`, expected `speed_um_per_s` (did you mean `speed_um_per_s`?)",
            ),
            (
                "speed_um_per_s = \"fast\"",
                "s.toml:1:18: `speed_um_per_s = \"fast\"`: is the text \"fast\", must be a number",
            ),
            ("", "s.toml:1:1: missing field `speed_um_per_s`"),
            (
                "speed_um_per_s = -2.5",
                "s.toml: speed_um_per_s = -2.5 um/s: must be positive",
            ),
        ] {
            let error = parse::<Sample>(text, "s.toml").unwrap_err();
            assert_eq!(error.to_string(), message);
        }
        let error = load::<Sample>(Path::new("nowhere/s.toml")).unwrap_err();
        assert!(error.to_string().starts_with("nowhere/s.toml: "), "{error}");
    }
}
