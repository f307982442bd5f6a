//! Trends over cycles, and the live watch on the amplitude.

use super::saturating::{self, Saturating};
use super::{CycleFlags, CycleRow};
use cellpos_numeric::statistics::{Z95, student_t_quantile};
use std::collections::VecDeque;

/// A mean over some cycles.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Mean {
    /// Cycles that it is of.
    pub cycles: u64,
    /// The mean.
    pub mean: f64,
    /// Half width of its 95 % interval, from their scatter about a straight line (Student's t).
    pub ci95: f64,
}

/// The trend of a quantity over the cycles.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Trend {
    /// Cycles with a value.
    pub cycles: u64,
    /// Mean of the first ten (of the first half if there are fewer than twenty).
    pub first: Mean,
    /// Mean of the last ten (of the last half if there are fewer than twenty).
    pub last: Mean,
    /// Change per cycle, of a straight line through all.
    pub per_cycle: f64,
    /// Half width of its 95 % interval, with residuals assumed white.
    pub ci95_per_cycle: f64,
    /// RMS of the residual of the straight line.
    pub residual: f64,
    /// The law that saturates, if the cycles determine its end.
    pub saturating: Option<Saturating>,
}

impl Trend {
    /// Whether the change is significant: outside three times its 95 % interval. With this limit, slightly correlated residuals
    /// cause hardly one false alarm in a thousand static arms.
    pub fn is_significant(&self) -> bool {
        self.per_cycle.abs() > 3.0 * self.ci95_per_cycle
    }
}

/// Half the 95 % interval of the mean of `n` values whose squares about it, or about a line, sum up to `squares`, by Student's t.
/// NaN without a degree of freedom.
pub fn half95(squares: f64, freedom: usize, n: usize) -> f64 {
    if freedom == 0 {
        return f64::NAN;
    }
    let freedom = freedom as f64;
    student_t_quantile(0.975, freedom) * (squares / freedom / n as f64).sqrt()
}

impl Mean {
    /// From `(cycle, value)` points, at least one. A steady change is not scatter, so the interval uses the scatter about a
    /// straight line. Three points hardly determine a line, so it then uses the scatter about the mean.
    pub fn of(points: &[(f64, f64)]) -> Self {
        let n = points.len() as f64;
        let mean = points.iter().map(|p| p.1).sum::<f64>() / n;
        let about_mean: f64 = points.iter().map(|p| (p.1 - mean).powi(2)).sum();
        let (squares, freedom) = match line(points).filter(|_| points.len() > 3) {
            Some((.., about_line)) => (about_line, points.len() - 2),
            None => (about_mean, points.len().saturating_sub(1)),
        };
        Self {
            cycles: points.len() as u64,
            mean,
            ci95: half95(squares, freedom, points.len()),
        }
    }
}

/// The line of `(cycle, value)` points: change per cycle, half width of its 95 % interval, sum of squared residuals.
fn line(points: &[(f64, f64)]) -> Option<(f64, f64, f64)> {
    let n = points.len() as f64;
    let mean = |of: fn(&(f64, f64)) -> f64| points.iter().map(of).sum::<f64>() / n;
    let (mx, my) = (mean(|p| p.0), mean(|p| p.1));
    let (mut sxx, mut sxy) = (0.0, 0.0);
    for (x, y) in points {
        sxx += (x - mx) * (x - mx);
        sxy += (x - mx) * (y - my);
    }
    if sxx <= 0.0 {
        return None;
    }
    let per_cycle = sxy / sxx;
    let at = |x: f64| my + per_cycle * (x - mx);
    let sum: f64 = points.iter().map(|(x, y)| (y - at(*x)).powi(2)).sum();
    Some((per_cycle, Z95 * (sum / (n - 2.0) / sxx).sqrt(), sum))
}

/// The trend of `(cycle, value)` pairs in their order; values that are not finite are left out. None with fewer than five.
pub fn trend(values: impl IntoIterator<Item = (u64, f64)>) -> Option<Trend> {
    /// Cycles at each end in the stated means.
    const ENDS: usize = 10;
    let points: Vec<(f64, f64)> = values
        .into_iter()
        .filter(|(_, value)| value.is_finite())
        .map(|(cycle, value)| (cycle as f64, value))
        .collect();
    if points.len() < 5 {
        return None;
    }
    let (per_cycle, ci95_per_cycle, sum) = line(&points)?;
    let ends = ENDS.min(points.len() / 2);
    Some(Trend {
        cycles: points.len() as u64,
        first: Mean::of(&points[..ends]),
        last: Mean::of(&points[points.len() - ends..]),
        per_cycle,
        ci95_per_cycle,
        residual: (sum / points.len() as f64).sqrt(),
        saturating: saturating::fit(&points, sum),
    })
}

/// Messages of the watch.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Alarm {
    /// The amplitude error of the last cycles, as a share of the commanded amplitude, is above the limit.
    Raised {
        /// Mean error over the window.
        error: f64,
        /// Its change per cycle.
        per_cycle: f64,
    },
    /// It has fallen below two thirds of the limit.
    Cleared {
        /// Mean error over the window.
        error: f64,
    },
}

/// Watches the amplitude error of the cycles as they come: the mean of the last ones against a limit.
#[derive(Debug, Clone)]
pub struct AmplitudeWatch {
    limit: f64,
    window: usize,
    errors: VecDeque<(u64, f64)>,
    /// Errors of the last [`LONG`] cycles of one motion, for the trend.
    long: VecDeque<(u64, f64)>,
    /// Stroke (um) and duration (s) of that motion.
    motion: (f64, f64),
    raised: bool,
}

/// Cycles over which the live trend is taken.
const LONG: usize = 200;

impl AmplitudeWatch {
    /// Number of cycles in the mean during a run.
    pub const WINDOW: usize = 10;

    /// A watch with a limit (a share of the commanded amplitude) on the mean of `window` cycles.
    pub fn new(limit: f64, window: usize) -> Self {
        Self {
            limit,
            window: window.max(2),
            errors: VecDeque::new(),
            long: VecDeque::new(),
            motion: (f64::NAN, f64::NAN),
            raised: false,
        }
    }

    /// Takes a row; returns a change of the verdict. Cycles without an amplitude and skipped ones do not count.
    pub fn add(&mut self, row: &CycleRow) -> Option<Alarm> {
        // Brownian motion is some tens of nanometres, so below an amplitude of 0.1 um a share has no meaning.
        const SMALLEST_UM: f64 = 0.1;
        let counts = row.commanded_um >= SMALLEST_UM && row.reached_um.is_finite();
        if !counts || row.flags.has(CycleFlags::SKIPPED) {
            return None;
        }
        if self.errors.len() >= self.window {
            self.errors.pop_front();
        }
        let error = row.reached_um / row.commanded_um - 1.0;
        self.errors.push_back((row.cycle, error));
        // A different motion is not part of this trend.
        if !row.moves_as(self.motion) {
            self.motion = (row.stroke_um, row.duration_s);
            self.long.clear();
        }
        if self.long.len() >= LONG {
            self.long.pop_front();
        }
        self.long.push_back((row.cycle, error));
        let mean = self.error().filter(|_| self.errors.len() >= self.window)?;
        if !self.raised && mean.abs() > self.limit {
            self.raised = true;
            let per_cycle = {
                let points: Vec<(f64, f64)> =
                    self.errors.iter().map(|p| (p.0 as f64, p.1)).collect();
                line(&points).map_or(0.0, |line| line.0)
            };
            return Some(Alarm::Raised {
                error: mean,
                per_cycle,
            });
        }
        if self.raised && mean.abs() < self.limit * 2.0 / 3.0 {
            self.raised = false;
            return Some(Alarm::Cleared { error: mean });
        }
        None
    }

    /// Trend of the amplitude error over the last two hundred cycles of the same motion, as shares: the number of cycles, and
    /// the change per cycle.
    pub fn trend(&self) -> Option<(u64, f64)> {
        let points: Vec<(f64, f64)> = self.long.iter().map(|p| (p.0 as f64, p.1)).collect();
        let (per_cycle, ..) = line(&points).filter(|_| points.len() >= 5)?;
        Some((points.len() as u64, per_cycle))
    }

    /// Mean amplitude error of the last cycles, as a share.
    pub fn error(&self) -> Option<f64> {
        let n = self.errors.len();
        (n > 0).then(|| self.errors.iter().map(|e| e.1).sum::<f64>() / n as f64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::ArmKind;

    /// Even steps over the unit interval: a mean of few of them is better known than one of random numbers.
    fn noise(k: u64) -> f64 {
        let hash = k.wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        ((hash ^ (hash >> 29)) >> 11) as f64 / (1u64 << 53) as f64 - 0.5
    }

    #[test]
    fn a_trend_is_found_with_its_ends_and_none_where_there_is_none() {
        let line = |k: u64| 3.8 - 0.94 * k as f64 / 179.0;
        let falling = trend((0..180).map(|k| (k, line(k) + 0.2 * noise(k)))).unwrap();
        assert!(
            (falling.first.mean - 3.776).abs() < 0.05 && (falling.last.mean - 2.884).abs() < 0.05
        );
        assert!(falling.is_significant());
        assert!(
            falling.saturating.is_none_or(|law| !law.better_than_line),
            "{falling:?}"
        );
        let flat = trend((0..180).map(|k| (k, 3.8 + 0.2 * noise(k)))).unwrap();
        assert!(!flat.is_significant(), "{flat:?}");
        assert_eq!(trend((0..4).map(|k| (k, 1.0))), None);
    }

    #[test]
    fn what_saturates_has_the_ends_that_the_figure_shows_and_a_law_beside_the_line() {
        // A stretch of 3.6 that falls to 2.7 within 30 cycles: the ends of a straight line would be 3.0 and 2.6.
        let truth = |k: u64| 2.7 + 0.9 * (-(k as f64) / 30.0).exp();
        let found = trend((0..180).map(|k| (k, truth(k) + 0.1 * noise(k)))).unwrap();
        let ten = (0..10).map(truth).sum::<f64>() / 10.0;
        assert_eq!((found.first.cycles, found.last.cycles), (10, 10));
        assert!(
            (found.first.mean - ten).abs() < 2.0 * found.first.ci95,
            "{found:?}"
        );
        assert!((found.last.mean - 2.7).abs() < 0.02, "{found:?}");
        assert!(found.first.ci95 > 0.0 && found.first.ci95 < 0.1);
        let law = found.saturating.unwrap();
        assert!(law.better_than_line);
        for (value, ci95, expected) in [
            (law.start, law.start_ci95, 3.6),
            (law.end, law.end_ci95, 2.7),
            (law.cycles, law.cycles_ci95, 30.0),
        ] {
            assert!((value - expected).abs() < 2.0 * ci95, "{law:?}");
            assert!(ci95 < 0.2 * expected, "{law:?}");
        }
        assert!(law.residual < 0.5 * found.residual);
        let flat = trend((0..180).map(|k| (k, 3.8 + 0.2 * noise(k)))).unwrap();
        assert!(
            flat.saturating.is_none_or(|law| !law.better_than_line),
            "{flat:?}"
        );
    }

    /// The interval of the mean of ten cycles with a steady change follows from their scatter alone: the change is not scatter.
    #[test]
    fn the_interval_of_a_mean_leaves_a_steady_change_out() {
        let (mut inside, mut widest) = (0, 0.0_f64);
        for draw in 0..400 {
            let mut random = cellpos_numeric::Random::new(draw);
            let points: Vec<(f64, f64)> = (0..10)
                .map(|k| (f64::from(k), 5.0 * f64::from(k) + random.normal()))
                .collect();
            let found = Mean::of(&points);
            inside += u64::from((found.mean - 22.5).abs() < found.ci95);
            widest = widest.max(found.ci95);
        }
        assert!((368..=392).contains(&inside), "{inside} of 400");
        assert!(widest < 2.0, "{widest}: the change of 45 is in it");
    }

    #[test]
    fn the_live_trend_is_that_of_one_motion() {
        let mut watch = AmplitudeWatch::new(0.5, 5);
        for cycle in 0..60 {
            let mut row = CycleRow::empty(cycle, 1, ArmKind::Cyclic);
            let small = cycle < 30;
            (row.stroke_um, row.duration_s) = (if small { 1.0 } else { 4.0 }, 0.1);
            row.commanded_um = row.stroke_um;
            row.reached_um = row.commanded_um * if small { 0.99 } else { 0.80 };
            watch.add(&row);
        }
        let (cycles, per_cycle) = watch.trend().unwrap();
        assert!(cycles == 30 && per_cycle.abs() < 1e-12, "{per_cycle}");
    }

    #[test]
    fn the_alarm_is_raised_once_and_cleared_once() {
        let mut watch = AmplitudeWatch::new(0.1, 5);
        let mut alarms = Vec::new();
        for cycle in 0..60 {
            let mut row = CycleRow::empty(cycle, 1, ArmKind::Cyclic);
            (row.stroke_um, row.duration_s) = (2.0, 0.1);
            row.commanded_um = 2.0;
            let error = if (20..40).contains(&cycle) {
                -0.2
            } else {
                -0.01
            };
            row.reached_um = 2.0 * (1.0 + error + 0.01 * noise(cycle));
            if let Some(alarm) = watch.add(&row) {
                alarms.push((cycle, alarm));
            }
            if cycle == 19 {
                let (cycles, per_cycle) = watch.trend().unwrap();
                assert!(cycles == 20 && per_cycle.abs() < 2e-3, "{per_cycle}");
            }
        }
        assert!(
            matches!(
                alarms[..],
                [
                    (22..=24, Alarm::Raised { .. }),
                    (41..=44, Alarm::Cleared { .. })
                ]
            ),
            "{alarms:?}"
        );
    }
}
