//! Records as the workflow sees them: an even time grid, the command in micrometres, the bead where there was one.

use crate::data::resolution::resolution;
use crate::error::ReconcileError;
use crate::simulate::slew;
use crate::thresholds::THRESHOLDS;
use cellpos_numeric::fft;

/// One record on an even grid.
#[derive(Debug, Clone, PartialEq)]
pub struct Record {
    /// Name shown in results, for example the file's stem.
    pub name: String,
    /// Sample time \[s\].
    pub sample_s: f64,
    /// Time stamp of the first row \[s\].
    pub start_s: f64,
    /// Displacement commanded from each row on \[um\].
    pub pzt_um: Vec<f64>,
    /// Bead position just before that command acts \[um\]; NaN without a bead.
    pub bead_um: Vec<f64>,
    /// Rows that were missing from the record and were filled in (their command is interpolated).
    pub filled: Vec<bool>,
    /// Finest step of the position column \[um\], for telling repeats from chance.
    pub resolution_um: f64,
    /// Rows whose frame is known to have come, though it showed no bead that could be trusted: it was not dropped.
    pub unseen: Vec<bool>,
    /// From the middle of the exposure of each row's frame to the row's command \[s\], by the stamps; NaN for a row without a frame,
    /// empty if it is not known.
    pub frame_age_s: Vec<f64>,
    /// Rows in a stall of the machine: when their command acted, and so how it moved the bead, is not known.
    pub late_command: Vec<bool>,
    /// Standard deviation of the motion to each row from the row before that late commands leave open, although it is known when they
    /// acted \[um\]; NaN where that is not known, empty if it is nowhere.
    pub late_motion_um: Vec<f64>,
    /// Exposure of every frame about its middle, if it is known \[s\]; else 0.
    pub exposure_s: f64,
    /// Largest speed of the displacement that the board allows, if it is known \[um/s\]; else 0.
    pub slew_um_per_s: f64,
}

impl Record {
    /// Puts rows on an even grid. Rows missing in time are filled in without a bead; a time stamp that comes twice is
    /// kept once.
    ///
    /// # Errors
    /// Columns of different length, fewer than 16 rows, times that do not rise or are not even, values not finite.
    pub fn from_rows(
        name: &str,
        time_s: &[f64],
        pzt_um: &[f64],
        bead_um: &[f64],
    ) -> Result<Self, ReconcileError> {
        let bad = |row: usize, message: String| ReconcileError::Record {
            record: name.to_owned(),
            row,
            message,
        };
        let n = time_s.len();
        if pzt_um.len() != n || bead_um.len() != n {
            return Err(bad(
                0,
                format!(
                    "columns of {n}, {} and {} rows",
                    pzt_um.len(),
                    bead_um.len()
                ),
            ));
        }
        if n < 16 {
            return Err(bad(
                n,
                format!("{n} rows are too few to say anything: at least 16 are needed"),
            ));
        }
        for k in 0..n {
            if !time_s[k].is_finite() {
                return Err(bad(k, "time_s is not a finite number".to_owned()));
            }
            if !pzt_um[k].is_finite() {
                return Err(bad(k, "pzt_um is not a finite number".to_owned()));
            }
            if bead_um[k].is_infinite() {
                return Err(bad(k, "bead_um is infinite".to_owned()));
            }
        }
        let mut steps: Vec<f64> = time_s
            .windows(2)
            .map(|w| w[1] - w[0])
            .filter(|d| *d > 0.0)
            .collect();
        if steps.is_empty() {
            return Err(bad(0, "time_s does not rise".to_owned()));
        }
        steps.sort_by(f64::total_cmp);
        let rough = steps[steps.len() / 2];
        // The grid's step from the whole span, so that rounded time stamps do not add up.
        let span = time_s[n - 1] - time_s[0];
        let count = (span / rough).round();
        let sample_s = if count >= 1.0 { span / count } else { rough };
        let sample_s = if (sample_s / rough - 1.0).abs() < 0.02 {
            sample_s
        } else {
            rough
        };
        let rows = (span / sample_s).round() as usize + 1;
        if rows > 20 * n + 1000 {
            return Err(bad(
                0,
                format!(
                    "{rows} sample times of {sample_s} s but only {n} rows: the record is mostly gaps"
                ),
            ));
        }
        let mut pzt = vec![f64::NAN; rows];
        let mut bead = vec![f64::NAN; rows];
        let mut last = -1i64;
        for k in 0..n {
            let x = (time_s[k] - time_s[0]) / sample_s;
            let i = x.round() as i64;
            if i < last {
                return Err(bad(k, format!("time_s goes back to {} s", time_s[k])));
            }
            if i == last || i as usize >= rows {
                continue;
            }
            last = i;
            pzt[i as usize] = pzt_um[k];
            bead[i as usize] = bead_um[k];
        }
        let filled: Vec<bool> = pzt.iter().map(|v| v.is_nan()).collect();
        fill(&mut pzt);
        let resolution_um = resolution(&bead);
        Ok(Self {
            name: name.to_owned(),
            sample_s,
            start_s: time_s[0],
            pzt_um: pzt,
            bead_um: bead,
            filled,
            resolution_um,
            unseen: vec![false; rows],
            frame_age_s: Vec::new(),
            late_command: vec![false; rows],
            late_motion_um: Vec::new(),
            exposure_s: 0.0,
            slew_um_per_s: 0.0,
        })
    }

    /// Number of rows.
    pub fn rows(&self) -> usize {
        self.pzt_um.len()
    }

    /// Duration \[s\].
    pub fn duration_s(&self) -> f64 {
        self.rows() as f64 * self.sample_s
    }

    /// Rows with a bead.
    pub fn frames(&self) -> usize {
        self.bead_um.iter().filter(|b| b.is_finite()).count()
    }

    /// Whether the command never changes.
    pub fn is_rest(&self) -> bool {
        let (low, high) = self.pzt_range_um();
        self.rests_within(1e-12 * low.abs().max(high.abs()))
    }

    /// Whether the command stays within a range: a measured one is never quite still.
    pub(crate) fn rests_within(&self, range_um: f64) -> bool {
        let (low, high) = self.pzt_range_um();
        high - low <= range_um
    }

    /// Whether another record has the same command, within the noise of a measured one.
    pub(crate) fn same_command(&self, other: &Self) -> bool {
        let n = self.rows().min(other.rows());
        if n < 50 || self.rows().abs_diff(other.rows()) > n / 50 {
            return false;
        }
        let d: f64 = self.pzt_um[..n]
            .iter()
            .zip(&other.pzt_um[..n])
            .map(|(a, b)| (a - b).powi(2))
            .sum();
        let share = THRESHOLDS.repeat_share;
        let power = variance(&self.pzt_um[..n]);
        power > 0.0 && d / n as f64 <= share * share * power
    }

    /// Whether the positions come in steps that are not small compared with their increments: a sensor that counts.
    pub fn is_quantised(&self) -> bool {
        let mut sizes: Vec<f64> = self
            .bead_um
            .windows(2)
            .map(|w| (w[1] - w[0]).abs())
            .filter(|d| d.is_finite() && *d > 0.0)
            .collect();
        if sizes.len() < 20 {
            return false;
        }
        let middle = sizes.len() / 2;
        let (_, median, _) = sizes.select_nth_unstable_by(middle, f64::total_cmp);
        *median < 8.0 * self.resolution_um
    }

    /// Smallest and largest command \[um\].
    pub fn pzt_range_um(&self) -> (f64, f64) {
        self.pzt_um
            .iter()
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), &v| {
                (a.min(v), b.max(v))
            })
    }

    /// Largest excursion of the position from its start \[um\].
    pub fn travel_um(&self) -> f64 {
        let mut seen = self.bead_um.iter().filter(|b| b.is_finite());
        let start = seen.next().copied().unwrap_or(0.0);
        seen.map(|b| (b - start).abs()).fold(0.0, f64::max)
    }

    /// The smallest period, in rows, at which the whole command repeats itself within the noise of a measured one; `None`
    /// without one (or at rest).
    ///
    /// A multisine may need one period of run-in: the later part alone may repeat.
    pub fn period_rows(&self) -> Option<usize> {
        let n = self.rows();
        let u = &self.pzt_um;
        let power = variance(u);
        if n < 60 || power <= 0.0 || self.is_rest() {
            return None;
        }
        let limit = THRESHOLDS.repeat_share.powi(2) * power;
        let apart = differences(u);
        let mut away = false;
        for p in 1..=n / 2 {
            // The command must have gone somewhere before it can be said to have come back.
            away |= apart[p] > 0.25 * power;
            let least =
                apart[p] <= apart[p - 1] && apart.get(p + 1).is_none_or(|next| apart[p] <= *next);
            if !away || p < 20 || !least {
                continue;
            }
            let from = |shift: usize, first: usize| {
                let d: f64 = (first..n).map(|k| (u[k] - u[k - shift]).powi(2)).sum();
                d / (n - first).max(1) as f64
            };
            // The run-in counts for one period in all.
            let start = if n >= 4 * p { 2 * p } else { p };
            if apart[p] > limit && (start == p || from(p, start) > limit) {
                continue;
            }
            let once = from(p, start);
            // Noise is the same whatever lies between; a sine that swells is off by twice as much after twice the time.
            let steady = n < 4 * p || once < 1e-6 * power || from(2 * p, start) < 2.5 * once;
            return steady.then_some(p);
        }
        None
    }

    /// Mean displacement of each row behind the board's slew limit, from a working point \[um\].
    pub(crate) fn displacement_um(&self, working_point_um: f64) -> Vec<f64> {
        let mut u: Vec<f64> = self.pzt_um.iter().map(|v| v - working_point_um).collect();
        if self.slew_um_per_s > 0.0 {
            let first = u[0];
            slew(&mut u, self.slew_um_per_s, self.sample_s, first);
        }
        u
    }

    /// The part of a record between two rows, as a separate record.
    pub fn part(&self, from: usize, to: usize) -> Self {
        let part_of = |known: &[f64]| known.get(from..to).map_or_else(Vec::new, <[f64]>::to_vec);
        Self {
            name: self.name.clone(),
            sample_s: self.sample_s,
            start_s: self.start_s + from as f64 * self.sample_s,
            pzt_um: self.pzt_um[from..to].to_vec(),
            bead_um: self.bead_um[from..to].to_vec(),
            filled: self.filled[from..to].to_vec(),
            resolution_um: self.resolution_um,
            unseen: self.unseen[from..to].to_vec(),
            frame_age_s: part_of(&self.frame_age_s),
            late_command: self.late_command[from..to].to_vec(),
            late_motion_um: part_of(&self.late_motion_um),
            exposure_s: self.exposure_s,
            slew_um_per_s: self.slew_um_per_s,
        }
    }
}

/// Range of the command over all records \[um\].
pub(crate) fn command_range_um(records: &[Record]) -> f64 {
    let (low, high) = records
        .iter()
        .map(Record::pzt_range_um)
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), (c, d)| {
            (a.min(c), b.max(d))
        });
    (high - low).max(0.0)
}

/// Variance about the mean.
pub(crate) fn variance(x: &[f64]) -> f64 {
    let n = x.len().max(1) as f64;
    let mean = x.iter().sum::<f64>() / n;
    x.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n
}

/// Mean square of `x_k - x_(k-p)` for every shift p up to half the length, through the autocorrelation.
pub(crate) fn differences(x: &[f64]) -> Vec<f64> {
    let n = x.len();
    let mean = x.iter().sum::<f64>() / n as f64;
    let size = (2 * n).next_power_of_two();
    let mut padded = vec![0.0; size];
    for (p, v) in padded.iter_mut().zip(x) {
        *p = v - mean;
    }
    let squares: Vec<f64> = padded[..n].iter().map(|v| v * v).collect();
    let mut spectrum = fft::forward(&mut padded);
    for s in &mut spectrum {
        *s = (s.norm_sqr()).into();
    }
    let correlation = fft::inverse(&mut spectrum, size);
    let (mut head, mut tail) = (squares.iter().sum::<f64>(), squares.iter().sum::<f64>());
    let mut out = Vec::with_capacity(n / 2 + 1);
    for p in 0..=n / 2 {
        if p > 0 {
            head -= squares[n - p];
            tail -= squares[p - 1];
        }
        let r = correlation[p] / size as f64;
        out.push(((head + tail - 2.0 * r) / (n - p) as f64).max(0.0));
    }
    out
}

/// Sorts records by their content, so that the order of the files does not matter, and joins parts of one record. A part belongs
/// to another if it starts one sample after its end, at a place to which the bead could have moved.
pub(crate) fn canonical(mut records: Vec<Record>) -> Vec<Record> {
    let key = |r: &Record| -> Vec<u64> {
        let mut k: Vec<u64> = vec![r.start_s.to_bits(), r.rows() as u64];
        k.extend(
            r.pzt_um
                .iter()
                .chain(r.bead_um.iter())
                .step_by(r.rows() / 16 + 1)
                .map(|v| v.to_bits()),
        );
        k
    };
    records.sort_by(|a, b| {
        a.start_s
            .total_cmp(&b.start_s)
            .then_with(|| key(a).cmp(&key(b)))
    });
    let mut joined: Vec<Record> = Vec::new();
    for r in records {
        let last_bead = |j: &Record| {
            j.bead_um
                .iter()
                .rev()
                .take(5)
                .copied()
                .find(|b| b.is_finite())
        };
        let first_bead = r.bead_um.iter().take(5).copied().find(|b| b.is_finite());
        let before = joined
            .iter()
            .enumerate()
            .filter(|(_, j)| {
                let end = j.start_s + j.rows() as f64 * j.sample_s;
                (r.start_s - end).abs() < 0.2 * r.sample_s
                    && (j.sample_s / r.sample_s - 1.0).abs() < 1e-3
            })
            .filter_map(|(i, j)| Some((i, (last_bead(j)? - first_bead?).abs())))
            // The bead does not jump between two samples: a few micrometres at most at full drive.
            .filter(|(_, gap)| *gap < 3.0)
            .min_by(|a, b| a.1.total_cmp(&b.1))
            .map(|(i, _)| i);
        match before {
            Some(i) => {
                let j = &mut joined[i];
                let rows = [j.rows(), j.rows() + r.rows()];
                for (of_j, of_r) in [
                    (&mut j.frame_age_s, &r.frame_age_s),
                    (&mut j.late_motion_um, &r.late_motion_um),
                ] {
                    if !of_j.is_empty() || !of_r.is_empty() {
                        of_j.resize(rows[0], f64::NAN);
                        of_j.extend_from_slice(of_r);
                        of_j.resize(rows[1], f64::NAN);
                    }
                }
                j.late_command.extend_from_slice(&r.late_command);
                j.pzt_um.extend_from_slice(&r.pzt_um);
                j.bead_um.extend_from_slice(&r.bead_um);
                j.filled.extend_from_slice(&r.filled);
                j.unseen.extend_from_slice(&r.unseen);
                j.resolution_um = j.resolution_um.min(r.resolution_um);
                if r.name < j.name {
                    j.name = r.name;
                }
            }
            None => joined.push(r),
        }
    }
    joined.sort_by(|a, b| a.name.cmp(&b.name).then_with(|| key(a).cmp(&key(b))));
    joined
}

/// Fills gaps of the command: from one period away where the command repeats itself, else straight between neighbours.
fn fill(u: &mut [f64]) {
    if !u.iter().any(|v| v.is_nan()) {
        return;
    }
    let n = u.len();
    let known: Vec<f64> = u.to_vec();
    let scale = known
        .iter()
        .filter(|v| v.is_finite())
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), &v| {
            (a.min(v), b.max(v))
        });
    // Values that were rounded differ by their last digit.
    let tolerance = 1e-4 * (scale.1 - scale.0) + 1.1 * resolution(&known);
    let agrees = |p: usize| {
        (p..n).step_by(3).all(|k| {
            known[k].is_nan()
                || known[k - p].is_nan()
                || (known[k] - known[k - p]).abs() <= tolerance
        })
    };
    let period = (20..=n / 2).find(|&p| agrees(p));
    let mut k = 0;
    while k < n {
        if !u[k].is_nan() {
            k += 1;
            continue;
        }
        let mut end = k;
        while end < n && known[end].is_nan() {
            end += 1;
        }
        for i in k..end {
            let mut value = f64::NAN;
            if let Some(p) = period {
                let mut j = i % p;
                while j < n && value.is_nan() {
                    value = known[j];
                    j += p;
                }
            }
            if value.is_nan() {
                let (a, b) = (
                    if k > 0 { u[k - 1] } else { f64::NAN },
                    if end < n { known[end] } else { f64::NAN },
                );
                value = match (a.is_nan(), b.is_nan()) {
                    (false, false) => a + (b - a) * (i + 1 - k) as f64 / (end + 1 - k) as f64,
                    (false, true) => a,
                    (true, false) => b,
                    (true, true) => 0.0,
                };
            }
            u[i] = value;
        }
        k = end;
    }
}
