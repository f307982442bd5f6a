//! Errors of a plant or a model, as values that name file, key, value and unit.

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
    /// All coefficients of a polynomial are zero or missing.
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

/// A position in a file: 1-based line and column.
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

/// A model that cannot be read or is refused: which file, where in it, and why.
#[derive(Debug, Clone, PartialEq)]
pub struct ModelError {
    /// The file.
    pub file: String,
    /// Position in the file, if the problem has one.
    pub at: Option<Position>,
    /// What is wrong, and what would be right.
    pub problem: Box<ModelProblem>,
}

impl std::fmt::Display for ModelError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self.at {
            Some(at) => write!(
                f,
                "{}:{}:{}: {}",
                self.file, at.line, at.column, self.problem
            ),
            None => write!(f, "{}: {}", self.file, self.problem),
        }
    }
}

impl std::error::Error for ModelError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self.problem.as_ref() {
            ModelProblem::Plant(source) => Some(source),
            _ => None,
        }
    }
}

/// What is wrong with a model file.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ModelProblem {
    /// The file cannot be read.
    #[error("{reason}")]
    Unreadable {
        /// The operating system's words.
        reason: String,
    },
    /// The text is not TOML.
    #[error("{message}")]
    Syntax {
        /// Message of the TOML parser.
        message: String,
    },
    /// A key that no model has.
    #[error("unknown key `{key}`{}", suggestion_text(suggestion.as_deref(), known))]
    UnknownKey {
        /// The key, with the path to it.
        key: String,
        /// The nearest known key.
        suggestion: Option<String>,
        /// The keys that are known here.
        known: Vec<String>,
    },
    /// An effect id that is not in the catalogue, or a form that the effect does not have.
    #[error("`{key}` = \"{value}\" is not known{}", suggestion_text(suggestion.as_deref(), known))]
    UnknownName {
        /// The key, with the path to it.
        key: String,
        /// What is written there.
        value: String,
        /// The nearest known name.
        suggestion: Option<String>,
        /// The names that are known here.
        known: Vec<String>,
    },
    /// A required key is missing; the position is that of its table.
    #[error("`{key}` is missing: {what}")]
    MissingKey {
        /// The key, with the path to it.
        key: String,
        /// What to write.
        what: String,
    },
    /// A value of the wrong type.
    #[error("`{key}` is {found}: {expected} is wanted")]
    WrongType {
        /// The key, with the path to it.
        key: String,
        /// What is there.
        found: String,
        /// What should be there.
        expected: &'static str,
    },
    /// A number that is not finite or outside its range.
    #[error("`{key}` = {}: it must be a finite number{}", with_unit(*value, unit), range_text(*lower, *upper, unit))]
    OutOfRange {
        /// The key, with the path to it.
        key: String,
        /// The value.
        value: f64,
        /// The unit; empty for a pure number.
        unit: &'static str,
        /// Smallest value accepted.
        lower: f64,
        /// Largest value accepted.
        upper: f64,
    },
    /// Values that are each valid but contradict each other.
    #[error("{message}")]
    Inconsistent {
        /// What is wrong, and what would be right.
        message: String,
    },
    /// The plant's coefficients are refused.
    #[error("plant: {0}")]
    Plant(PlantError),
}

fn with_unit(value: f64, unit: &str) -> String {
    if unit.is_empty() {
        value.to_string()
    } else {
        format!("{value} {unit}")
    }
}

/// The words for a range; empty if any finite number is allowed.
fn range_text(lower: f64, upper: f64, unit: &str) -> String {
    if lower <= -f64::MAX && upper >= f64::MAX {
        String::new()
    } else {
        format!(" in {lower}..{}", with_unit(upper, unit))
    }
}

fn suggestion_text(suggestion: Option<&str>, known: &[String]) -> String {
    match suggestion {
        Some(name) => format!(": did you mean `{name}`?"),
        None => format!(": known here are {}", known.join(", ")),
    }
}
