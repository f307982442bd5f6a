//! What a report needs of the ticks, gathered as they go by.

use super::envelope::Envelope;
use cellpos_runtime::{Life, TickRecord};
use std::collections::VecDeque;

/// Ticks remembered to find the reference of the time of an exposure.
const PAST: usize = 64;

/// A stretch of the run, tick by tick.
#[derive(Debug, Default)]
pub struct Excerpt {
    pub time_s: Vec<f64>,
    pub target_um: Vec<f64>,
    pub measured_um: Vec<f64>,
    pub command_um: Vec<f64>,
}

/// Columns of a run.
#[derive(Debug, Default)]
pub struct Ticks {
    /// Ticks in all.
    pub rows: u64,
    /// Reference, position, command and neutral over the whole run, um.
    pub traces: Envelope<4>,
    pub excerpt: Excerpt,
    /// Of every tick of the closed loop; NaN without a position.
    pub error_um: Vec<f64>,
    pub wake_us: Vec<f64>,
    pub compute_us: Vec<f64>,
    /// Sum and number of the stated variances of positions.
    variance_um2: (f64, u64),
    start_s: f64,
    end_s: f64,
    first_running_s: Option<f64>,
    period_s: (f64, u64),
    past: VecDeque<(i64, f64)>,
}

impl Ticks {
    /// A session begins at a time of the run.
    pub fn begin(&mut self, start_s: f64) {
        self.start_s = start_s;
        self.past.clear();
        self.traces.gap();
    }

    /// The next tick.
    pub fn add(&mut self, r: &TickRecord) {
        let time_s = self.start_s + r.time_ns as f64 * 1e-9;
        if let Some((last_ns, _)) = self.past.back() {
            self.period_s.0 += (r.time_ns - last_ns) as f64 * 1e-9;
            self.period_s.1 += 1;
        }
        let values = [r.target_um, r.measured_um, r.command_um, r.neutral_um];
        self.traces.add(time_s, values);
        self.rows += 1;
        self.end_s = time_s;
        if self.past.len() >= PAST {
            self.past.pop_front();
        }
        self.past.push_back((r.time_ns, r.target_um));
        self.wake_us.push(f64::from(r.wake_ns) * 1e-3);
        self.compute_us.push(f64::from(r.compute_ns) * 1e-3);
        if r.life != Life::Running as u8 {
            return;
        }
        let since_s = time_s - *self.first_running_s.get_or_insert(time_s);
        if since_s <= 2.0 {
            self.excerpt.time_s.push(time_s);
            self.excerpt.target_um.push(r.target_um);
            self.excerpt.measured_um.push(r.measured_um);
            self.excerpt.command_um.push(r.command_um);
        }
        let then_um = self.target_at(r.mid_exposure_ns);
        self.error_um.push(match then_um {
            Some(then_um) if r.verdict == 0 => r.measured_um - then_um,
            _ => f64::NAN,
        });
        if r.variance_um2.is_finite() {
            self.variance_um2.0 += r.variance_um2;
            self.variance_um2.1 += 1;
        }
    }

    /// The reference at a time not long past.
    fn target_at(&self, time_ns: i64) -> Option<f64> {
        let after = self.past.partition_point(|past| past.0 <= time_ns);
        let before = self.past.get(after.checked_sub(1)?)?;
        Some(match self.past.get(after) {
            Some(after) => {
                let share = (time_ns - before.0) as f64 / (after.0 - before.0).max(1) as f64;
                before.1 + (after.1 - before.1) * share
            }
            None => before.1,
        })
    }

    /// End of the last tick, s since the start of the run.
    pub fn end_s(&self) -> f64 {
        self.end_s
    }

    /// Mean period of the ticks, s.
    pub fn period_s(&self) -> f64 {
        if self.period_s.1 > 0 {
            self.period_s.0 / self.period_s.1 as f64
        } else {
            1e-3
        }
    }

    /// Localisation noise as stated, um RMS.
    pub fn noise_um(&self) -> f64 {
        (self.variance_um2.0 / self.variance_um2.1.max(1) as f64).sqrt()
    }

    fn errors(&self) -> impl Iterator<Item = f64> {
        self.error_um.iter().copied().filter(|um| um.is_finite())
    }

    /// RMS error, um.
    pub fn rms_um(&self) -> Option<f64> {
        let n = self.errors().count();
        (n > 0).then(|| (self.errors().map(|um| um * um).sum::<f64>() / n as f64).sqrt())
    }

    /// Mean error, um.
    pub fn mean_um(&self) -> Option<f64> {
        let n = self.errors().count();
        (n > 0).then(|| self.errors().sum::<f64>() / n as f64)
    }

    /// Largest error, um.
    pub fn peak_um(&self) -> Option<f64> {
        self.errors().map(f64::abs).reduce(f64::max)
    }
}
