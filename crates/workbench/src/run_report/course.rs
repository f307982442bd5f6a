//! The RMS of an error over the run: of each tenth of a second, of longer stretches in a longer run.

use cellpos_report::Series;

/// Most stretches; of more, two become one.
const MOST: usize = 256;

/// Sums of squares over stretches of equal time.
#[derive(Debug)]
pub(super) struct RmsCourse {
    stretches: Vec<(f64, u64)>,
    long_s: f64,
}

impl Default for RmsCourse {
    fn default() -> Self {
        Self {
            stretches: Vec::new(),
            long_s: 0.1,
        }
    }
}

impl RmsCourse {
    /// The next value; one that is not finite is left out.
    pub(super) fn add(&mut self, time_s: f64, value: f64) {
        if !value.is_finite() || !time_s.is_finite() || time_s < 0.0 {
            return;
        }
        while time_s / self.long_s >= MOST as f64 {
            let pairs = self.stretches.chunks(2);
            self.stretches = pairs
                .map(|two| {
                    two.iter()
                        .fold((0.0, 0), |sum, one| (sum.0 + one.0, sum.1 + one.1))
                })
                .collect();
            self.long_s *= 2.0;
        }
        let at = (time_s / self.long_s) as usize;
        if self.stretches.len() <= at {
            self.stretches.resize(at + 1, (0.0, 0));
        }
        if let Some((sum, count)) = self.stretches.get_mut(at) {
            *sum += value * value;
            *count += 1;
        }
    }

    /// How long each stretch is, s.
    pub(super) fn long_s(&self) -> f64 {
        self.long_s
    }

    /// Mean squares of whole pieces of at least this length, from the stretches without a gap.
    pub(super) fn pieces(&self, least_s: f64) -> Vec<f64> {
        let full = self.stretches.iter().map(|one| one.1).max().unwrap_or(0);
        // A tick more or less is chance.
        let whole: Vec<f64> = (self.stretches.iter())
            .filter(|(_, count)| 10 * count >= 9 * full && *count > 0)
            .map(|(sum, count)| sum / *count as f64)
            .collect();
        let joined = (least_s / self.long_s).ceil().clamp(1.0, 1e6) as usize;
        (whole.chunks_exact(joined))
            .map(|piece| piece.iter().sum::<f64>() / joined as f64)
            .collect()
    }

    /// RMS of each stretch at its middle; a gap where there was no value.
    pub(super) fn series(&self, label: &str) -> Series {
        let (x, y): (Vec<f64>, Vec<f64>) = (self.stretches.iter().enumerate())
            .map(|(n, (sum, count))| {
                let rms = if *count > 0 {
                    (sum / *count as f64).sqrt()
                } else {
                    f64::NAN
                };
                ((n as f64 + 0.5) * self.long_s, rms)
            })
            .unzip();
        Series::line(label, &x, &y)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_night_keeps_its_squares_in_few_stretches() {
        let mut course = RmsCourse::default();
        for k in 0..3_600 {
            // Nothing is known of the first minute.
            let value = if k < 60 { f64::NAN } else { f64::from(k % 2) };
            course.add(f64::from(k), value);
        }
        assert!(course.stretches.len() <= MOST && course.long_s() > 0.1);
        let (sum, count) = course
            .stretches
            .iter()
            .fold((0.0, 0), |all, one| (all.0 + one.0, all.1 + one.1));
        assert_eq!((sum, count), (1770.0, 3540));
        assert_eq!(course.stretches.first(), Some(&(0.0, 0)));
        // Pieces of a minute: the squares are 0 and 1 in turn.
        let pieces = course.pieces(60.0);
        assert!(pieces.len() > 40 && pieces.iter().all(|square| (square - 0.5).abs() < 0.02));
    }
}
