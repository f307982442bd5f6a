//! Errors of scripts, with their place in the file.

use std::ops::Range;

/// A script that cannot be used: position, error, and what would be right.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{file}:{line}:{column}: {message}{}", help.as_ref().map(|help| format!("; {help}")).unwrap_or_default())]
pub struct ScriptError {
    /// The file.
    pub file: String,
    /// Line, from 1.
    pub line: usize,
    /// Column in characters, from 1.
    pub column: usize,
    /// The place as bytes of the text, for a marker under the source.
    pub span: Range<usize>,
    /// What is wrong, with the offending value.
    pub message: String,
    /// What would be right.
    pub help: Option<String>,
}

impl ScriptError {
    pub(crate) fn new(
        file: &str,
        text: &str,
        span: Range<usize>,
        message: String,
        help: Option<String>,
    ) -> Self {
        let mut start = span.start.min(text.len());
        while !text.is_char_boundary(start) {
            start -= 1;
        }
        let before = text.get(..start).unwrap_or("");
        let line_start = before.rfind('\n').map_or(0, |at| at + 1);
        Self {
            file: file.to_owned(),
            line: before.matches('\n').count() + 1,
            column: before.get(line_start..).unwrap_or("").chars().count() + 1,
            span: start..span.end.min(text.len()).max(start),
            message,
            help,
        }
    }
}

/// The candidate nearest to a misspelt word, if one is near.
pub(crate) fn nearest<'a>(word: &str, candidates: &[&'a str]) -> Option<&'a str> {
    cellpos_numeric::units::nearest(word, candidates.iter().copied())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_are_counted_in_lines_and_characters() {
        let text = "a = 1\nµ = \"x\"\n";
        let error = ScriptError::new("s.toml", text, 11..14, "m".into(), Some("h".into()));
        assert_eq!((error.line, error.column), (2, 5));
        assert_eq!(error.to_string(), "s.toml:2:5: m; h");
    }
}
