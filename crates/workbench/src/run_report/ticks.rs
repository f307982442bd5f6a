//! Figures of a report, gathered in one pass over the ticks.

use super::course::RmsCourse;
use super::cycles::half95;
use super::envelope::Envelope;
use super::spectrum::Welch;
use super::spread::{Decades, Spread};
use super::unused::Unused;
use cellpos_numeric::statistics::Z95;
use cellpos_runtime::{Hold, Statistics, TickRecord};
use std::collections::VecDeque;

/// Rows that are kept of the end of a run.
const LAST_ROWS: usize = 2000;

/// A stretch of the run, tick by tick.
#[derive(Debug, Default)]
pub(super) struct Excerpt {
    pub time_s: Vec<f64>,
    pub target_um: Vec<f64>,
    pub measured_um: Vec<f64>,
    pub command_um: Vec<f64>,
}

/// The length of the cell over one cycle.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Course {
    /// Number of the cycle, from 1 as people count.
    pub number: u64,
    /// Session it is in, and where in it, ns.
    pub session: u64,
    pub from_ns: i64,
    pub to_ns: i64,
    pub time_s: Vec<f64>,
    pub length_um: Vec<f64>,
}

/// Columns of a run.
#[derive(Debug, Default)]
pub(super) struct Ticks {
    /// Ticks in all.
    pub rows: u64,
    /// Reference, position, command and neutral over the whole run, um.
    pub traces: Envelope<4>,
    /// Displacement of the slow partner as it reports it, on its own scale, and its effect, both um; empty without one.
    pub partner: Envelope<2>,
    pub has_partner: bool,
    /// How often the reference turned back, and the rows of the first and the last time.
    turns: (u64, u64, u64),
    /// Reference of the last tick, um, and the direction in which it last moved.
    moving: (f64, bool),
    pub excerpt: Excerpt,
    /// The last seconds of the closed loop, in which its error counts.
    last: VecDeque<[f64; 3]>,
    /// Count, mean and sum of squares about it, of the target where the error counts, um.
    motion: (f64, f64, f64),
    /// Errors of every tick whose error counts (see [`Statistics`]), nm.
    pub error_nm: Spread,
    /// The same over the run, nm; NaN if it does not count.
    pub error: Envelope<1>,
    /// Its RMS over the run from the first closing of the loop on, nm.
    pub rms_nm: RmsCourse,
    /// The same of the errors that count.
    counted_nm: RmsCourse,
    /// Whether the target moved while the error counted.
    pub target_moves: bool,
    counted_target_um: Option<f64>,
    /// Their spectrum, um; ticks without a position are missing values in it.
    pub error_um: Welch,
    /// The figures of each session, as the terminal and run.toml have them.
    pub statistics: Vec<Statistics>,
    /// Length of the cell over the whole run, um; empty where none was measured.
    pub length: Envelope<1>,
    pub has_length: bool,
    /// Cycles whose course is drawn.
    pub courses: Vec<Course>,
    session: u64,
    pub wake_us: Decades,
    pub compute_us: Decades,
    /// Frames that gave no position.
    pub unused: Unused,
    /// From the middle of an exposure to the command computed from it, ms.
    age_ms: Spread,
    newest_frame: u64,
    /// Sum and number of the stated variances of positions.
    variance_um2: (f64, u64),
    start_s: f64,
    end_s: f64,
    first_running_s: Option<f64>,
    period_s: (f64, u64),
    last_ns: Option<i64>,
}

impl Ticks {
    /// Nothing yet; the cycles whose course is wanted are known.
    pub(super) fn with_courses(courses: Vec<Course>) -> Self {
        Self {
            courses,
            ..Self::default()
        }
    }

    /// A session begins at a time of the run; its bead is to be held so well.
    pub(super) fn begin(&mut self, start_s: f64, hold: Option<Hold>) {
        self.start_s = start_s;
        self.last_ns = None;
        self.traces.gap();
        self.partner.gap();
        self.length.gap();
        self.error.gap();
        self.session += 1;
        let statistics = Statistics::default();
        (self.statistics).push(hold.map_or(statistics, |hold| statistics.holding(hold)));
    }

    /// The next tick.
    pub(super) fn add(&mut self, r: &TickRecord) {
        let time_s = self.start_s + r.time_ns as f64 * 1e-9;
        if let Some(last_ns) = self.last_ns.replace(r.time_ns) {
            self.period_s.0 += (r.time_ns - last_ns) as f64 * 1e-9;
            self.period_s.1 += 1;
        }
        let values = [r.target_um, r.measured_um, r.command_um, r.neutral_um];
        self.traces.add(time_s, values);
        self.turn(r.target_um);
        let partner = [r.partner_applied_um, r.partner_effect_um];
        self.has_partner |= partner[0].is_finite();
        self.partner.add(time_s, partner);
        self.rows += 1;
        self.unused.add(r);
        self.end_s = time_s;
        self.wake_us.add(f64::from(r.wake_ns) * 1e-3);
        self.compute_us.add(f64::from(r.compute_ns) * 1e-3);
        if std::mem::replace(&mut self.newest_frame, r.frame_id) != r.frame_id {
            let handed_ns = r.time_ns + i64::from(r.compute_ns);
            self.age_ms
                .add((handed_ns - r.mid_exposure_ns) as f64 * 1e-6);
        }
        self.length.add(time_s, [r.length_um]);
        if r.length_um.is_finite() {
            self.has_length = true;
            // Lengths are of the exposure, not of the tick.
            let at = |course: &&mut Course| {
                course.session == self.session
                    && (course.from_ns..course.to_ns).contains(&r.mid_exposure_ns)
            };
            if let Some(course) = self.courses.iter_mut().find(at) {
                course
                    .time_s
                    .push((r.mid_exposure_ns - course.from_ns) as f64 * 1e-9);
                course.length_um.push(r.length_um);
            }
        }
        let counts = match self.statistics.last_mut() {
            Some(statistics) => {
                statistics.add(r);
                statistics.counts_now()
            }
            None => false,
        };
        if !counts {
            self.error.add(time_s, [f64::NAN]);
        }
        if !r.is_running() {
            return;
        }
        self.rms_nm.add(time_s, r.error_um * 1e3);
        let since_s = time_s - *self.first_running_s.get_or_insert(time_s);
        if since_s <= 2.0 {
            self.excerpt.time_s.push(time_s);
            self.excerpt.target_um.push(r.target_um);
            self.excerpt.measured_um.push(r.measured_um);
            self.excerpt.command_um.push(r.command_um);
        }
        if !counts {
            return;
        }
        self.error.add(time_s, [r.error_um * 1e3]);
        let (n, mean, _) = &mut self.motion;
        *n += 1.0;
        let off_um = r.target_um - *mean;
        *mean += off_um / *n;
        self.motion.2 += off_um * (r.target_um - self.motion.1);
        if self.last.len() == LAST_ROWS {
            self.last.pop_front();
        }
        // The target that the position is compared with is that of its exposure.
        let exposed_s = self.start_s + r.mid_exposure_ns as f64 * 1e-9;
        self.last
            .push_back([exposed_s, r.measured_um - r.error_um, r.measured_um]);
        let first_um = *self.counted_target_um.get_or_insert(r.target_um);
        self.target_moves |= (r.target_um - first_um).abs() > 1e-9;
        self.error_nm.add(r.error_um * 1e3);
        self.counted_nm.add(time_s, r.error_um * 1e3);
        self.error_um.add(r.error_um);
        if r.variance_um2.is_finite() {
            self.variance_um2.0 += r.variance_um2;
            self.variance_um2.1 += 1;
        }
    }

    fn turn(&mut self, target_um: f64) {
        let (last_um, up) = self.moving;
        // One that rests has not turned.
        if target_um == last_um || !target_um.is_finite() {
            return;
        }
        let now = target_um > last_um;
        self.moving = (target_um, now);
        if now != up {
            let (count, first, _) = self.turns;
            let first = if count == 0 { self.rows } else { first };
            self.turns = (count + 1, first, self.rows);
        }
    }

    /// Mean period of a reference that goes to and fro, in rows; infinite if it does not.
    pub(super) fn period_rows(&self) -> f64 {
        match self.turns {
            // Two turns are a period.
            (count, first, last) if count > 2 => 2.0 * (last - first) as f64 / (count - 1) as f64,
            _ => f64::INFINITY,
        }
    }

    /// RMS of the target about its mean while the error counted, um; none if it rests.
    pub(super) fn motion_rms_um(&self) -> Option<f64> {
        let (n, _, squares) = self.motion;
        self.target_moves.then(|| (squares / n.max(1.0)).sqrt())
    }

    /// The last periods of a reference that goes to and fro; of any other the last second.
    pub(super) fn last_periods(&self, periods: f64) -> Excerpt {
        let second = (1.0 / self.period_s()).round();
        let wanted = match self.period_rows() {
            rows if rows.is_finite() => (periods * rows).ceil(),
            _ => second,
        };
        let skipped = self.last.len().saturating_sub(wanted as usize);
        let mut excerpt = Excerpt::default();
        for [time_s, target_um, measured_um] in self.last.iter().skip(skipped) {
            excerpt.time_s.push(*time_s);
            excerpt.target_um.push(*target_um);
            excerpt.measured_um.push(*measured_um);
        }
        excerpt
    }

    /// Start of the last tick, s since the start of the run.
    pub(super) fn end_s(&self) -> f64 {
        self.end_s
    }

    /// From the first tick to the end of the last, pauses between sessions included, s.
    pub(super) fn duration_s(&self) -> f64 {
        self.end_s + self.period_s()
    }

    /// How long the errors are of, s.
    pub(super) fn counted_s(&self) -> f64 {
        self.error_nm.count() as f64 * self.period_s()
    }

    /// Mean period of the ticks, s.
    pub(super) fn period_s(&self) -> f64 {
        if self.period_s.1 > 0 {
            self.period_s.0 / self.period_s.1 as f64
        } else {
            1e-3
        }
    }

    /// Median time from the middle of an exposure to the command computed from it, ms.
    pub(super) fn age_ms(&self) -> Option<f64> {
        self.age_ms.median()
    }

    /// Localisation noise as stated, um RMS.
    pub(super) fn noise_um(&self) -> f64 {
        (self.variance_um2.0 / self.variance_um2.1.max(1) as f64).sqrt()
    }

    /// RMS error of all sessions together, um: of the very positions that the terminal's and run.toml's figures are of.
    pub(super) fn rms_um(&self) -> Option<f64> {
        let (n, sum) = self.sums(|statistics| statistics.rms_measured_nm().map(|nm| nm * nm));
        (n > 0.0).then(|| (sum / n).sqrt() * 1e-3)
    }

    /// Half the 95 % interval of that RMS, um. The variance of noise in a record of the length T has the variance 1/T times the integral
    /// of the squared one-sided power density (Bartlett). An error that goes with a moving target is no such noise: there it is the
    /// scatter between pieces of the record, each of whole periods.
    pub(super) fn rms_ci95_um(&self) -> Option<f64> {
        if self.target_moves {
            let period_s = self.period_rows() * self.period_s();
            let least_s = if period_s.is_finite() { period_s } else { 0.0 };
            let pieces = self.counted_nm.pieces(least_s);
            let half = half95(&pieces) / (2.0 * self.rms_um()? * 1e3);
            return half.is_finite().then_some(half * 1e-3);
        }
        let spectrum = self.error_um.spectrum(self.period_s())?;
        let [first, second, ..] = spectrum.hz.as_slice() else {
            return None;
        };
        let squares: f64 = spectrum.nm_per_rthz.iter().map(|nm| nm.powi(4)).sum();
        let variance_sd = (squares * (second - first) / self.counted_s()).sqrt();
        let rms_nm = self.rms_um()? * 1e3;
        Some(Z95 * variance_sd / (2.0 * rms_nm) * 1e-3)
    }

    /// Mean error, um.
    pub(super) fn mean_um(&self) -> Option<f64> {
        let (n, sum) = self.sums(Statistics::mean_error_nm);
        (n > 0.0).then(|| sum / n * 1e-3)
    }

    /// Number of positions, and the sum of their sessions' means.
    fn sums(&self, of: impl Fn(&Statistics) -> Option<f64>) -> (f64, f64) {
        self.statistics
            .iter()
            .filter_map(|statistics| Some((statistics.positions() as f64, of(statistics)?)))
            .fold((0.0, 0.0), |(n, sum), (m, mean)| (n + m, sum + m * mean))
    }

    /// Largest error, um.
    pub(super) fn peak_um(&self) -> Option<f64> {
        let peaks = self.statistics.iter().filter_map(Statistics::peak_error_nm);
        peaks.reduce(f64::max).map(|nm| nm * 1e-3)
    }
}
