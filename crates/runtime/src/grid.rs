//! The loop's grid of time: what makes a tick's number that of the clock.
//!
//! Tick `k` stands at `origin + k period`; a time belongs to the `k` that is nearest. Whatever starts a tick (a frame that
//! is early, late or doubled, a timer), it advances the loop by the steps of this grid that have passed, so that plan,
//! controller, estimator, learner and cycle table keep the time of the clock.

/// Grid of the ticks' times, ns.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Grid {
    origin_ns: i64,
    period_ns: i64,
}

impl Grid {
    /// A grid with tick 0 at `origin_ns`: the time of the first tick of a run.
    pub fn new(origin_ns: i64, period_ns: i64) -> Self {
        Self {
            origin_ns,
            period_ns: period_ns.max(1),
        }
    }

    /// The tick that a time belongs to.
    pub fn index(&self, time_ns: i64) -> i64 {
        time_ns
            .saturating_sub(self.origin_ns)
            .saturating_add(self.period_ns / 2)
            .div_euclid(self.period_ns)
    }

    /// The first time that belongs to a tick, ns.
    pub fn opens_ns(&self, index: i64) -> i64 {
        index
            .saturating_mul(self.period_ns)
            .saturating_add(self.origin_ns)
            .saturating_sub(self.period_ns / 2)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_time_belongs_to_the_nearest_tick_and_a_tick_opens_half_a_period_before_it() {
        for (origin_ns, period_ns) in [(0, 1_000_000), (-77, 200_000), (12_345, 333_333)] {
            let grid = Grid::new(origin_ns, period_ns);
            for k in [-3, 0, 1, 2, 1_000_000_007] {
                assert_eq!(grid.index(origin_ns + k * period_ns), k);
                let opens_ns = grid.opens_ns(k);
                assert_eq!((grid.index(opens_ns - 1), grid.index(opens_ns)), (k - 1, k));
            }
        }
        let far = Grid::new(i64::MIN, 1);
        assert!(far.index(i64::MAX) > 0 && far.opens_ns(i64::MAX) > i64::MIN);
    }
}
