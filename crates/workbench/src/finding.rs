//! A problem in a rig file, with its position in the file.

use cellpos_session::quantities::line_of;
use serde::Serialize;
use std::path::Path;

/// How much a finding matters.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Weight {
    /// It cannot work.
    Error,
    /// It may work, but should be checked.
    Warning,
}

/// A problem.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Finding {
    /// How much it matters.
    pub weight: Weight,
    /// Line of the key in the file, or of its table if the key is left out; none if neither exists.
    pub line: Option<usize>,
    /// The key with its table, as `camera.rate_hz`.
    pub key: String,
    /// Its value, with the unit of the key; empty if missing.
    pub value: String,
    /// Description of the problem, with key and value.
    pub what: String,
    /// What would be right.
    pub remedy: String,
}

/// Findings in a file.
pub(crate) struct Found {
    text: String,
    pub(crate) findings: Vec<Finding>,
}

impl Found {
    /// None yet, in a file that is read for its lines.
    pub(crate) fn in_file(path: &Path) -> Self {
        Self {
            text: std::fs::read_to_string(path).unwrap_or_default(),
            findings: Vec::new(),
        }
    }

    /// Adds one about a key of a table (empty: of none).
    pub(crate) fn say(
        &mut self,
        weight: Weight,
        (table, key): (&str, &str),
        value: &dyn std::fmt::Display,
        what: String,
        remedy: &str,
    ) {
        let whole = if table.is_empty() {
            key.to_string()
        } else {
            format!("{table}.{key}")
        };
        let (below, name) = table.rsplit_once('.').unwrap_or(("", table));
        let line = line_of(&self.text, Some(table), key)
            .or_else(|| line_of(&self.text, Some(below), name));
        self.findings.push(Finding {
            weight,
            line,
            key: whole,
            value: value.to_string(),
            what,
            remedy: remedy.to_string(),
        });
    }
}
