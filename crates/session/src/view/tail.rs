//! The tail of a time, cheap enough for a running run.

/// Steps of an octave: the resolution is 1 part in 64.
const STEPS: usize = 64;
/// Octaves: all that fits in 32 bits of nanoseconds, four seconds.
const OCTAVES: usize = 32;

/// Times in octaves of 64 equal steps each. Counting changes one number, and the search of the tail starts from above, so both
/// cost the thread little. The run's summary has a separate, finer count.
#[derive(Debug, Clone)]
pub(super) struct Tail {
    counts: Box<[u32; STEPS * OCTAVES]>,
    count: u64,
}

impl Tail {
    pub(super) fn new() -> Self {
        Self {
            counts: Box::new([0; STEPS * OCTAVES]),
            count: 0,
        }
    }

    /// Counts a time.
    pub(super) fn add(&mut self, ns: u32) {
        if let Some(count) = self.counts.get_mut(place(ns)) {
            *count = count.saturating_add(1);
        }
        self.count += 1;
    }

    /// The 99.9 % quantile of the times, us, at the upper end of its step; `None` before the first.
    pub(super) fn p999_us(&self) -> Option<f64> {
        Some(upper_ns(self.exceeded_by(self.count / 1000)?) as f64 * 1e-3)
    }

    /// The median of the times, us, in the middle of its step; `None` before the first.
    pub(super) fn median_us(&self) -> Option<f64> {
        let found = self.exceeded_by(self.count / 2)?;
        let lower_ns = found.checked_sub(1).map_or(0, upper_ns);
        Some(0.5 * (lower_ns + upper_ns(found)) as f64 * 1e-3)
    }

    /// The step that holds the time that so many are above.
    fn exceeded_by(&self, above: u64) -> Option<usize> {
        let mut seen = 0;
        self.counts.iter().rposition(|count| {
            seen += u64::from(*count);
            seen > above
        })
    }
}

/// Index of the step that counts a time.
fn place(ns: u32) -> usize {
    let bits = (u32::BITS - ns.leading_zeros()) as usize;
    match bits.checked_sub(7) {
        // One step per nanosecond.
        None => ns as usize,
        Some(shift) => STEPS * (shift + 1) + (ns >> shift) as usize - STEPS,
    }
}

/// Largest time that a step counts, ns.
fn upper_ns(place: usize) -> u64 {
    match (place / STEPS).checked_sub(1) {
        None => place as u64,
        Some(shift) => {
            let step = (STEPS + place % STEPS) as u64;
            ((step + 1) << shift) - 1
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_time_is_counted_in_a_step_that_holds_it() {
        let mut last = 0;
        for ns in (0..200_000).chain((0..14).map(|bit| u32::MAX >> bit)) {
            let (at, upper) = (place(ns), upper_ns(place(ns)));
            assert!(at < STEPS * OCTAVES, "{ns}");
            assert!(upper >= u64::from(ns), "{ns}: {upper}");
            assert!(
                upper as f64 <= f64::from(ns) * (1.0 + 1.0 / 64.0) + 1.0,
                "{ns}: {upper}"
            );
            if ns < 200_000 {
                assert!(at >= last, "{ns}: places rise");
                last = at;
            }
        }
    }

    #[test]
    fn the_tail_is_what_one_in_a_thousand_exceeds() {
        let mut tail = Tail::new();
        assert_eq!((tail.p999_us(), tail.median_us()), (None, None));
        for k in 1..=100_000 {
            tail.add(k * 10);
        }
        let told = tail.p999_us().unwrap();
        assert!((told / 999.0 - 1.0).abs() < 0.017, "{told}");
        let told = tail.median_us().unwrap();
        assert!((told / 500.0 - 1.0).abs() < 0.009, "{told}");
    }
}
