//! Frames that are missing or come twice: counted, not simulated.

use crate::data::record::Record;
use crate::thresholds::THRESHOLDS;

/// What was counted.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct FrameCounts {
    pub rows: usize,
    pub missing: usize,
    pub pairs: usize,
    pub repeats: usize,
    /// Exact zero increments that the resolution of the file gives by chance.
    pub by_chance: f64,
    /// Repeats of a row that is a repeat itself.
    pub in_a_row: usize,
    /// The positions come in steps that are not small beside their increments.
    pub quantised: bool,
    /// Rows that repeat the one before, per record.
    pub repeated: Vec<Vec<bool>>,
}

impl FrameCounts {
    pub fn drop_rate(&self) -> f64 {
        self.missing as f64 / self.rows.max(1) as f64
    }

    pub fn repeat_rate(&self) -> f64 {
        ((self.repeats as f64 - self.by_chance) / self.pairs.max(1) as f64).max(0.0)
    }

    /// More missing frames than a start-up glitch.
    pub fn drops_named(&self) -> bool {
        self.missing >= THRESHOLDS.faults_least && self.drop_rate() > THRESHOLDS.faults_rate
    }

    /// Beyond chance by five standard deviations and by a half of what chance gives.
    pub fn repeats_named(&self) -> bool {
        let excess = self.repeats as f64 - self.by_chance;
        self.repeats >= THRESHOLDS.faults_least
            && excess > THRESHOLDS.repeats_sd * (self.by_chance + 1.0).sqrt()
            && excess > THRESHOLDS.repeats_share * self.by_chance
            && self.repeat_rate() > THRESHOLDS.faults_rate
            && self.looks_like_a_camera()
    }

    /// A sensor that counts, a row that was held or interpolated, and a plant that stands still give equal rows as well: those
    /// come in runs or in a rhythm, camera faults one by one and seldom.
    fn looks_like_a_camera(&self) -> bool {
        let rate = self.repeats as f64 / self.pairs.max(1) as f64;
        let expected = rate * self.repeats as f64;
        !self.quantised
            && rate < THRESHOLDS.repeats_most
            && self.in_a_row as f64 <= 2.0 * expected + 5.0 * expected.sqrt() + 3.0
    }
}

/// Counts missing frames and exact repeats.
pub(crate) fn count(records: &[Record]) -> FrameCounts {
    let mut c = FrameCounts {
        rows: 0,
        missing: 0,
        pairs: 0,
        repeats: 0,
        by_chance: 0.0,
        in_a_row: 0,
        quantised: records.iter().any(Record::is_quantised),
        repeated: Vec::new(),
    };
    for r in records {
        let n = r.rows();
        // What lies before the first bead seen and behind the last says nothing of the camera.
        let seen = |b: &f64| b.is_finite();
        if let (Some(first), Some(last)) = (
            r.bead_um.iter().position(seen),
            r.bead_um.iter().rposition(seen),
        ) {
            c.rows += last - first + 1;
            let unseen = |k: usize| r.unseen.get(k).is_some_and(|u| *u);
            c.missing += (first..=last)
                .filter(|&k| r.bead_um[k].is_nan() && !unseen(k))
                .count();
        }
        let mut repeated = vec![false; n];
        let step = r.resolution_um;
        let mut near = 0usize;
        for (k, repeats) in repeated.iter_mut().enumerate().skip(1) {
            let (a, b) = (r.bead_um[k - 1], r.bead_um[k]);
            if a.is_nan() || b.is_nan() {
                continue;
            }
            c.pairs += 1;
            let d = (b - a).abs();
            if d == 0.0 || d < 1e-3 * step {
                *repeats = true;
                c.repeats += 1;
            } else if step > 0.0 && d < 10.5 * step {
                near += 1;
            }
        }
        // Twenty neighbouring values of the increment, each as likely as zero by chance.
        c.by_chance += near as f64 / 20.0;
        c.in_a_row += repeated.windows(2).filter(|w| w[0] && w[1]).count();
        c.repeated.push(repeated);
    }
    c
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
