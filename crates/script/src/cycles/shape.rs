//! Length or projected area of a cell over a cycle.

use super::fit;

/// A measured quantity of the cell's shape over a cycle, in the order of time.
#[derive(Debug, Default)]
pub(super) struct Series {
    points: Vec<Point>,
}

#[derive(Debug, Clone, Copy)]
struct Point {
    time_s: f64,
    phase: f64,
    value: f64,
}

/// A quantity at fixed phases of the cycle; NaN if not measured.
#[derive(Debug, Clone, Copy)]
pub(super) struct AtPhases {
    pub(super) start: f64,
    pub(super) quarter: f64,
    pub(super) half: f64,
    pub(super) three_quarters: f64,
    pub(super) peak: f64,
    pub(super) end: f64,
}

impl Series {
    /// Takes a value exposed at a time and phase (in cycles). A value that is not finite counts as not measured.
    pub(super) fn add(&mut self, time_s: f64, phase: f64, value: f64) {
        if value.is_finite() {
            self.points.push(Point {
                time_s,
                phase,
                value,
            });
        }
    }

    /// The first and last value, the largest, and those in between at fixed phases.
    pub(super) fn at_phases(&self) -> AtPhases {
        let value = |point: Option<&Point>| point.map_or(f64::NAN, |point| point.value);
        AtPhases {
            start: value(self.points.first()),
            quarter: self.at(0.25),
            half: self.at(0.5),
            three_quarters: self.at(0.75),
            peak: value(self.peak().and_then(|index| self.points.get(index))),
            end: value(self.points.last()),
        }
    }

    /// Where the largest value is.
    fn peak(&self) -> Option<usize> {
        let largest = (0..)
            .zip(&self.points)
            .max_by(|a, b| a.1.value.total_cmp(&b.1.value));
        largest.map(|(index, _)| index)
    }

    /// The value at a phase, interpolated between its neighbours; NaN in a gap of a tenth of the cycle.
    fn at(&self, phase: f64) -> f64 {
        let after = self.points.partition_point(|point| point.phase < phase);
        let before = after
            .checked_sub(1)
            .and_then(|index| self.points.get(index));
        match (before, self.points.get(after)) {
            (Some(a), Some(b)) if b.phase - a.phase < 0.1 => {
                let share = (phase - a.phase) / (b.phase - a.phase).max(f64::MIN_POSITIVE);
                a.value + (b.value - a.value) * share
            }
            _ => f64::NAN,
        }
    }

    /// Time constant of the relaxation after the largest value, s; NaN if nothing relaxes.
    pub(super) fn recovery_s(&self) -> f64 {
        let Some((index, last)) = self.peak().zip(self.points.last()) else {
            return f64::NAN;
        };
        let after = self.points.get(index..).unwrap_or(&[]);
        let peak = after.first().map_or(f64::NAN, |point| point.value);
        // Noise alone must not count as a recovery.
        if peak - last.value < 0.05 * peak {
            return f64::NAN;
        }
        // Fit from nine tenths of the height down: leaving the constriction is not relaxation.
        let level = last.value + 0.9 * (peak - last.value);
        let falling: Vec<(f64, f64)> = after
            .iter()
            .skip_while(|point| point.value >= level)
            .map(|point| (point.time_s, point.value))
            .collect();
        fit::recovery_s(&falling).unwrap_or(f64::NAN)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_taken_at_fixed_phases_and_not_across_a_gap() {
        let mut series = Series::default();
        for k in 0..200 {
            let phase = f64::from(k) / 200.0;
            // Not seen from 0.4 to 0.6.
            if !(0.4..0.6).contains(&phase) {
                series.add(phase, phase, 10.0 + 8.0 * phase);
            }
        }
        let at = series.at_phases();
        assert!((at.start - 10.0).abs() < 1e-9 && (at.end - 17.96).abs() < 1e-9);
        assert!((at.quarter - 12.0).abs() < 1e-9 && (at.three_quarters - 16.0).abs() < 1e-9);
        assert!(at.half.is_nan());
        assert_eq!(at.peak, at.end);
        assert!(series.recovery_s().is_nan(), "nothing recovers");
    }

    #[test]
    fn what_was_not_measured_leaves_nothing_behind() {
        let mut series = Series::default();
        series.add(0.0, 0.0, f64::NAN);
        let at = series.at_phases();
        for value in [
            at.start,
            at.quarter,
            at.half,
            at.three_quarters,
            at.peak,
            at.end,
            series.recovery_s(),
        ] {
            assert!(value.is_nan());
        }
    }

    #[test]
    fn the_recovery_after_the_peak_has_the_time_constant_of_its_relaxation() {
        let mut series = Series::default();
        for k in 0..1000 {
            let t_s = f64::from(k) * 1e-3;
            // Stretched until 0.2 s, then relaxing to 8.
            let um = 8.0 + 20.0 * (-(t_s - 0.2).max(0.0) / 0.16).exp();
            series.add(t_s, t_s, um);
        }
        let recovery_s = series.recovery_s();
        assert!((recovery_s / 0.16 - 1.0).abs() < 1e-3, "{recovery_s}");
        assert_eq!(series.at_phases().peak, 28.0);
    }
}
