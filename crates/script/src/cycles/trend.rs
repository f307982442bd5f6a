//! Trends over cycles, and the live watch on the amplitude.

use super::{CycleFlags, CycleRow};
use std::collections::VecDeque;

/// A straight line through a quantity of the cycles.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Trend {
    /// Cycles with a value.
    pub cycles: u64,
    /// Value of the line at the first of them.
    pub first: f64,
    /// Value of the line at the last of them.
    pub last: f64,
    /// Change per cycle.
    pub per_cycle: f64,
    /// Half width of its 95 % interval, the residuals taken for white.
    pub ci95_per_cycle: f64,
}

impl Trend {
    /// Whether the change is beyond chance: outside of three times its 95 % interval, so that residuals that are a little
    /// correlated raise hardly a false alarm in a thousand static arms.
    pub fn is_significant(&self) -> bool {
        self.per_cycle.abs() > 3.0 * self.ci95_per_cycle
    }
}

/// The trend of `(cycle, value)` pairs; values that are not finite are left out. None with fewer than five.
pub fn trend(values: impl IntoIterator<Item = (u64, f64)>) -> Option<Trend> {
    let points: Vec<(f64, f64)> = values
        .into_iter()
        .filter(|(_, value)| value.is_finite())
        .map(|(cycle, value)| (cycle as f64, value))
        .collect();
    let n = points.len() as f64;
    if points.len() < 5 {
        return None;
    }
    let mean = |of: fn(&(f64, f64)) -> f64| points.iter().map(of).sum::<f64>() / n;
    let (mx, my) = (mean(|p| p.0), mean(|p| p.1));
    let (mut sxx, mut sxy) = (0.0, 0.0);
    for (x, y) in &points {
        sxx += (x - mx) * (x - mx);
        sxy += (x - mx) * (y - my);
    }
    if sxx <= 0.0 {
        return None;
    }
    let per_cycle = sxy / sxx;
    let at = |x: f64| my + per_cycle * (x - mx);
    let residual: f64 = points.iter().map(|(x, y)| (y - at(*x)).powi(2)).sum();
    Some(Trend {
        cycles: points.len() as u64,
        first: at(points.first()?.0),
        last: at(points.last()?.0),
        per_cycle,
        ci95_per_cycle: 1.96 * (residual / (n - 2.0) / sxx).sqrt(),
    })
}

/// What the watch has to say.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Alarm {
    /// The amplitude error of the last cycles, as a share of the commanded amplitude, is above the limit.
    Raised {
        /// Mean error over the window.
        error: f64,
        /// Its change per cycle.
        per_cycle: f64,
    },
    /// It is back below two thirds of the limit.
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
    /// Errors of the last [`LONG`] cycles, for the trend.
    long: VecDeque<(u64, f64)>,
    raised: bool,
}

/// Cycles over which the live trend is taken.
const LONG: usize = 200;

impl AmplitudeWatch {
    /// Cycles of which the mean is judged in a run.
    pub const WINDOW: usize = 10;

    /// A watch with a limit (a share of the commanded amplitude) on the mean of `window` cycles.
    pub fn new(limit: f64, window: usize) -> Self {
        Self {
            limit,
            window: window.max(2),
            errors: VecDeque::new(),
            long: VecDeque::new(),
            raised: false,
        }
    }

    /// Takes a row; gives what has changed. Cycles without an amplitude and skipped ones do not count.
    pub fn add(&mut self, row: &CycleRow) -> Option<Alarm> {
        // The bead itself wanders by some tens of nanometres: below a tenth of a micrometre a share says nothing.
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
        if self.long.len() >= LONG {
            self.long.pop_front();
        }
        self.long.push_back((row.cycle, error));
        let mean = self.error().filter(|_| self.errors.len() >= self.window)?;
        if !self.raised && mean.abs() > self.limit {
            self.raised = true;
            let per_cycle = trend(self.errors.iter().copied()).map_or(0.0, |t| t.per_cycle);
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

    /// Trend of the amplitude error over the last two hundred cycles, as shares.
    pub fn trend(&self) -> Option<Trend> {
        trend(self.long.iter().copied())
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

    fn noise(k: u64) -> f64 {
        let hash = k.wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        ((hash ^ (hash >> 29)) >> 11) as f64 / (1u64 << 53) as f64 - 0.5
    }

    #[test]
    fn a_trend_is_found_with_its_ends_and_none_where_there_is_none() {
        let line = |k: u64| 3.8 - 0.94 * k as f64 / 179.0;
        let falling = trend((0..180).map(|k| (k, line(k) + 0.2 * noise(k)))).unwrap();
        assert!((falling.first - 3.8).abs() < 0.05 && (falling.last - 2.86).abs() < 0.05);
        assert!(falling.is_significant());
        let flat = trend((0..180).map(|k| (k, 3.8 + 0.2 * noise(k)))).unwrap();
        assert!(!flat.is_significant(), "{flat:?}");
        assert_eq!(trend((0..4).map(|k| (k, 1.0))), None);
    }

    #[test]
    fn the_alarm_is_raised_once_and_cleared_once() {
        let mut watch = AmplitudeWatch::new(0.1, 5);
        let mut alarms = Vec::new();
        for cycle in 0..60 {
            let mut row = CycleRow::empty(cycle, 1, ArmKind::Cyclic);
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
                let trend = watch.trend().unwrap();
                assert!(trend.cycles == 20 && !trend.is_significant(), "{trend:?}");
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
