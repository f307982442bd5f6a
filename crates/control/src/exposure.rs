//! What a frame makes of a path: its mean over the exposure.

/// Mean of a path over an exposure of `exposure_ticks` whose middle is `ago` ticks old. `at` gives the path at an age in ticks;
/// between ticks it is straight, so that its mean there is that in the middle. `None` where the path is not known so far back.
pub(crate) fn mean(ago: f64, exposure_ticks: f64, at: impl Fn(f64) -> Option<f64>) -> Option<f64> {
    let half = 0.5 * exposure_ticks;
    let (mut from, until) = ((ago - half).max(0.0), ago + half);
    let length = until - from;
    if length < 1e-6 {
        return at(ago);
    }
    let mut sum = 0.0;
    while from < until {
        let to = (from.floor() + 1.0).min(until);
        sum += (to - from) * at(0.5 * (from + to))?;
        from = to;
    }
    Some(sum / length)
}

/// Past positions that are kept, ticks.
const PAST: usize = 24;

/// Positions of a bead or a model at the last ticks. Between ticks it jumps by the direct feedthrough and then moves evenly.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct Past {
    /// At this tick and those before, newest first, um.
    positions_um: [f64; PAST],
    /// Sum of all jumps up to each position, um.
    jumped_um: [f64; PAST],
}

impl Past {
    /// A tick on: the position now, and the jump with which the tick began, um.
    pub(crate) fn push(&mut self, position_um: f64, jump_um: f64) {
        let jumped_um = self.jumped_um[0] + jump_um;
        for (series, newest_um) in [
            (&mut self.positions_um, position_um),
            (&mut self.jumped_um, jumped_um),
        ] {
            series.copy_within(0..PAST - 1, 1);
            series[0] = newest_um;
        }
    }

    /// The newest position, um.
    pub(crate) fn now(&self) -> f64 {
        self.positions_um[0]
    }

    /// Position `ago` ticks ago, um.
    fn at(&self, ago: f64) -> Option<f64> {
        Some(self.without_jumps(ago)? + self.jumped_um.get(ago.max(0.0) as usize)?)
    }

    /// The same without the jumps, from an arbitrary zero: a path that bends at the ticks, um.
    pub(crate) fn without_jumps(&self, ago: f64) -> Option<f64> {
        let newer = ago.max(0.0) as usize;
        let part = ago.max(0.0) - newer as f64;
        let at = |k: usize| Some(self.positions_um.get(k)? - self.jumped_um.get(k)?);
        Some((1.0 - part) * at(newer)? + part * at(newer + 1)?)
    }

    /// Mean over an exposure of `exposure` ticks with its middle `age` ticks ago, um; `None` if the positions are no longer kept.
    pub(crate) fn seen(&self, age: f64, exposure: f64) -> Option<f64> {
        mean(age, exposure, |ago| self.at(ago))
    }
}
