//! A long trace, drawn by the smallest, the largest and the median value of each stretch: no peak is lost, whatever the length.

/// Stretches kept, at most twice this many.
const STRETCHES: usize = 5_000;
/// Number of evenly spaced values kept for the median of a stretch. A column of a figure has about ten stretches, so its median
/// comes from at least fifty values, with an error below a fifth of their standard deviation.
const SAMPLES: usize = 8;
/// Columns of a figure: as many as it has px for.
const COLUMNS: usize = 700;

/// Columns of a period that is drawn as a wave: with fewer its peaks are off by more than a twentieth of its amplitude,
/// 1 - cos(pi / 10), and differ from period to period.
const DRAWN: f64 = 10.0;

/// A column as a figure shows it: an envelope and its middle, one entry for each stretch of time; NaN at a gap.
#[derive(Debug, Clone, PartialEq, Default)]
pub(super) struct Course {
    pub time_s: Vec<f64>,
    pub low: Vec<f64>,
    pub median: Vec<f64>,
    pub high: Vec<f64>,
}

impl Course {
    fn push(&mut self, time_s: f64, low: f64, median: f64, high: f64) {
        self.time_s.push(time_s);
        self.low.push(low);
        self.median.push(median);
        self.high.push(high);
    }
}

/// Smallest and largest values of `N` columns over stretches of equal numbers of rows.
#[derive(Debug)]
pub(super) struct Envelope<const N: usize> {
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
    /// Values for the median, and their number.
    samples: [[f64; N]; SAMPLES],
    sampled: usize,
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
    pub(super) fn gap(&mut self) {
        if let Some(last) = self.stretches.last_mut() {
            last.last_before_gap = true;
        }
    }

    /// The next row; values that are not finite count as missing.
    pub(super) fn add(&mut self, time_s: f64, values: [f64; N]) {
        match self.stretches.last_mut() {
            Some(last) if last.rows < self.rows && !last.last_before_gap => {
                // Evenly over the stretch: as many rows lie between two samples as it has room for.
                let every = self.rows.div_ceil(SAMPLES as u64);
                if last.rows.is_multiple_of(every) {
                    last.sample(values);
                }
                last.take(values);
            }
            _ => {
                let mut new = Stretch {
                    time_s,
                    rows: 0,
                    low: [f64::NAN; N],
                    high: [f64::NAN; N],
                    samples: [[f64::NAN; N]; SAMPLES],
                    sampled: 0,
                    last_before_gap: false,
                };
                new.sample(values);
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
                    last.join_samples(stretch);
                    last.last_before_gap = stretch.last_before_gap;
                }
                _ => joined.push(*stretch),
            }
        }
        self.stretches = joined;
    }

    /// A column for a figure of this width, px.
    pub(super) fn course(&self, column: usize) -> Course {
        self.course_of(column, f64::INFINITY)
    }

    /// The same of a motion that repeats after so many rows. Where a period has too few columns to be drawn, a column has whole
    /// periods, so that their beat with the columns is not drawn as if it were in the record.
    pub(super) fn course_of(&self, column: usize, period_rows: f64) -> Course {
        let at = |values: &[f64; N]| values.get(column).copied().unwrap_or(f64::NAN);
        let joined = self.joined(period_rows);
        let mut course = Course::default();
        for part in (self.stretches).chunk_by(|one, _| !one.last_before_gap) {
            for some in part.chunks(joined) {
                let (low, high) = some
                    .iter()
                    .fold((f64::NAN, f64::NAN), |(low, high), stretch| {
                        (low.min(at(&stretch.low)), high.max(at(&stretch.high)))
                    });
                let samples = some
                    .iter()
                    .flat_map(|stretch| stretch.samples.iter().take(stretch.sampled));
                let values: Vec<f64> = samples.map(at).filter(|value| value.is_finite()).collect();
                let time_s = some.first().map_or(f64::NAN, |stretch| stretch.time_s);
                course.push(
                    time_s,
                    low,
                    cellpos_numeric::statistics::median(&values),
                    high,
                );
            }
            course.push(f64::NAN, f64::NAN, f64::NAN, f64::NAN);
        }
        course
    }

    /// Stretches in a column.
    fn joined(&self, period_rows: f64) -> usize {
        let joined = self.stretches.len().div_ceil(COLUMNS).max(1);
        let column = (joined as u64 * self.rows) as f64;
        if !period_rows.is_finite() || period_rows >= DRAWN * column {
            return joined;
        }
        joined.max((period_rows / self.rows as f64).ceil() as usize)
    }

    /// Whether each point of a [`Course`] is one row: then there is no envelope.
    pub(super) fn is_bare(&self) -> bool {
        self.rows == 1 && self.stretches.len() <= COLUMNS
    }
}

impl<const N: usize> Stretch<N> {
    fn sample(&mut self, values: [f64; N]) {
        if let Some(free) = self.samples.get_mut(self.sampled) {
            *free = values;
            self.sampled += 1;
        }
    }

    /// Takes over every second sample of two stretches that become one, once they are too many.
    fn join_samples(&mut self, other: &Self) {
        let own = self.samples.iter().take(self.sampled);
        let all: Vec<[f64; N]> = own
            .chain(other.samples.iter().take(other.sampled))
            .copied()
            .collect();
        let every = all.len().div_ceil(SAMPLES).max(1);
        self.sampled = 0;
        for values in all.into_iter().step_by(every) {
            self.sample(values);
        }
    }

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
    fn the_median_of_a_noisy_ramp_is_the_ramp_and_its_envelope_holds_the_noise() {
        for rows in [500_usize, 5_000, 123_457] {
            let mut envelope = Envelope::<1>::default();
            for k in 0..rows {
                let noise = ((k as f64 * 0.618_034).fract() - 0.5) * 2.0;
                envelope.add(k as f64 * 1e-3, [5.0 * k as f64 / rows as f64 + noise]);
            }
            let course = envelope.course(0);
            assert!(course.time_s.len() <= COLUMNS + 2, "{rows}");
            for (k, time_s) in course.time_s.iter().enumerate() {
                let end_s = rows as f64 * 1e-3;
                let ramp = 5.0 * time_s / end_s;
                // The last column has the rows that are left over: one, if need be.
                let whole = *time_s < end_s - 2.0 * end_s / COLUMNS as f64;
                if rows > 100_000 && whole {
                    assert!((course.median[k] - ramp).abs() < 0.5, "{rows}, {time_s}");
                    assert!(course.low[k] < ramp - 0.8 && course.high[k] > ramp + 0.8);
                }
            }
        }
    }

    #[test]
    fn a_fast_wave_is_an_even_area_and_a_slow_one_a_wave() {
        for (period_rows, slow) in [(50.0, false), (47.3, false), (4000.0, true)] {
            let mut envelope = Envelope::<1>::default();
            for k in 0..8_000 {
                let angle = std::f64::consts::TAU * f64::from(k) / period_rows;
                envelope.add(f64::from(k) * 1e-3, [angle.sin()]);
            }
            let course = envelope.course_of(0, period_rows);
            // The last column has what is left over.
            let whole = course.high.len() - 2;
            let even = course.high[..whole].iter().all(|high| *high > 0.98)
                && course.low[..whole].iter().all(|low| *low < -0.98);
            assert_eq!(even, !slow, "{period_rows}");
            assert_eq!(course.high.len() > 600, slow, "{period_rows}");
        }
    }

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
        let course = envelope.course(0);
        assert!(
            course.time_s.len() <= COLUMNS + 4,
            "{}",
            course.time_s.len()
        );
        assert_eq!(course.high.iter().copied().fold(0.0, f64::max), 9.0);
        assert_eq!(course.low.iter().copied().fold(0.0, f64::min), -7.0);
        let at = course.high.iter().position(|value| *value == 9.0).unwrap();
        let wide = course.time_s[1] - course.time_s[0];
        assert!((course.time_s[at] - 12.345).abs() <= wide);
        // The gap, and the end.
        assert_eq!(
            course.time_s.iter().filter(|value| value.is_nan()).count(),
            2
        );
        let joined = envelope.stretches.iter().map(|one| one.rows).sum::<u64>();
        assert_eq!(joined, 100_000);
    }
}
