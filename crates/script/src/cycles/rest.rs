//! The cell before the first cycle: what its stretch is measured by, wherever one is shown, judged or written.

use super::CycleRow;

/// Length and area of the cell at the start of the first cycle of a run that has them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AtRest {
    /// Length, um; NaN where it was not measured.
    pub length_um: f64,
    /// Projected area, um^2; NaN where it was not measured.
    pub area_um2: f64,
}

impl Default for AtRest {
    fn default() -> Self {
        Self {
            length_um: f64::NAN,
            area_um2: f64::NAN,
        }
    }
}

impl AtRest {
    /// Of all rows of a run, in order, those of earlier sessions first.
    pub fn of<'r>(rows: impl IntoIterator<Item = &'r CycleRow>) -> Self {
        let mut rest = Self::default();
        rows.into_iter().for_each(|row| rest.take(row));
        rest
    }

    /// Takes the next row of the run: what is not known yet is taken from it.
    pub fn take(&mut self, row: &CycleRow) {
        for (known, new) in [
            (&mut self.length_um, row.length_start_um),
            (&mut self.area_um2, row.area_start_um2),
        ] {
            if known.is_nan() {
                *known = new;
            }
        }
    }

    /// The largest length of a cycle over that at rest; NaN where one of them was not measured.
    pub fn stretch(&self, row: &CycleRow) -> f64 {
        row.length_peak_um / self.length_um
    }

    /// The largest area of a cycle over that at rest; NaN likewise.
    pub fn areal_stretch(&self, row: &CycleRow) -> f64 {
        row.area_peak_um2 / self.area_um2
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::ArmKind;

    #[test]
    fn a_cell_that_stays_longer_from_cycle_to_cycle_is_measured_by_the_first() {
        let row = |start_um: f64| {
            let mut row = CycleRow::empty(0, 1, ArmKind::Cyclic);
            (row.length_start_um, row.length_peak_um) = (start_um, 24.0);
            row
        };
        let rows = [row(f64::NAN), row(8.0), row(12.0)];
        let rest = AtRest::of(&rows);
        assert_eq!(rest.length_um, 8.0);
        assert_eq!((rest.stretch(&rows[1]), rest.stretch(&rows[2])), (3.0, 3.0));
        assert!(
            rest.areal_stretch(&rows[2]).is_nan(),
            "no area was measured"
        );
    }
}
