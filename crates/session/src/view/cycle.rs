//! A cycle as the page shows it.

use cellpos_live::CycleRow;

/// A row of the per-cycle table as a point of the page's trend.
pub fn cycle_row(row: &cellpos_script::CycleRow) -> CycleRow {
    let known = |value: f64| value.is_finite().then_some(value);
    CycleRow {
        cycle: row.cycle + 1,
        amplitude_um: known(row.reached_um),
        stretch: known(row.length_peak_um / row.length_start_um),
        recovery_s: known(row.recovery_s),
    }
}
