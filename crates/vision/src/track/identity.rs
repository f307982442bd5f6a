//! What tells the tracked bead from others: intensity, size, residual.

use super::config::TrackerConfig;
use crate::fix::Fix;

/// Share of a new fix in the running signature.
const FORGETTING: f64 = 0.01;
/// Standard deviations granted beyond the allowed change of size.
const SIZE_SIGMA: f64 = 3.0;

/// How a bead looks in a fix, or in the mean of many.
#[derive(Debug, Clone, Copy)]
struct Look {
    amplitude: f64,
    residual: f64,
    size: Option<f64>,
}

impl Look {
    fn of(fix: &Fix, size: Option<(f64, f64)>) -> Self {
        Look {
            amplitude: fix.amplitude,
            residual: fix.residual_ratio,
            size: size.map(|s| s.0),
        }
    }

    /// The share of the changes of contrast and size that are allowed by which a fix differs from this.
    fn change_used(&self, config: &TrackerConfig, fix: &Fix, size: Option<(f64, f64)>) -> f64 {
        let amplitude = (fix.amplitude / self.amplitude - 1.0).abs() / config.max_amplitude_change;
        let size = match (self.size, size) {
            (Some(own), Some((other, sd))) => {
                (other / own - 1.0).abs() / (config.max_size_change + SIZE_SIGMA * sd)
            }
            _ => 0.0,
        };
        amplitude.max(size)
    }

    /// The same of the residual.
    fn residual_used(&self, config: &TrackerConfig, fix: &Fix) -> f64 {
        fix.residual_ratio / (config.max_residual_growth * self.residual.max(1.0))
    }
}

/// Running signature of a bead.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Identity {
    mean: Look,
    last: Look,
    fixes: f64,
    /// Fixes since the size was measured last.
    unmeasured: f64,
}

impl Identity {
    pub(super) fn new(fix: &Fix, size: Option<(f64, f64)>) -> Self {
        let look = Look::of(fix, size);
        Identity {
            mean: look,
            last: look,
            fixes: 1.0,
            unmeasured: 0.0,
        }
    }

    /// Peak contrast, grey levels.
    pub(super) fn amplitude(&self) -> f64 {
        self.mean.amplitude
    }

    pub(super) fn agrees(
        &self,
        config: &TrackerConfig,
        fix: &Fix,
        size: Option<(f64, f64)>,
    ) -> bool {
        self.change_used(config, fix, size) <= 1.0
    }

    /// How much of the changes that are allowed a fix has used up: 1 for what is just not another bead.
    pub(super) fn change_used(
        &self,
        config: &TrackerConfig,
        fix: &Fix,
        size: Option<(f64, f64)>,
    ) -> f64 {
        let residual = self.mean.residual_used(config, fix);
        self.mean.change_used(config, fix, size).max(residual)
    }

    /// Whether a fix has the contrast and the size of the last one: a bead that swims over dust changes from frame to frame, and
    /// by much in all. Dust shows in the residual, whose limit for a good fix is a share of the contrast. As a multiple of the
    /// noise it does not identify the bead.
    pub(super) fn goes_on(
        &self,
        config: &TrackerConfig,
        fix: &Fix,
        size: Option<(f64, f64)>,
    ) -> bool {
        self.last.change_used(config, fix, size) <= 1.0
    }

    /// Follows slow changes of light and focus.
    pub(super) fn update(&mut self, fix: &Fix, size: Option<(f64, f64)>) {
        let new = Look::of(fix, size);
        self.last = Look {
            size: new.size.or(self.last.size),
            ..new
        };
        self.fixes += 1.0;
        let share = FORGETTING.max(1.0 / self.fixes);
        let mean = &mut self.mean;
        mean.amplitude += share * (new.amplitude - mean.amplitude);
        mean.residual += share * (new.residual - mean.residual);
        self.unmeasured += 1.0;
        if let Some(other) = new.size {
            // As fast as the others, however seldom it is measured.
            let share = (self.unmeasured * share).min(1.0);
            mean.size = Some(mean.size.map_or(other, |own| own + share * (other - own)));
            self.unmeasured = 0.0;
        }
    }
}
