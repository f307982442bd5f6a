//! A base model for records of a bare actuator: there is no model file, only a constant gain and the command at rest.

use crate::data::record::Record;
use crate::error::ReconcileError;

/// A base model for records without one: the constant gain that fits best, and the command at which the output was at
/// rest before the records began.
///
/// That command is read off the first row, which comes before the first command takes effect, through the gain. A piezo
/// remembers it. An estimate within a tenth of the command's range of zero is zero: not yet switched on.
///
/// # Errors
/// No records, or a command that never changes.
pub fn constant_gain(records: &[Record]) -> Result<(f64, f64), ReconcileError> {
    if records.is_empty() {
        return Err(ReconcileError::NoRecords);
    }
    let rows = || {
        records
            .iter()
            .flat_map(|r| r.pzt_um.iter().zip(&r.bead_um))
            .filter(|(_, y)| y.is_finite())
            .map(|(u, y)| (*u, *y))
    };
    let n = rows().count().max(1) as f64;
    // Regression over all records.
    let (mean_u, mean_y) = (
        rows().map(|(u, _)| u).sum::<f64>() / n,
        rows().map(|(_, y)| y).sum::<f64>() / n,
    );
    let (mut uu, mut uy) = (0.0, 0.0);
    for (u, y) in rows() {
        uu += (u - mean_u) * (u - mean_u);
        uy += (u - mean_u) * (y - mean_y);
    }
    if uu <= 0.0 {
        return Err(ReconcileError::ConstantInput);
    }
    let gain = uy / uu;
    let mut before = Vec::new();
    for r in records {
        let seen: Vec<(f64, f64)> = r
            .pzt_um
            .iter()
            .zip(&r.bead_um)
            .filter(|(_, y)| y.is_finite())
            .map(|(u, y)| (*u, *y))
            .collect();
        let n = seen.len().max(1) as f64;
        let (u, y) = (
            seen.iter().map(|s| s.0).sum::<f64>() / n,
            seen.iter().map(|s| s.1).sum::<f64>() / n,
        );
        if let Some(first) = seen.first() {
            before.push(u + (first.1 - y) / gain);
        }
    }
    before.sort_by(f64::total_cmp);
    let (low, high) = records
        .iter()
        .map(Record::pzt_range_um)
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), (c, d)| {
            (a.min(c), b.max(d))
        });
    let at_rest = before[before.len() / 2].clamp(low.min(0.0), high.max(0.0));
    let at_rest = if at_rest.abs() < 0.1 * (high - low) {
        0.0
    } else {
        at_rest
    };
    Ok((gain, at_rest))
}
