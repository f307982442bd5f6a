//! A cycle as the page shows it.

use cellpos_live::CycleRow;
use cellpos_script::AtRest;

/// A row of the per-cycle table as a point of the page's trend, its stretch relative to the cell at rest.
pub fn cycle_row(row: &cellpos_script::CycleRow, rest: &AtRest) -> CycleRow {
    let known = |value: f64| value.is_finite().then_some(value);
    CycleRow {
        cycle: row.cycle + 1,
        amplitude_um: known(row.reached_um),
        stretch: known(rest.stretch(row)),
        recovery_s: known(row.recovery_s),
    }
}
