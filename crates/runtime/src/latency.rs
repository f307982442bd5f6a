//! Tail statistics of durations: exact maximum and quantiles over hours in fixed memory.

use hdrhistogram::Histogram;
use serde::Serialize;

/// A histogram of durations in nanoseconds, 3 significant digits, 1 ns to 10 s; longer ones count as 10 s.
///
/// Recording allocates nothing. The exact maximum is kept next to the histogram.
#[derive(Debug, Clone)]
pub struct Latency {
    histogram: Histogram<u64>,
    max_ns: u64,
    max_tick: u64,
}

/// Quantiles of a [`Latency`] in microseconds.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Default)]
pub struct Quantiles {
    /// One in ten is shorter, us.
    pub p10: f64,
    /// Median, us.
    pub p50: f64,
    /// 99th percentile, us.
    pub p99: f64,
    /// 99.9th percentile, us.
    pub p999: f64,
    /// Exact maximum, us.
    pub max: f64,
    /// Number of the tick in which it came.
    pub max_tick: u64,
}

impl Default for Latency {
    fn default() -> Self {
        Self::new()
    }
}

impl Latency {
    const HIGHEST_NS: u64 = 10_000_000_000;

    /// An empty histogram; all memory is taken here.
    pub fn new() -> Self {
        let histogram = Histogram::new_with_bounds(1, Self::HIGHEST_NS, 3)
            .or_else(|_| Histogram::new(3))
            .unwrap_or_else(|_| {
                unreachable!("3 significant digits are within hdrhistogram's bounds")
            });
        Self {
            histogram,
            max_ns: 0,
            max_tick: 0,
        }
    }

    /// Counts one duration, of the tick `seq`.
    pub fn record(&mut self, ns: u64, seq: u64) {
        if ns > self.max_ns {
            (self.max_ns, self.max_tick) = (ns, seq);
        }
        self.histogram.saturating_record(ns.min(Self::HIGHEST_NS));
    }

    /// Durations counted.
    pub fn count(&self) -> u64 {
        self.histogram.len()
    }

    /// The quantiles so far; all zero when nothing was counted.
    pub fn quantiles_us(&self) -> Quantiles {
        if self.count() == 0 {
            return Quantiles::default();
        }
        // A histogram answers with its bucket's upper edge, which may lie above the exact maximum.
        let at = |q| self.histogram.value_at_quantile(q).min(self.max_ns) as f64 / 1e3;
        Quantiles {
            p10: at(0.1),
            p50: at(0.5),
            p99: at(0.99),
            p999: at(0.999),
            max: self.max_ns as f64 / 1e3,
            max_tick: self.max_tick,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_of_a_known_ramp_are_within_three_digits_and_the_maximum_is_exact() {
        let mut latency = Latency::new();
        for us in 1..=10_000u64 {
            latency.record(us * 1000, us);
        }
        latency.record(12_345_678_901, 77);
        let q = latency.quantiles_us();
        assert!((q.p10 - 1000.0).abs() < 2.0, "{q:?}");
        assert!((q.p50 - 5000.0).abs() < 5.0, "{q:?}");
        assert!((q.p99 - 9900.0).abs() < 11.0, "{q:?}");
        assert_eq!((q.max, q.max_tick), (12_345_678.901, 77));
        assert_eq!(latency.count(), 10_001);
    }

    #[test]
    fn an_empty_histogram_reads_zero() {
        assert_eq!(Latency::new().quantiles_us(), Quantiles::default());
    }
}
