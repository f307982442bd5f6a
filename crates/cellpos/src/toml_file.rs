//! Reading TOML files with errors that show the place and say what would be right.

use crate::outcome::Failure;
use miette::{LabeledSpan, NamedSource};
use serde::de::DeserializeOwned;
use std::path::Path;

/// Reads a file into a type; unknown keys are the type's to refuse.
pub fn read<T: DeserializeOwned>(path: &Path) -> Result<T, Failure> {
    let text = std::fs::read_to_string(path).map_err(|error| {
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
        let message = error.message().to_string();
        let span = error.span().unwrap_or(0..0);
        let line = text[..span.start.min(text.len())].matches('\n').count() + 1;
        let help = suggestion(&message)
            .unwrap_or_else(|| "see the commented files under examples/".to_string());
        let report = miette::miette!(
            labels = vec![LabeledSpan::at(span, "here")],
            help = help,
            "{name}:{line}: {message}"
        )
        .with_source_code(NamedSource::new(name, text.to_string()));
        Failure::BadInput(report)
    })
}

/// For "unknown field `a`, expected one of `b`, `c`": the known name nearest to the unknown one.
fn suggestion(message: &str) -> Option<String> {
    if !message.starts_with("unknown") {
        return None;
    }
    let mut quoted = message.split('`').skip(1).step_by(2);
    let wrong = quoted.next()?;
    let known = cellpos_units::nearest(wrong, quoted)?;
    Some(format!("did you mean `{known}`?"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearest_known_key_is_suggested_and_a_far_one_is_not() {
        let message = "unknown field `latency`, expected one of `latency_ms`, `rate_hz`";
        assert_eq!(
            suggestion(message).as_deref(),
            Some("did you mean `latency_ms`?")
        );
        assert_eq!(
            suggestion("unknown field `zzzzzzzzz`, expected `rate_hz`"),
            None
        );
        assert_eq!(suggestion("invalid type"), None);
    }
}
