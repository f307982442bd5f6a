//! A long trace, drawn by the smallest and largest value of each stretch: no peak is lost, whatever the length.

/// Stretches kept, at most twice this many.
const STRETCHES: usize = 5_000;

/// Smallest and largest values of `N` columns over stretches of equal numbers of rows.
#[derive(Debug)]
pub struct Envelope<const N: usize> {
    stretches: Vec<Stretch<N>>,
    /// Rows in a whole stretch.
    rows: u64,
}

#[derive(Debug, Clone, Copy)]
struct Stretch<const N: usize> {
    /// First row, s.
    time_s: f64,
    rows: u64,
    low: [f64; N],
    high: [f64; N],
    /// Nothing is joined across a gap in the record.
    last_before_gap: bool,
}

impl<const N: usize> Default for Envelope<N> {
    fn default() -> Self {
        Self {
            stretches: Vec::new(),
            rows: 1,
        }
    }
}

impl<const N: usize> Envelope<N> {
    /// The record has a gap here.
    pub fn gap(&mut self) {
        if let Some(last) = self.stretches.last_mut() {
            last.last_before_gap = true;
        }
    }

    /// The next row; values that are not finite count as missing.
    pub fn add(&mut self, time_s: f64, values: [f64; N]) {
        match self.stretches.last_mut() {
            Some(last) if last.rows < self.rows && !last.last_before_gap => last.take(values),
            _ => {
                let mut new = Stretch {
                    time_s,
                    rows: 0,
                    low: [f64::NAN; N],
                    high: [f64::NAN; N],
                    last_before_gap: false,
                };
                new.take(values);
                self.stretches.push(new);
            }
        }
        if self.stretches.len() > 2 * STRETCHES {
            self.halve();
        }
    }

    fn halve(&mut self) {
        self.rows *= 2;
        let mut joined: Vec<Stretch<N>> = Vec::with_capacity(self.stretches.len());
        for stretch in &self.stretches {
            match joined.last_mut() {
                Some(last) if last.rows + stretch.rows <= self.rows && !last.last_before_gap => {
                    last.take(stretch.low);
                    last.take(stretch.high);
                    // Two rows were counted above for those of the stretch.
                    last.rows = last.rows + stretch.rows - 2;
                    last.last_before_gap = stretch.last_before_gap;
                }
                _ => joined.push(*stretch),
            }
        }
        self.stretches = joined;
    }

    /// Rows of a stretch.
    pub fn rows(&self) -> u64 {
        self.rows
    }

    /// Times, each twice, and after a gap once more.
    pub fn times_s(&self) -> Vec<f64> {
        self.points(|stretch| [stretch.time_s; 2])
    }

    /// Smallest and largest value of a column in turn; NaN at a gap.
    pub fn column(&self, column: usize) -> Vec<f64> {
        let at = |values: &[f64; N]| values.get(column).copied().unwrap_or(f64::NAN);
        self.points(|stretch| [at(&stretch.low), at(&stretch.high)])
    }

    fn points(&self, of: impl Fn(&Stretch<N>) -> [f64; 2]) -> Vec<f64> {
        // A stretch of one row is a point.
        let single = self.rows == 1;
        let mut all = Vec::with_capacity(2 * self.stretches.len());
        for stretch in &self.stretches {
            let [low, high] = of(stretch);
            all.push(low);
            if !single {
                all.push(high);
            }
            if stretch.last_before_gap {
                all.push(f64::NAN);
            }
        }
        all
    }
}

impl<const N: usize> Stretch<N> {
    fn take(&mut self, values: [f64; N]) {
        self.rows += 1;
        for ((low, high), value) in self.low.iter_mut().zip(&mut self.high).zip(values) {
            // min and max of a number and NaN are the number.
            *low = low.min(value);
            *high = high.max(value);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_peaks_of_a_long_record_stay_and_gaps_show() {
        let mut envelope = Envelope::<1>::default();
        for k in 0..100_000 {
            let value = match k {
                12_345 => 9.0,
                77_777 => -7.0,
                500 => f64::NAN,
                _ => 0.0,
            };
            if k == 50_000 {
                envelope.gap();
            }
            envelope.add(f64::from(k) * 1e-3, [value]);
        }
        let (times, values) = (envelope.times_s(), envelope.column(0));
        assert_eq!(times.len(), values.len());
        assert!(times.len() <= 4 * STRETCHES + 2, "{}", times.len());
        let finite = || values.iter().copied().filter(|value| value.is_finite());
        assert_eq!(finite().fold(0.0, f64::max), 9.0);
        assert_eq!(finite().fold(0.0, f64::min), -7.0);
        let at = values.iter().position(|value| *value == 9.0).unwrap();
        assert!((times[at] - 12.345).abs() < 1e-3 * envelope.rows() as f64);
        assert_eq!(values.iter().filter(|value| value.is_nan()).count(), 1);
        let joined = envelope.stretches.iter().map(|one| one.rows).sum::<u64>();
        assert_eq!(joined, 100_000);
    }
}
