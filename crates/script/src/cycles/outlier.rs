//! Cycles that differ from the cycles before them without any reported event.

use super::CycleRow;
use std::collections::VecDeque;

/// Errors of the last undisturbed cycles of one motion.
#[derive(Debug, Clone, Default)]
pub(super) struct Outliers {
    motion: Option<(f64, f64)>,
    rms_um: VecDeque<f64>,
}

/// Number of cycles for comparison.
const KEPT: usize = 21;
/// Smallest number.
const FEWEST: usize = 5;
/// An error this many times their median is an outlier.
const TIMES: f64 = 3.0;
/// Smaller errors never count, um: a bead's Brownian motion varies by this much from cycle to cycle.
const SMALL_UM: f64 = 0.15;

impl Outliers {
    /// Whether a finished cycle is an outlier. Remembers it if it is undisturbed and not an outlier.
    pub(super) fn is_one(&mut self, row: &CycleRow) -> bool {
        if !self.motion.is_some_and(|motion| row.moves_as(motion)) {
            self.motion = Some((row.stroke_um, row.duration_s));
            self.rms_um.clear();
        }
        if !row.rms_um.is_finite() {
            return false;
        }
        let one = row.rms_um > SMALL_UM
            && self
                .median()
                .is_some_and(|median| row.rms_um > TIMES * median);
        if !one && !row.flags.is_disturbed() {
            if self.rms_um.len() >= KEPT {
                self.rms_um.pop_front();
            }
            self.rms_um.push_back(row.rms_um);
        }
        one
    }

    fn median(&self) -> Option<f64> {
        if self.rms_um.len() < FEWEST {
            return None;
        }
        let mut sorted: Vec<f64> = self.rms_um.iter().copied().collect();
        sorted.sort_by(f64::total_cmp);
        sorted.get(sorted.len() / 2).copied()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::ArmKind;

    fn row(rms_um: f64, stroke_um: f64) -> CycleRow {
        let mut row = CycleRow::empty(0, 1, ArmKind::Cyclic);
        (row.rms_um, row.stroke_um, row.duration_s) = (rms_um, stroke_um, 0.1);
        row
    }

    #[test]
    fn a_cycle_far_from_those_before_it_is_an_outlier_and_another_motion_begins_anew() {
        let mut outliers = Outliers::default();
        assert!(!outliers.is_one(&row(9.0, 2.0)), "nothing to compare with");
        for k in 0..30 {
            assert!(!outliers.is_one(&row(0.1 + 0.01 * f64::from(k % 3), 2.0)));
        }
        assert!(!outliers.is_one(&row(0.14, 2.0)), "small");
        assert!(outliers.is_one(&row(0.4, 2.0)));
        assert!(outliers.is_one(&row(0.4, 2.0)), "is not learned from");
        assert!(
            outliers.is_one(&row(0.4, 2.0 + 1e-12)),
            "the same motion, elsewhere in the plan"
        );
        assert!(!outliers.is_one(&row(0.4, 4.0)), "another motion");
        assert!(!outliers.is_one(&row(f64::NAN, 4.0)));
    }
}
