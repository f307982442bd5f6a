//! The meaning of the columns in foreign records.

/// A column by its name, or by its place counted from 1 (for files without a header).
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ColumnRef {
    /// By name, exactly as in the header.
    Name(String),
    /// By place, the first column being 1.
    Number(usize),
}

impl std::fmt::Display for ColumnRef {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Name(name) => write!(f, "{name}"),
            Self::Number(number) => write!(f, "{number}"),
        }
    }
}

impl From<&str> for ColumnRef {
    /// A whole number is a place, anything else a name.
    fn from(text: &str) -> Self {
        match text.trim().parse() {
            Ok(number) => Self::Number(number),
            Err(_) => Self::Name(text.trim().to_owned()),
        }
    }
}

/// Treatment of missing rows in an otherwise even record.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Gaps {
    /// Refuse the record.
    #[default]
    Refuse,
    /// Fill them: the command is held, the bead is not seen. [`crate::Record::filled_rows`] counts them.
    Hold,
}

/// The conversion of a table to a [`crate::Record`]. The default reads the project's own format.
#[derive(Debug, Clone, PartialEq)]
pub struct Mapping {
    /// Column of time in seconds. Not used when [`Mapping::rate_hz`] is set.
    pub time: ColumnRef,
    /// Column of the input (commanded PZT displacement).
    pub pzt: ColumnRef,
    /// Column of the output (bead position); None for a record that only commands, as `simulate` takes.
    pub bead: Option<ColumnRef>,
    /// Sampling rate of a record without a time column, Hz.
    pub rate_hz: Option<f64>,
    /// Factor from the input's column to um (4 for volts on the rig's amplifier).
    pub pzt_factor: f64,
    /// Factor from the output's column to um.
    pub bead_factor: f64,
    /// Rows that are missing.
    pub gaps: Gaps,
    /// Largest relative deviation of a step from the usual one (default 0.25). Smaller jitter is accepted and
    /// reported in [`crate::Record::jitter_s`].
    pub jitter: f64,
}

impl Default for Mapping {
    fn default() -> Self {
        Self {
            time: ColumnRef::Name("time_s".to_owned()),
            pzt: ColumnRef::Name("pzt_um".to_owned()),
            bead: Some(ColumnRef::Name("bead_um".to_owned())),
            rate_hz: None,
            pzt_factor: 1.0,
            bead_factor: 1.0,
            gaps: Gaps::Refuse,
            jitter: 0.25,
        }
    }
}

impl Mapping {
    /// Input only: the bead column may be missing and is not read.
    #[must_use]
    pub fn commands_only() -> Self {
        Self {
            bead: None,
            ..Self::default()
        }
    }

    /// A foreign table sampled at `rate_hz` without a time column.
    #[must_use]
    pub fn foreign(input: &str, output: &str, rate_hz: f64) -> Self {
        Self {
            pzt: input.into(),
            bead: Some(output.into()),
            rate_hz: Some(rate_hz),
            ..Self::default()
        }
    }

    /// Whether the table must have a header: some column is given by name.
    pub(crate) fn by_name(&self) -> bool {
        let name = |column: &ColumnRef| matches!(column, ColumnRef::Name(_));
        name(&self.pzt)
            || self.bead.as_ref().is_some_and(name)
            || (self.rate_hz.is_none() && name(&self.time))
    }
}
