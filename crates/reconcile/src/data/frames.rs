//! Frames that are missing or come twice: counted, not simulated.

use crate::data::record::Record;
use crate::thresholds::THRESHOLDS;
use std::collections::BTreeMap;

/// What was counted.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct FrameCounts {
    /// Rows that no stall of the machine leaves in doubt, and how many of them are without a frame.
    pub rows: usize,
    pub missing: usize,
    /// Runs of missing frames. A camera or a line that stalls once loses many frames in one run.
    pub gaps: usize,
    pub pairs: usize,
    pub repeats: usize,
    /// Exact zero increments that the resolution of the file gives by chance.
    pub by_chance: f64,
    /// Runs of repeats that follow a run in the same record, and how many follow at the commonest distance.
    pub runs: usize,
    pub in_rhythm: usize,
    /// Repeats in runs longer than a camera's stutter.
    pub at_rest: usize,
    /// The positions come in steps that are not small compared with their increments.
    pub quantised: bool,
    /// Whether rows are frames of a camera, whose faults have names; else they are rows of a logger.
    pub of_camera: bool,
    /// Rows that repeat the one before, per record.
    pub repeated: Vec<Vec<bool>>,
}

impl FrameCounts {
    pub(crate) fn drop_rate(&self) -> f64 {
        self.missing as f64 / self.rows.max(1) as f64
    }

    pub(crate) fn repeat_rate(&self) -> f64 {
        ((self.repeats as f64 - self.by_chance) / self.pairs.max(1) as f64).max(0.0)
    }

    /// Counts the missing frames of a record. A stall of the machine leaves rows in doubt and loses the frames beside them. A camera
    /// loses frames everywhere alike, so that rows that are not beside a stall tell its rate.
    fn count_missing(&mut self, r: &Record) {
        // Rows before the first bead and after the last say nothing of the camera.
        let seen = |b: &f64| b.is_finite();
        let first = r.bead_um.iter().position(seen).unwrap_or(0);
        let end = r.bead_um.iter().rposition(seen).map_or(0, |last| last + 1);
        let is = |flags: &[bool], k: usize| flags.get(k).is_some_and(|flag| *flag);
        let mut in_doubt: Vec<bool> = (first..end)
            .map(|k| is(&r.unseen, k) || is(&r.late_command, k))
            .collect();
        let missing: Vec<bool> = (r.bead_um[first..end].iter().zip(&in_doubt))
            .map(|(bead, in_doubt)| bead.is_nan() && !in_doubt)
            .collect();
        let rows = missing.len();
        for k in 1..rows {
            in_doubt[k] |= missing[k] && in_doubt[k - 1];
        }
        for k in (1..rows).rev() {
            in_doubt[k - 1] |= missing[k - 1] && in_doubt[k];
        }
        let in_doubt = |k: usize| in_doubt.get(k).is_some_and(|in_doubt| *in_doubt);
        for k in (0..rows).filter(|&k| ![k.wrapping_sub(1), k, k + 1].into_iter().any(in_doubt)) {
            self.rows += 1;
            self.missing += usize::from(missing[k]);
            // The first row shows a bead.
            self.gaps += usize::from(missing[k] && !missing[k - 1]);
        }
    }

    /// More losses than a start-up glitch and a stall. The effect loses each frame by itself, so what counts is how often, not how many.
    pub(crate) fn drops_named(&self) -> bool {
        self.of_camera
            && self.gaps >= THRESHOLDS.faults_least
            && self.gaps as f64 > THRESHOLDS.faults_rate * self.rows as f64
    }

    /// Beyond chance by five standard deviations and by a half of what chance gives.
    pub(crate) fn repeats_named(&self) -> bool {
        let excess = self.repeats as f64 - self.by_chance;
        self.of_camera
            && self.repeats >= THRESHOLDS.faults_least
            && excess > THRESHOLDS.repeats_sd * (self.by_chance + 1.0).sqrt()
            && excess > THRESHOLDS.repeats_share * self.by_chance
            && self.repeat_rate() > THRESHOLDS.faults_rate
            && self.looks_like_a_camera()
    }

    /// A sensor that counts, rows that were held, and a plant that stands still also give equal rows. Those come often, in a
    /// rhythm, or for long. Faults of a camera come seldom and by chance, alone or a few at a time.
    fn looks_like_a_camera(&self) -> bool {
        let rate = self.repeats as f64 / self.pairs.max(1) as f64;
        !self.quantised
            && rate < THRESHOLDS.repeats_most
            && self.in_rhythm as f64 <= THRESHOLDS.repeats_rhythm * self.runs as f64 + 2.0
            && 2 * self.at_rest < self.repeats
    }
}

/// Repeats in a row beyond which nothing moves, or the stream has stopped: no stutter of a camera.
const STUTTER: usize = 10;

/// Counts missing frames and exact repeats.
pub(crate) fn count(records: &[Record], of_camera: bool) -> FrameCounts {
    let mut c = FrameCounts {
        rows: 0,
        missing: 0,
        gaps: 0,
        pairs: 0,
        repeats: 0,
        by_chance: 0.0,
        runs: 0,
        in_rhythm: 0,
        at_rest: 0,
        of_camera,
        quantised: records.iter().any(Record::is_quantised),
        repeated: Vec::new(),
    };
    let mut distances: BTreeMap<usize, usize> = BTreeMap::new();
    for r in records {
        let n = r.rows();
        c.count_missing(r);
        let mut repeated = vec![false; n];
        let steps = Steps::of(r);
        let mut near = 0usize;
        for (k, repeats) in repeated.iter_mut().enumerate().skip(1) {
            let (a, b) = (r.bead_um[k - 1], r.bead_um[k]);
            if a.is_nan() || b.is_nan() {
                continue;
            }
            c.pairs += 1;
            let d = (b - a).abs();
            let step = steps.at(b);
            if d == 0.0 || d < 1e-3 * step {
                *repeats = true;
                c.repeats += 1;
            } else if step > 0.0 && d < 10.5 * step {
                near += 1;
            }
        }
        // Twenty neighbouring values of the increment, each as likely as zero by chance.
        c.by_chance += near as f64 / 20.0;
        let mut start = 0;
        let mut last = None;
        for run in repeated.chunk_by(|a, b| a == b) {
            if run[0] {
                if run.len() > STUTTER {
                    c.at_rest += run.len();
                }
                if let Some(last) = last.replace(start) {
                    c.runs += 1;
                    *distances.entry(start - last).or_default() += 1;
                }
            }
            start += run.len();
        }
        c.repeated.push(repeated);
    }
    c.in_rhythm = distances.into_values().max().unwrap_or(0);
    c
}

/// The step of written positions. With a fixed number of decimals it is constant; with a fixed number of digits it grows with the
/// position.
struct Steps {
    finest: f64,
    /// Smallest increment by the position's power of two.
    by_size: BTreeMap<i32, f64>,
}

impl Steps {
    fn of(r: &Record) -> Self {
        let mut by_size: BTreeMap<i32, f64> = BTreeMap::new();
        for w in r.bead_um.windows(2) {
            let (d, power) = ((w[1] - w[0]).abs(), power_of_two(w[1]));
            // A difference by rounding in the arithmetic is no step.
            let counts = d.is_finite() && d > 1e-12 * w[1].abs();
            if counts && power == power_of_two(w[0]) {
                let least = by_size.entry(power).or_insert(d);
                *least = least.min(d);
            }
        }
        // A step does not become finer for larger positions, and grows by tens. So the neighbours show a step that a size with few
        // rows may have missed.
        let told = by_size.clone();
        for (power, step) in &mut by_size {
            for (other, least) in &told {
                let decades = (f64::from(power - other) * std::f64::consts::LOG10_2)
                    .ceil()
                    .max(0.0);
                *step = step.min(least * 10f64.powf(decades));
            }
        }
        Self {
            finest: r.resolution_um,
            by_size,
        }
    }

    fn at(&self, position_um: f64) -> f64 {
        let here = self.by_size.get(&power_of_two(position_um));
        here.map_or(self.finest, |step| step.max(self.finest))
    }
}

fn power_of_two(x: f64) -> i32 {
    x.abs().max(f64::MIN_POSITIVE).log2().floor() as i32
}

/// 95 % interval of a rate (Wilson).
pub(crate) fn wilson(k: f64, n: f64) -> [f64; 2] {
    let z = 1.96;
    let p = k / n;
    let d = 1.0 + z * z / n;
    let m = p + z * z / (2.0 * n);
    let w = z * (p * (1.0 - p) / n + z * z / (4.0 * n * n)).sqrt();
    [((m - w) / d).max(0.0), ((m + w) / d).min(1.0)]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_that_are_alike_because_of_six_digits_in_all_are_no_repeats_of_a_camera() {
        // A ramp to 900 with noise of 0.05, as other programs write it.
        let mut random = cellpos_numeric::Random::new(1);
        let y: Vec<f64> = (0..60_000)
            .map(|k| {
                let chance = random.uniform() - 0.5;
                let value: f64 = 0.015 * f64::from(k) + 0.1 * chance;
                format!("{value:.5e}").parse().unwrap()
            })
            .collect();
        let t: Vec<f64> = (0..60_000).map(f64::from).collect();
        let mut r = Record::from_rows("r", &t, &t, &y).unwrap();
        let counts = count(std::slice::from_ref(&r), true);
        assert!(counts.repeats > 50, "{}", counts.repeats);
        assert!(
            !counts.repeats_named(),
            "{} {}",
            counts.repeats,
            counts.by_chance
        );
        // The same, and a camera that gives every hundredth frame twice.
        for k in (100..60_000).step_by(100) {
            r.bead_um[k] = r.bead_um[k - 1];
        }
        assert!(count(std::slice::from_ref(&r), true).repeats_named());
        assert!(!count(&[r], false).repeats_named());
    }

    /// A random walk in which the rows that `repeats` says are those before them.
    fn walk(rows: usize, repeats: impl Fn(usize, f64) -> bool) -> Record {
        let mut random = cellpos_numeric::Random::new(11);
        let mut chance = || random.uniform();
        let (mut y, mut x) = (vec![0.0; rows], 0.0);
        for k in 1..rows {
            x += 0.1 * (chance() - 0.5);
            y[k] = if repeats(k, chance()) { y[k - 1] } else { x };
        }
        let t: Vec<f64> = (0..rows).map(|k| k as f64 * 1e-3).collect();
        Record::from_rows("r", &t, &t, &y).unwrap()
    }

    #[test]
    fn a_stall_that_loses_many_frames_at_once_is_no_rate_of_drops() {
        let without = |lost: &dyn Fn(usize) -> bool| {
            let mut r = walk(40_000, |_, _| false);
            for (k, bead) in r.bead_um.iter_mut().enumerate() {
                if lost(k) {
                    *bead = f64::NAN;
                }
            }
            count(&[r], true)
        };
        let stall = without(&|k| (18_000..18_040).contains(&k));
        assert_eq!((stall.missing, stall.gaps), (40, 1));
        assert!(!stall.drops_named());
        assert!(without(&|k| k % 1000 == 500).drops_named());
        // Many short bursts are a fault of the camera, or of a machine that was late then.
        assert!(without(&|k| k % 2000 < 3).drops_named());
        // A machine that stalls: late commands, frames that come too late, and frames that are lost before and after.
        let mut stalls = walk(40_000, |_, _| false);
        let place = |k: usize| k % 2000;
        stalls.late_command = (0..40_000).map(|k| place(k) == 2).collect();
        stalls.unseen = (0..40_000).map(|k| place(k) == 3).collect();
        let mut both = stalls.clone();
        for k in 0..40_000 {
            if place(k) < 6 {
                stalls.bead_um[k] = f64::NAN;
            }
            if place(k) < 6 || place(k) == 1000 {
                both.bead_um[k] = f64::NAN;
            }
        }
        assert_eq!(count(&[stalls], true).missing, 0);
        let both = count(&[both], true);
        assert_eq!((both.missing, both.gaps), (20, 20));
        assert!(both.drops_named());
    }

    #[test]
    fn frames_that_come_thrice_are_a_fault_and_rows_held_in_a_rhythm_or_for_long_are_none() {
        let named = |r: Record| count(&[r], true).repeats_named();
        let last = std::cell::Cell::new(0);
        let bursts = walk(20_000, |k, chance| {
            if chance < 0.01 {
                last.set(k);
            }
            last.get() > 0 && k <= last.get() + 1
        });
        assert!(named(bursts));
        assert!(named(walk(20_000, |_, chance| chance < 0.02)));
        // A sensor of 800 Hz in a log of 1 kHz; one that stands still for a tenth of a second now and then.
        assert!(!named(walk(20_000, |k, _| k % 5 == 4)));
        assert!(!named(walk(20_000, |k, _| k % 1003 > 900)));
    }

    #[test]
    fn the_rate_of_repeats_is_right_of_a_bead_that_crosses_zero() {
        // A bead about zero, in fine steps. Few rows are of any one small size, and their least increment is no step.
        let mut random = cellpos_numeric::Random::new(5);
        let mut y: Vec<f64> = (0..20_000)
            .map(|k| {
                let chance = random.uniform() - 0.5;
                let value = 0.3 * (1e-3 * f64::from(k)).sin() + 0.2 * chance;
                (value * 1e6).round() * 1e-6
            })
            .collect();
        for k in (1000..y.len()).step_by(1000) {
            y[k] = y[k - 1];
        }
        let t: Vec<f64> = (0..y.len()).map(|k| k as f64 * 1e-3).collect();
        let counts = count(&[Record::from_rows("r", &t, &t, &y).unwrap()], true);
        assert!(
            (counts.repeat_rate() - 19.0 / 20_000.0).abs() < 1e-4,
            "{} of {} repeats by chance",
            counts.by_chance,
            counts.repeats
        );
    }
}
