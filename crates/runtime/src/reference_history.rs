//! The reference at the time of an exposure: the error of a position is counted from it.

/// Ticks that are remembered: an exposure that is older has no error. The loop refuses frames long before (`timing.oldest_ms`).
const TICKS: usize = 128;

/// Times and references of the last ticks.
#[derive(Debug, Clone, Copy)]
pub struct ReferenceHistory {
    /// Time of the tick (ns) and its reference (um), in a ring.
    past: [(i64, f64); TICKS],
    /// Where the newest is, and how many there are.
    newest: usize,
    count: usize,
}

impl Default for ReferenceHistory {
    fn default() -> Self {
        Self {
            past: [(i64::MIN, f64::NAN); TICKS],
            newest: 0,
            count: 0,
        }
    }
}

impl ReferenceHistory {
    /// Takes the reference of a tick, um. Times rise.
    pub fn add(&mut self, time_ns: i64, reference_um: f64) {
        self.newest = (self.newest + 1) % TICKS;
        if let Some(place) = self.past.get_mut(self.newest) {
            *place = (time_ns, reference_um);
        }
        self.count = (self.count + 1).min(TICKS);
    }

    /// The reference at a time, um: on the line between the ticks before and after it; after the newest tick, that of the newest tick; NaN
    /// before the oldest tick that is remembered.
    pub fn at(&self, time_ns: i64) -> f64 {
        let mut after: Option<(i64, f64)> = None;
        for age in 0..self.count {
            let place = (self.newest + TICKS - age) % TICKS;
            let Some(&(tick_ns, reference_um)) = self.past.get(place) else {
                break;
            };
            if tick_ns > time_ns {
                after = Some((tick_ns, reference_um));
                continue;
            }
            return match after {
                Some((after_ns, after_um)) if reference_um.is_finite() => {
                    let share = (time_ns - tick_ns) as f64 / (after_ns - tick_ns) as f64;
                    reference_um + share * (after_um - reference_um)
                }
                Some((_, after_um)) => after_um,
                None => reference_um,
            };
        }
        f64::NAN
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A tick each millisecond; the reference is the time in ms.
    fn ramp(ticks: i64) -> ReferenceHistory {
        let mut history = ReferenceHistory::default();
        for k in 0..ticks {
            history.add(k * 1_000_000, k as f64);
        }
        history
    }

    #[test]
    fn the_reference_of_an_exposure_is_that_of_its_time_and_none_before_the_ticks_that_are_known() {
        let history = ramp(1000);
        for (at_ns, reference_um) in [
            (997_900_000, 997.9),
            (998_000_000, 998.0),
            (2_000_000_000, 999.0),
        ] {
            assert!((history.at(at_ns) - reference_um).abs() < 1e-9, "{at_ns}");
        }
        assert_eq!(history.at(872_000_000), 872.0, "the oldest");
        assert!(history.at(871_000_000).is_nan(), "forgotten");
        assert!(ramp(3).at(-1).is_nan(), "before the first");
        assert!(ReferenceHistory::default().at(0).is_nan());
    }

    #[test]
    fn a_reference_that_was_none_yet_is_not_drawn_into_the_line() {
        let mut history = ReferenceHistory::default();
        history.add(0, f64::NAN);
        history.add(1_000_000, 3.0);
        assert_eq!(history.at(500_000), 3.0);
    }
}
