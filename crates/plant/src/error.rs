//! What can go wrong with a plant or a model, as values that name file, key, value and unit.

/// A transfer function or a discretisation that cannot be built.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum PlantError {
    /// A coefficient is infinite or not a number.
    #[error("{which}[{index}] is {value}: coefficients must be finite numbers")]
    NotFinite {
        /// `num` or `den`.
        which: &'static str,
        /// Index of the coefficient, highest power first.
        index: usize,
        /// The coefficient.
        value: f64,
    },
    /// All coefficients of a polynomial are zero, or there are none.
    #[error(
        "{which} has no coefficient other than zero: give the coefficients of s from the highest power down, for example [1.0, 76.3, 0.13]"
    )]
    Empty {
        /// `num` or `den`.
        which: &'static str,
    },
    /// The numerator has a higher degree than the denominator.
    #[error(
        "the numerator has degree {num} and the denominator {den}: a plant that differentiates its input cannot be realised, the numerator may have at most degree {den}"
    )]
    Improper {
        /// Degree of the numerator.
        num: usize,
        /// Degree of the denominator.
        den: usize,
    },
    /// More poles than the time-stepping machine holds.
    #[error("the denominator has degree {degree}: at most {max} is supported")]
    TooManyPoles {
        /// Degree of the denominator.
        degree: usize,
        /// The largest degree supported.
        max: usize,
    },
    /// A named quantity is outside its range.
    #[error("{name} = {value} {unit}: it must lie in {lower}..{upper} {unit}")]
    OutOfRange {
        /// Name of the quantity.
        name: &'static str,
        /// Its value.
        value: f64,
        /// Its unit.
        unit: &'static str,
        /// Smallest value accepted.
        lower: f64,
        /// Largest value accepted.
        upper: f64,
    },
}

/// Where in a file something stands: 1-based line and column.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Position {
    /// Line, from 1.
    pub line: usize,
    /// Column in characters, from 1.
    pub column: usize,
    /// Byte offset of the first byte.
    pub offset: usize,
    /// Length in bytes.
    pub length: usize,
}

impl Position {
    /// The position of a byte range of a text. A range beyond the text gives its end.
    pub fn of(text: &str, span: core::ops::Range<usize>) -> Self {
        let mut start = span.start.min(text.len());
        while !text.is_char_boundary(start) {
            start -= 1;
        }
        let before = &text[..start];
        Self {
            line: before.matches('\n').count() + 1,
            column: before
                .rsplit('\n')
                .next()
                .map_or(0, |line| line.chars().count())
                + 1,
            offset: start,
            length: span.end.saturating_sub(span.start),
        }
    }
}

/// A model that cannot be read, or that is read and refused.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ModelError {
    /// The file cannot be read.
    #[error("{file}: {reason}")]
    Unreadable {
        /// The file.
        file: String,
        /// The operating system's words.
        reason: String,
    },
    /// The text is not TOML.
    #[error("{file}:{}:{}: {message}", at.line, at.column)]
    Syntax {
        /// The file.
        file: String,
        /// Where.
        at: Position,
        /// What the TOML parser says.
        message: String,
    },
    /// A key that no model has.
    #[error("{file}:{}:{}: unknown key `{key}`{}", at.line, at.column, suggestion_text(suggestion.as_deref(), known))]
    UnknownKey {
        /// The file.
        file: String,
        /// Where.
        at: Position,
        /// The key, with the path to it.
        key: String,
        /// The nearest known key.
        suggestion: Option<String>,
        /// The keys that are known here.
        known: Vec<String>,
    },
    /// An effect id that is not in the catalogue, or a form that the effect does not have.
    #[error("{file}:{}:{}: `{key}` = \"{value}\" is not known{}", at.line, at.column, suggestion_text(suggestion.as_deref(), known))]
    UnknownName {
        /// The file.
        file: String,
        /// Where.
        at: Position,
        /// The key, with the path to it.
        key: String,
        /// What is written there.
        value: String,
        /// The nearest known name.
        suggestion: Option<String>,
        /// The names that are known here.
        known: Vec<String>,
    },
    /// A key that must be there is missing.
    #[error("{file}:{}:{}: `{key}` is missing: {what}", at.line, at.column)]
    MissingKey {
        /// The file.
        file: String,
        /// Where the table begins.
        at: Position,
        /// The key, with the path to it.
        key: String,
        /// What to write.
        what: String,
    },
    /// A value of the wrong type.
    #[error("{file}:{}:{}: `{key}` is {found}: {expected} is wanted", at.line, at.column)]
    WrongType {
        /// The file.
        file: String,
        /// Where.
        at: Position,
        /// The key, with the path to it.
        key: String,
        /// What is there.
        found: String,
        /// What should be there.
        expected: &'static str,
    },
    /// A number that is not finite or outside its range.
    #[error("{file}:{}:{}: `{key}` = {value} {unit}: it must be a finite number in {lower}..{upper} {unit}", at.line, at.column)]
    OutOfRange {
        /// The file.
        file: String,
        /// Where.
        at: Position,
        /// The key, with the path to it.
        key: String,
        /// The value.
        value: f64,
        /// The unit.
        unit: String,
        /// Smallest value accepted.
        lower: f64,
        /// Largest value accepted.
        upper: f64,
    },
    /// Values that are each right and together wrong.
    #[error("{file}:{}:{}: {message}", at.line, at.column)]
    Inconsistent {
        /// The file.
        file: String,
        /// Where.
        at: Position,
        /// What is wrong, and what would be right.
        message: String,
    },
    /// The plant's coefficients are refused.
    #[error("{file}:{}:{}: plant: {source}", at.line, at.column)]
    Plant {
        /// The file.
        file: String,
        /// Where.
        at: Position,
        /// Why.
        source: PlantError,
    },
}

impl ModelError {
    /// Where the error is in the file, if it is at a place.
    pub fn position(&self) -> Option<Position> {
        match self {
            Self::Unreadable { .. } => None,
            Self::Syntax { at, .. }
            | Self::UnknownKey { at, .. }
            | Self::UnknownName { at, .. }
            | Self::MissingKey { at, .. }
            | Self::WrongType { at, .. }
            | Self::OutOfRange { at, .. }
            | Self::Inconsistent { at, .. }
            | Self::Plant { at, .. } => Some(*at),
        }
    }
}

fn suggestion_text(suggestion: Option<&str>, known: &[String]) -> String {
    match suggestion {
        Some(name) => format!(": did you mean `{name}`?"),
        None => format!(": known here are {}", known.join(", ")),
    }
}
