//! The loop's grid of time: what makes a tick's number that of the clock.
//!
//! Tick `k` is at `origin + k period` and may be made up to [`REACH`] of a period before or after it. The windows of two ticks overlap, so
//! a frame that drifts through the grid never waits for a window to open. At the end of one window it is in the middle part of the next. A
//! frame that is early, late or doubled, or a timer, may start a tick. The tick advances the loop by the steps of this grid that have
//! passed. So plan, controller, estimator, learner and cycle table keep the time of the clock.

/// A tick may be made so far from its place, in parts of a period. Above a half, so that windows overlap: a phase that
/// leaves one window has `2 REACH - 1` of a period to the nearest edge of the other one, which is what jitter has to
/// cross before frames fall to either side in turn. Below one, so that each tick has a time that is its own.
pub(crate) const REACH: f64 = 0.75;

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

    /// The tick that is nearest to a time.
    pub fn index(&self, time_ns: i64) -> i64 {
        time_ns
            .saturating_sub(self.origin_ns)
            .saturating_add(self.period_ns / 2)
            .div_euclid(self.period_ns)
    }

    /// The first time at which a tick may be made, ns.
    pub fn opens_ns(&self, index: i64) -> i64 {
        self.place_ns(index).saturating_sub(self.reach_ns())
    }

    /// The tick that is made at a time, after tick `last`: the next one while its window is open, later the nearest.
    /// `None`: the next one's window is not open yet.
    pub fn index_after(&self, last: i64, time_ns: i64) -> Option<i64> {
        let next = last.saturating_add(1);
        if time_ns < self.opens_ns(next) {
            return None;
        }
        let open = time_ns <= self.place_ns(next).saturating_add(self.reach_ns());
        Some(if open { next } else { self.index(time_ns) })
    }

    fn place_ns(&self, index: i64) -> i64 {
        index
            .saturating_mul(self.period_ns)
            .saturating_add(self.origin_ns)
    }

    fn reach_ns(&self) -> i64 {
        (self.period_ns as f64 * REACH) as i64
    }
}

/// Ticks over which a [`Beat`] follows them. It has a fifth of their jitter then, and is 16 us behind a camera that is 0.1 % off at 1 kHz.
const FOLLOWS: i64 = 16;

/// Time as model and bead see it: the periods for which the commands were in force. It is a grid that follows the ticks. Where the frames
/// leave one window for the next, two ticks are two periods apart and have numbers in a row, or one period apart and a number is left out.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) struct Beat {
    /// Place of the last tick by the ticks before it, ns; `None` before the first.
    place_ns: Option<i64>,
}

impl Beat {
    /// A tick that is made at a time, ns: the periods since the last one, 1 or more, and by how much it is late, periods.
    pub(crate) fn tick(&mut self, time_ns: i64, period_ns: i64) -> (u64, f64) {
        let Some(place_ns) = self.place_ns else {
            self.place_ns = Some(time_ns);
            return (1, 0.0);
        };
        let grid = Grid::new(place_ns, period_ns);
        let periods = grid.index_after(0, time_ns).unwrap_or(1);
        let late_ns = time_ns.saturating_sub(grid.place_ns(periods));
        self.place_ns = Some(time_ns.saturating_sub(late_ns - late_ns / FOLLOWS));
        let late = late_ns as f64 / period_ns as f64;
        (periods.unsigned_abs(), late.max(-1.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_beat_has_the_periods_that_passed_whatever_the_number_of_the_tick() {
        const P: i64 = 1_000_000;
        for ppm in [-1000, -15, 0, 15, 1000] {
            let mut beat = Beat::default();
            let (mut last, mut late) = (0, 0.0_f64);
            for k in 0..100_000 {
                // A frame is left out, one is late and the timer makes a tick before it, and a stall.
                let at = match k % 1000 {
                    300 => continue,
                    500 => k * P + P * 3 / 10,
                    501 => k * P - P * 7 / 20,
                    550 => k * P + P * 6 / 10,
                    700..705 => continue,
                    _ => k * P,
                };
                let (periods, off) = beat.tick(at + k * P / 1_000_000 * ppm, P);
                if k > 0 {
                    assert_eq!(periods, (k - last) as u64, "{ppm} ppm, tick {k}");
                }
                last = k;
                if !(500..650).contains(&(k % 1000)) {
                    late = late.max(off.abs());
                }
            }
            let most = 1e-6 * (f64::from(ppm as i32)).abs() * (FOLLOWS + 6) as f64 + 1e-3;
            assert!(late < most, "{ppm} ppm: {late}");
        }
        let mut beat = Beat::default();
        assert_eq!(beat.tick(i64::MIN, P), (1, 0.0));
        assert!(beat.tick(i64::MAX, P).0 > 1);
        assert_eq!(beat.tick(i64::MIN, P), (1, -1.0));
    }

    #[test]
    fn a_tick_is_the_next_one_while_its_window_is_open_and_then_the_nearest() {
        for (origin_ns, period_ns) in [(0, 1_000_000), (-77, 200_000), (12_345, 333_333)] {
            let grid = Grid::new(origin_ns, period_ns);
            for k in [-3, 0, 1, 2, 1_000_000_007] {
                let at = |steps: f64| origin_ns + k * period_ns + (steps * period_ns as f64) as i64;
                assert_eq!(grid.index(at(0.0)), k);
                let opens_ns = grid.opens_ns(k);
                assert_eq!(opens_ns, at(-REACH));
                for (time_ns, expected) in [
                    (opens_ns - 1, None),
                    (opens_ns, Some(k)),
                    (at(0.0), Some(k)),
                    (at(REACH), Some(k)),
                    (at(REACH) + 2, Some(k + 1)),
                    (at(4.4), Some(k + 4)),
                ] {
                    assert_eq!(grid.index_after(k - 1, time_ns), expected, "{k} {time_ns}");
                }
            }
        }
        let far = Grid::new(i64::MIN, 1);
        assert!(far.index(i64::MAX) > 0 && far.opens_ns(i64::MAX) > i64::MIN);
    }
}
