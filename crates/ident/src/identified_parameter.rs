//! A parameter with its interval and its verdict.

/// Whether the data determine a parameter.
#[derive(Debug, Clone, PartialEq)]
pub enum Identifiability {
    /// The interval can be relied on.
    Identified,
    /// The band excited does not determine it; the reason in a sentence.
    NotIdentifiable {
        /// What the data do determine, and what trades against the parameter.
        reason: String,
    },
}

impl Identifiability {
    /// `identified` or `not identifiable from this band`.
    pub fn label(&self) -> &'static str {
        match self {
            Identifiability::Identified => "identified",
            Identifiability::NotIdentifiable { .. } => "not identifiable from this band",
        }
    }

    /// Whether it is [`Identifiability::Identified`].
    pub fn is_identified(&self) -> bool {
        matches!(self, Identifiability::Identified)
    }
}

/// One parameter with all its results.
#[derive(Debug, Clone, PartialEq)]
pub struct IdentifiedParameter {
    /// Name with unit, for example `gain_per_s`.
    pub name: &'static str,
    /// Its name in words.
    pub meaning: &'static str,
    /// Unit.
    pub unit: &'static str,
    /// Best value.
    pub value: f64,
    /// 95 % interval by covariance (infinite ends where the data give no bound).
    pub ci95: [f64; 2],
    /// 95 % interval by bootstrap, if one was run.
    pub bootstrap95: Option<[f64; 2]>,
    /// The verdict.
    pub verdict: Identifiability,
}

/// Half-width, relative to the value, above which an interval no longer identifies a parameter.
pub(crate) const WIDEST_RELATIVE: f64 = 0.5;
