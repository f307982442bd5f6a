//! The lines of a sheet.

use serde::Serialize;

/// How a line came out.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Verdict {
    /// As it must be.
    Passed,
    /// It differs from the requirement.
    Failed,
    /// Not tested: [`Line::note`] says why.
    NotTried,
}

/// One tested property.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Line {
    /// Part of the rig: `board`, `socket`, `camera`, `vision`, `machine`.
    pub part: &'static str,
    /// What was looked at.
    pub name: &'static str,
    /// How it came out.
    pub verdict: Verdict,
    /// The measured value, in `unit`; none if there is nothing to measure.
    pub value: Option<f64>,
    /// Unit of the value; empty for a count.
    pub unit: &'static str,
    /// The required value.
    pub limit: String,
    /// What else was seen.
    pub note: String,
}

/// The sheet in the making.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Sheet {
    /// Its lines, in the order in which they were tried.
    pub lines: Vec<Line>,
}

impl Sheet {
    /// A line that passes or fails, with its number.
    pub fn judge(
        &mut self,
        (part, name): (&'static str, &'static str),
        passed: bool,
        (value, unit): (impl Into<Option<f64>>, &'static str),
        limit: impl Into<String>,
        note: impl Into<String>,
    ) {
        self.lines.push(Line {
            part,
            name,
            verdict: if passed {
                Verdict::Passed
            } else {
                Verdict::Failed
            },
            // A value that could not be measured is NaN.
            value: value.into().filter(|value| value.is_finite()),
            unit,
            limit: limit.into(),
            note: note.into(),
        });
    }

    /// A line that was not tried.
    pub fn leave(&mut self, (part, name): (&'static str, &'static str), why: &str) {
        self.lines.push(Line {
            part,
            name,
            verdict: Verdict::NotTried,
            value: None,
            unit: "",
            limit: String::new(),
            note: why.to_string(),
        });
    }

    /// Adds the lines of a part that were not reached, as not tried.
    pub fn complete(&mut self, part: &'static str, names: &[&'static str], why: &str) {
        for name in names {
            if self.line(part, name).is_none() {
                self.leave((part, name), why);
            }
        }
    }

    /// A line.
    pub fn line(&self, part: &str, name: &str) -> Option<&Line> {
        self.lines
            .iter()
            .find(|line| line.part == part && line.name == name)
    }

    /// Lines passed, failed, not tried.
    pub fn counts(&self) -> [usize; 3] {
        [Verdict::Passed, Verdict::Failed, Verdict::NotTried].map(|verdict| {
            let same = self.lines.iter().filter(|line| line.verdict == verdict);
            same.count()
        })
    }
}
