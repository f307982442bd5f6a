//! A row of the table: the paper's value, the value here, and whether they agree.

use cellpos_report::number;
use serde_json::{Value, json};
use std::fmt::Write;
use std::path::Path;

/// Within which a gain, dB, a phase, deg, and the delay, ms, agree with the paper's.
pub(super) const GAIN_DB: f64 = 0.2;
pub(super) const PHASE_DEG: f64 = 1.0;
pub(super) const DELAY_MS: f64 = 0.05;

/// One row.
pub(super) struct Row {
    /// Key for machines.
    pub key: &'static str,
    /// The compared quantity.
    pub quantity: String,
    /// The paper's value as printed.
    pub paper: String,
    /// Our value.
    pub ours: f64,
    /// Unit.
    pub unit: &'static str,
    /// Whether our value is where it should be (by the corrected reading where the paper is wrong).
    pub holds: bool,
    /// Whether the paper contradicts itself here.
    pub paper_is_wrong: bool,
    /// Whether the data determine the value at all.
    pub identifiable: bool,
    /// Why.
    pub remark: String,
}

impl Row {
    /// Our value for reading.
    pub(super) fn ours_text(&self) -> String {
        number(self.ours)
    }

    /// The verdict in words.
    pub(super) fn verdict(&self) -> &'static str {
        match (self.holds, self.paper_is_wrong, self.identifiable) {
            (false, _, _) => "differs",
            (true, true, _) => "the paper is inconsistent",
            (true, false, false) => "not identifiable from 2-300 Hz",
            (true, false, true) => "agrees",
        }
    }
}

/// A row that the paper and the data agree on, or not.
pub(super) fn row(
    key: &'static str,
    quantity: &str,
    paper: &str,
    ours: f64,
    unit: &'static str,
    holds: bool,
    remark: String,
) -> Row {
    Row {
        key,
        quantity: quantity.to_owned(),
        paper: paper.to_owned(),
        ours,
        unit,
        holds,
        paper_is_wrong: false,
        identifiable: true,
        remark,
    }
}

/// A row on which the paper contradicts itself.
pub(super) fn wrong(row: Row) -> Row {
    Row {
        paper_is_wrong: true,
        ..row
    }
}

/// The JSON object.
pub(super) fn json(rows: &[Row], report: &Path, seed: u64) -> Value {
    let table: Vec<Value> = rows
        .iter()
        .map(|r| {
            json!({
                "key": r.key, "quantity": r.quantity, "paper": r.paper,
                "ours": if r.ours.is_finite() { json!(r.ours) } else { Value::Null },
                "unit": r.unit, "holds": r.holds, "verdict": r.verdict(), "remark": r.remark,
            })
        })
        .collect();
    json!({
        "seed": seed,
        "table": table,
        "all_hold": rows.iter().all(|r| r.holds),
        "report": report.display().to_string(),
    })
}

/// The same for reading.
pub(super) fn text(rows: &[Row], report: &Path) -> String {
    let mut out = String::new();
    for r in rows {
        let _ = writeln!(
            out,
            "{:<62} paper {:>10}  here {:>10} {:<9} {}",
            r.quantity,
            r.paper,
            r.ours_text(),
            r.unit,
            r.verdict()
        );
    }
    let _ = writeln!(out, "wrote {}", report.display());
    out
}
