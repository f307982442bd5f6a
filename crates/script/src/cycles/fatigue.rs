//! The script's stop conditions for the cell: stretch, length at rest, recovery, each as a mean of ten cycles.

use super::{AtRest, CycleFlags, CycleRow};
use crate::plan::ArmKind;
use crate::script::Stop;
use std::collections::VecDeque;

/// A limit that the cell has passed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FatigueStop {
    /// The quantity, by its key in the script.
    pub quantity: &'static str,
    /// Its mean over the last ten cycles.
    pub value: f64,
    /// Its mean over the first ten.
    pub first: f64,
    /// The value that the limit allowed.
    pub allowed: f64,
}

/// A quantity with the mean of its first cycles and its last ones.
#[derive(Debug, Clone, Default)]
struct Ends {
    first: Vec<f64>,
    last: VecDeque<f64>,
}

impl Ends {
    fn add(&mut self, value: f64) {
        if !value.is_finite() {
            return;
        }
        if self.first.len() < FatigueWatch::WINDOW {
            self.first.push(value);
        }
        if self.last.len() >= FatigueWatch::WINDOW {
            self.last.pop_front();
        }
        self.last.push_back(value);
    }

    /// Means of the first and the last ten; None before there are ten.
    fn means(&self) -> Option<(f64, f64)> {
        let n = FatigueWatch::WINDOW as f64;
        (self.first.len() >= FatigueWatch::WINDOW).then(|| {
            (
                self.first.iter().sum::<f64>() / n,
                self.last.iter().sum::<f64>() / n,
            )
        })
    }
}

/// Watches the cell over its cycles. Feed it the rows in order, including those of earlier sessions of the run.
#[derive(Debug, Clone)]
pub struct FatigueWatch {
    stop: Stop,
    motion: Option<(f64, f64)>,
    at_rest: AtRest,
    stretch: Ends,
    rest: Ends,
    recovery: Ends,
}

impl FatigueWatch {
    /// Number of cycles in a mean.
    pub const WINDOW: usize = 10;

    /// A watch; None if the script has no such stop.
    pub fn new(stop: &Stop) -> Option<Self> {
        let any = stop.stretch_down.is_some()
            || stop.rest_length_change.is_some()
            || stop.recovery_above_s.is_some();
        any.then(|| Self {
            stop: *stop,
            motion: None,
            at_rest: AtRest::default(),
            stretch: Ends::default(),
            rest: Ends::default(),
            recovery: Ends::default(),
        })
    }

    /// Takes a row; returns the first limit that is passed. Rows of the static arm, of ramps and of disturbed cycles do not
    /// count. Another motion restarts the count.
    pub fn add(&mut self, row: &CycleRow) -> Option<FatigueStop> {
        self.at_rest.take(row);
        if row.arm != ArmKind::Cyclic || row.flags.is_disturbed() || row.flags.has(CycleFlags::RAMP)
        {
            return None;
        }
        if !self.motion.is_some_and(|motion| row.moves_as(motion)) {
            self.motion = Some((row.stroke_um, row.duration_s));
            (self.stretch, self.rest, self.recovery) = Default::default();
        }
        self.stretch.add(self.at_rest.stretch(row));
        self.rest.add(row.length_start_um);
        self.recovery.add(row.recovery_s);
        self.judge()
    }

    fn judge(&self) -> Option<FatigueStop> {
        if let (Some(share), Some((first, last))) = (self.stop.stretch_down, self.stretch.means()) {
            let allowed = first * (1.0 - share);
            if last < allowed {
                return Some(FatigueStop {
                    quantity: "stretch_down",
                    value: last,
                    first,
                    allowed,
                });
            }
        }
        if let (Some(share), Some((first, last))) =
            (self.stop.rest_length_change, self.rest.means())
            && (last - first).abs() > share * first
        {
            return Some(FatigueStop {
                quantity: "rest_length_change",
                value: last,
                first,
                allowed: first * (1.0 + share * (last - first).signum()),
            });
        }
        if let (Some(allowed), Some((first, last))) =
            (self.stop.recovery_above_s, self.recovery.means())
            && last > allowed
        {
            return Some(FatigueStop {
                quantity: "recovery_above",
                value: last,
                first,
                allowed,
            });
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(cycle: u64, stretch: f64, rest_um: f64, recovery_s: f64) -> CycleRow {
        let mut row = CycleRow::empty(cycle, 1, ArmKind::Cyclic);
        (row.stroke_um, row.duration_s) = (4.0, 2.0);
        row.length_start_um = rest_um;
        row.length_peak_um = stretch * rest_um;
        row.recovery_s = recovery_s;
        row
    }

    #[test]
    fn the_run_stops_on_the_quantity_that_the_script_names_and_on_no_other() {
        let tiring = |k: u64| {
            row(
                k,
                3.6 - 0.01 * k as f64,
                8.0 + 0.01 * k as f64,
                0.2 + 0.002 * k as f64,
            )
        };
        let stops = |stop: Stop| {
            let mut watch = FatigueWatch::new(&stop).unwrap();
            (0..300).find_map(|k| watch.add(&tiring(k)))
        };
        let stop = stops(Stop {
            stretch_down: Some(0.2),
            ..Stop::default()
        })
        .unwrap();
        assert_eq!(stop.quantity, "stretch_down");
        assert!(
            stop.value < stop.allowed && stop.value > 0.98 * stop.allowed,
            "{stop:?}"
        );
        let stop = stops(Stop {
            rest_length_change: Some(0.1),
            ..Stop::default()
        })
        .unwrap();
        assert!(
            stop.quantity == "rest_length_change" && (stop.value / stop.first - 1.1).abs() < 0.01
        );
        let stop = stops(Stop {
            recovery_above_s: Some(0.3),
            ..Stop::default()
        })
        .unwrap();
        assert!(stop.quantity == "recovery_above" && (stop.value - 0.3).abs() < 0.005);
        assert!(FatigueWatch::new(&Stop::default()).is_none());
    }

    #[test]
    fn one_odd_cycle_a_static_arm_and_disturbed_cycles_stop_nothing() {
        let mut watch = FatigueWatch::new(&Stop {
            stretch_down: Some(0.2),
            ..Stop::default()
        })
        .unwrap();
        for k in 0..100 {
            let mut row = row(k, if k == 50 { 2.0 } else { 3.6 }, 8.0, 0.2);
            if k > 60 {
                row.length_peak_um = 8.0;
                if k % 2 == 0 {
                    row.arm = ArmKind::Static;
                } else {
                    row.flags.set(CycleFlags::PAUSED, true);
                }
            }
            assert_eq!(watch.add(&row), None, "{k}");
        }
    }
}
