//! What tells the tracked bead from others: intensity, size, residual.

use super::config::TrackerConfig;
use crate::fix::Fix;

/// Share of a new fix in the running signature.
const FORGETTING: f64 = 0.01;
/// Standard deviations granted beyond the allowed change of size.
const SIZE_SIGMA: f64 = 3.0;

/// Running signature of a bead.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Identity {
    amplitude: f64,
    residual: f64,
    size: Option<f64>,
    fixes: f64,
    /// Fixes since the size was measured last.
    unmeasured: f64,
    /// Amplitude, residual and size of the last fix.
    last: (f64, f64, Option<f64>),
}

impl Identity {
    pub(super) fn new(fix: &Fix, size: Option<(f64, f64)>) -> Self {
        Identity {
            amplitude: fix.amplitude,
            residual: fix.residual_ratio,
            size: size.map(|s| s.0),
            fixes: 1.0,
            unmeasured: 0.0,
            last: (fix.amplitude, fix.residual_ratio, size.map(|s| s.0)),
        }
    }

    /// Peak contrast, grey levels.
    pub(super) fn amplitude(&self) -> f64 {
        self.amplitude
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
        let own = (self.amplitude, self.residual, self.size);
        change(own, config, fix, size)
    }

    /// Whether a fix looks as the last one did: a bead that swims over dust changes from frame to frame, and by much in all.
    pub(super) fn goes_on(
        &self,
        config: &TrackerConfig,
        fix: &Fix,
        size: Option<(f64, f64)>,
    ) -> bool {
        change(self.last, config, fix, size) <= 1.0
    }

    /// Follows slow changes of light and focus.
    pub(super) fn update(&mut self, fix: &Fix, size: Option<(f64, f64)>) {
        self.fixes += 1.0;
        let own_size = size.map(|s| s.0).or(self.last.2);
        self.last = (fix.amplitude, fix.residual_ratio, own_size);
        let share = FORGETTING.max(1.0 / self.fixes);
        self.amplitude += share * (fix.amplitude - self.amplitude);
        self.residual += share * (fix.residual_ratio - self.residual);
        self.unmeasured += 1.0;
        if let Some((other, _)) = size {
            // As fast as the others, however seldom it is measured.
            let share = (self.unmeasured * share).min(1.0);
            self.size = Some(self.size.map_or(other, |own| own + share * (other - own)));
            self.unmeasured = 0.0;
        }
    }
}

/// The share of the changes that are allowed by which a fix differs from this amplitude, residual and size.
fn change(
    (amplitude, residual, own_size): (f64, f64, Option<f64>),
    config: &TrackerConfig,
    fix: &Fix,
    size: Option<(f64, f64)>,
) -> f64 {
    let amplitude = (fix.amplitude / amplitude - 1.0).abs() / config.max_amplitude_change;
    let residual = fix.residual_ratio / (config.max_residual_growth * residual.max(1.0));
    let size = match (own_size, size) {
        (Some(own), Some((other, sd))) => {
            (other / own - 1.0).abs() / (config.max_size_change + SIZE_SIGMA * sd)
        }
        _ => 0.0,
    };
    amplitude.max(residual).max(size)
}
