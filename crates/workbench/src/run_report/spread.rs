//! How values are spread, gathered as they go by: every value while there are few, counts in narrow bins of a night's.

use cellpos_report::Series;

/// Values that are kept as they are.
const KEPT: usize = 1 << 18;
/// Narrow bins, of which half or more lie between the smallest and the largest value.
const NARROW: usize = 1 << 14;

/// Values of one quantity; those that are not finite are left out.
#[derive(Debug, Default)]
pub(super) struct Spread {
    kept: Vec<f64>,
    narrow: Option<Narrow>,
}

#[derive(Debug)]
struct Narrow {
    low: f64,
    high: f64,
    /// Lower edge of the first bin, and width of each.
    start: f64,
    width: f64,
    counts: Vec<u64>,
}

impl Spread {
    /// The next value.
    pub(super) fn add(&mut self, value: f64) {
        if !value.is_finite() {
            return;
        }
        if let Some(narrow) = &mut self.narrow {
            narrow.add(value);
            return;
        }
        self.kept.push(value);
        if self.kept.len() >= KEPT {
            self.narrow = Some(Narrow::of(&self.kept));
            self.kept = Vec::new();
        }
    }

    /// How many values there are.
    pub(super) fn count(&self) -> u64 {
        let narrow = self.narrow.as_ref();
        narrow.map_or(self.kept.len() as u64, |narrow| narrow.counts.iter().sum())
    }

    /// The value that half of them are above, within a narrow bin.
    pub(super) fn median(&self) -> Option<f64> {
        if let Some(narrow) = &self.narrow {
            let half = self.count() / 2;
            let mut seen = 0;
            let place = narrow.counts.iter().position(|count| {
                seen += count;
                seen > half
            })?;
            return Some(narrow.start + (place as f64 + 0.5) * narrow.width);
        }
        let mut kept = self.kept.clone();
        kept.sort_by(f64::total_cmp);
        kept.get(kept.len() / 2).copied()
    }

    /// Smallest and largest value.
    pub(super) fn ends(&self) -> Option<(f64, f64)> {
        if let Some(narrow) = &self.narrow {
            return Some((narrow.low, narrow.high));
        }
        let least = self.kept.iter().copied().reduce(f64::min)?;
        let most = self.kept.iter().copied().reduce(f64::max)?;
        Some((least, most))
    }

    /// Counts in equal bins between the smallest and the largest value.
    pub(super) fn histogram(&self, label: &str, bins: usize) -> Series {
        let Some(narrow) = &self.narrow else {
            return Series::histogram(label, &self.kept, bins);
        };
        let span = narrow.high - narrow.low;
        let width = if span > 0.0 { span / bins as f64 } else { 1.0 };
        let mut counts = vec![0.0; bins];
        for (place, count) in narrow.counts.iter().enumerate() {
            let middle = narrow.start + (place as f64 + 0.5) * narrow.width;
            let bin = ((middle - narrow.low) / width).max(0.0) as usize;
            counts[bin.min(bins - 1)] += *count as f64;
        }
        let centres: Vec<f64> = (0..bins)
            .map(|bin| narrow.low + (bin as f64 + 0.5) * width)
            .collect();
        Series::bars(label, &centres, &counts, width)
    }
}

/// Counts of positive values in bins of a twelfth of a decade: what spans decades is seen on logarithmic axes alone.
#[derive(Debug, Default)]
pub(super) struct Decades {
    counts: std::collections::BTreeMap<i32, u64>,
}

impl Decades {
    const A_DECADE: f64 = 12.0;

    /// Whether there is no positive value.
    pub(super) fn is_empty(&self) -> bool {
        self.counts.is_empty()
    }

    /// The next value; one that is not positive has no place on such an axis.
    pub(super) fn add(&mut self, value: f64) {
        if value > 0.0 && value.is_finite() {
            *self
                .counts
                .entry((value.log10() * Self::A_DECADE).floor() as i32)
                .or_default() += 1;
        }
    }

    /// Counts as steps, each from the lower to the upper edge of its bin; a bin without values is a gap.
    pub(super) fn steps(&self, label: &str) -> Series {
        let edge = |bin: i32| 10f64.powf(f64::from(bin) / Self::A_DECADE);
        let (mut x, mut y) = (Vec::new(), Vec::new());
        let mut next = None;
        for (&bin, &count) in &self.counts {
            if next.is_some_and(|next| next != bin) {
                x.push(edge(bin));
                y.push(f64::NAN);
            }
            x.extend([edge(bin), edge(bin + 1)]);
            y.extend([count as f64; 2]);
            next = Some(bin + 1);
        }
        Series::line(label, &x, &y)
    }
}

impl Narrow {
    /// Of values, one or more.
    fn of(values: &[f64]) -> Self {
        let low = values.iter().copied().fold(f64::INFINITY, f64::min);
        let high = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let span = if high > low { high - low } else { 1.0 };
        let width = span / (NARROW / 2) as f64;
        let mut narrow = Self {
            low,
            high,
            start: low - width * (NARROW / 4) as f64,
            width,
            counts: vec![0; NARROW],
        };
        values.iter().for_each(|value| narrow.add(*value));
        narrow
    }

    fn add(&mut self, value: f64) {
        (self.low, self.high) = (self.low.min(value), self.high.max(value));
        let place = loop {
            let place = ((value - self.start) / self.width).floor();
            if (0.0..NARROW as f64).contains(&place) {
                break place as usize;
            }
            self.widen(place < 0.0);
        };
        self.counts[place] += 1;
    }

    /// Makes each bin twice as wide; the new ones lie below, or above.
    fn widen(&mut self, below: bool) {
        let pairs: Vec<u64> = self.counts.chunks(2).map(|two| two.iter().sum()).collect();
        let none = vec![0; NARROW - pairs.len()];
        if below {
            self.start -= self.width * NARROW as f64;
            self.counts = [none, pairs].concat();
        } else {
            self.counts = [pairs, none].concat();
        }
        self.width *= 2.0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn counts(series: &Series) -> (Vec<f64>, Vec<f64>) {
        let csv = cellpos_report::Figure::new("f", "").panel(
            cellpos_report::Panel::new(
                cellpos_report::Axis::linear("x", ""),
                cellpos_report::Axis::linear("y", ""),
            )
            .series(series.clone()),
        );
        let numbers = |line: &str| -> Vec<f64> {
            line.split(',')
                .filter_map(|field| field.parse().ok())
                .collect()
        };
        let rows: Vec<Vec<f64>> = csv.to_csv().lines().map(numbers).collect();
        rows.iter()
            .filter(|row| row.len() >= 2)
            .map(|row| (row[row.len() - 2], row[row.len() - 1]))
            .unzip()
    }

    #[test]
    fn a_bin_alone_is_as_wide_as_any_other() {
        let mut times = Decades::default();
        [1.0, 1.05, 100.0].into_iter().for_each(|us| times.add(us));
        let (x, y) = counts(&times.steps("wake-up"));
        let wide = 10f64.powf(1.0 / Decades::A_DECADE);
        for pair in [[0, 1], [x.len() - 2, x.len() - 1]] {
            assert!((x[pair[1]] / x[pair[0]] / wide - 1.0).abs() < 1e-6, "{x:?}");
            assert_eq!(y[pair[0]], y[pair[1]]);
        }
        assert_eq!((y[0], y[y.len() - 1]), (2.0, 1.0));
    }

    #[test]
    fn a_nights_histogram_is_that_of_all_values_within_a_narrow_bin() {
        let mut random = cellpos_numeric::Random::new(3);
        let mut values: Vec<f64> = (0..3 * KEPT)
            .map(|_| {
                let mut unit = || random.uniform() - 0.5;
                100.0 * (unit() + unit() + unit())
            })
            .collect();
        // Far out on both sides, once the narrow bins are there.
        (values[2 * KEPT], values[2 * KEPT + 1]) = (5000.0, -9000.0);
        values[7] = f64::NAN;
        let mut spread = Spread::default();
        values.iter().for_each(|value| spread.add(*value));
        assert!(spread.narrow.is_some() && spread.kept.is_empty());
        let (x, y) = counts(&spread.histogram("v", 80));
        let (all_x, all_y) = counts(&Series::histogram("v", &values, 80));
        assert_eq!(
            (x.len(), y.iter().sum::<f64>()),
            (80, values.len() as f64 - 1.0)
        );
        for ((x, y), (all_x, all_y)) in x.iter().zip(&y).zip(all_x.iter().zip(&all_y)) {
            assert!((x - all_x).abs() < 1e-6, "{x} {all_x}");
            // What a narrow bin at an edge of the drawn one may hold.
            assert!(
                (y - all_y).abs() < 0.02 * values.len() as f64,
                "{x}: {y} {all_y}"
            );
        }
        let mut zeros = Spread::default();
        (0..2 * KEPT).for_each(|_| zeros.add(0.0));
        let (_, y) = counts(&zeros.histogram("v", 80));
        assert_eq!(y.iter().sum::<f64>(), 2.0 * KEPT as f64);
    }
}
