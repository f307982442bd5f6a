//! Running mean over the fixes of all beads.

/// Share of a new fix.
const FORGETTING: f64 = 1.0 / 64.0;

/// A running mean, of all fixes at first.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Pool {
    pub mean: f64,
    fixes: f64,
}

impl Pool {
    pub(crate) fn take_in(&mut self, value: f64) {
        self.fixes += 1.0;
        self.mean += (value - self.mean) * (1.0 / self.fixes).max(FORGETTING);
    }

    /// The mean; `None` before the first value.
    pub(crate) fn usual(&self) -> Option<f64> {
        (self.fixes > 0.0).then_some(self.mean)
    }

    /// Takes in a value that is known from some fixes and gives it drawn towards the mean of all, as if that were known from
    /// `weight` of them.
    pub(crate) fn shrink(&mut self, own: f64, fixes: f64, weight: f64) -> f64 {
        self.take_in(own);
        (fixes * own + weight * self.mean) / (fixes + weight)
    }
}
