//! The cell before the first cycle: the reference of every stretch.

use super::CycleRow;
use cellpos_numeric::statistics::Z95;

/// Length and area of the cell at rest before the first cycle of a run that has them: means over the rest, with their uncertainty. For a
/// table of an older version: the values at the start of the first cycle, with unknown uncertainty.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AtRest {
    /// Length, um; NaN if not measured.
    pub length_um: f64,
    /// Its standard deviation, um; NaN if unknown.
    pub length_sd_um: f64,
    /// Projected area, um^2; NaN if not measured.
    pub area_um2: f64,
    /// Its standard deviation, um^2; NaN if unknown.
    pub area_sd_um2: f64,
}

impl Default for AtRest {
    fn default() -> Self {
        Self {
            length_um: f64::NAN,
            length_sd_um: f64::NAN,
            area_um2: f64::NAN,
            area_sd_um2: f64::NAN,
        }
    }
}

impl AtRest {
    /// From all rows of a run, in order, those of earlier sessions first.
    pub fn of<'r>(rows: impl IntoIterator<Item = &'r CycleRow>) -> Self {
        let mut rest = Self::default();
        rows.into_iter().for_each(|row| rest.take(row));
        rest
    }

    /// Takes the next row of the run and fills in unknown values.
    pub fn take(&mut self, row: &CycleRow) {
        let (length, area) = (
            (row.length_rest_um, row.length_rest_sd_um),
            (row.area_rest_um2, row.area_rest_sd_um2),
        );
        for (known, sd, (mean, mean_sd), start) in [
            (
                &mut self.length_um,
                &mut self.length_sd_um,
                length,
                row.length_start_um,
            ),
            (
                &mut self.area_um2,
                &mut self.area_sd_um2,
                area,
                row.area_start_um2,
            ),
        ] {
            if known.is_nan() {
                (*known, *sd) = if mean.is_finite() {
                    (mean, mean_sd)
                } else {
                    (start, f64::NAN)
                };
            }
        }
    }

    /// The largest length of a cycle over that at rest; NaN if one was not measured.
    pub fn stretch(&self, row: &CycleRow) -> f64 {
        row.length_peak_um / self.length_um
    }

    /// Relative half width of the 95 % interval that the length at rest gives every stretch of the run; NaN if unknown.
    pub fn stretch_ci95(&self) -> f64 {
        Z95 * self.length_sd_um / self.length_um
    }

    /// The largest area of a cycle over that at rest; NaN if one was not measured.
    pub fn areal_stretch(&self, row: &CycleRow) -> f64 {
        row.area_peak_um2 / self.area_um2
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::ArmKind;

    fn row(start_um: f64) -> CycleRow {
        let mut row = CycleRow::empty(0, 1, ArmKind::Cyclic);
        (row.length_start_um, row.length_peak_um) = (start_um, 24.0);
        row
    }

    #[test]
    fn a_cell_that_stays_longer_from_cycle_to_cycle_is_measured_by_the_first() {
        let rows = [row(f64::NAN), row(8.0), row(12.0)];
        let rest = AtRest::of(&rows);
        assert_eq!(rest.length_um, 8.0);
        assert_eq!((rest.stretch(&rows[1]), rest.stretch(&rows[2])), (3.0, 3.0));
        assert!(rest.stretch_ci95().is_nan(), "one frame, of an older table");
        assert!(
            rest.areal_stretch(&rows[2]).is_nan(),
            "no area was measured"
        );
    }

    #[test]
    fn the_mean_over_the_rest_stands_for_the_one_frame_at_the_start() {
        let mut first = row(8.3);
        (first.length_rest_um, first.length_rest_sd_um) = (8.0, 0.02);
        let rest = AtRest::of(&[first, row(12.0)]);
        assert_eq!((rest.length_um, rest.stretch(&first)), (8.0, 3.0));
        assert!((rest.stretch_ci95() - 0.0049).abs() < 1e-12);
    }
}
