//! The output stage: where the output is to be, and how it gets there within range, slew and converter steps.

use super::BoardConfig;

/// Where the output is to be as a function of time: a straight line, then level.
#[derive(Debug, Clone, Copy)]
pub(super) struct Trajectory {
    from_um: f64,
    from_us: u64,
    to_um: f64,
    to_us: u64,
}

impl Trajectory {
    /// Level from the beginning.
    pub(super) fn hold(um: f64) -> Self {
        Self {
            from_um: um,
            from_us: 0,
            to_um: um,
            to_us: 0,
        }
    }

    /// A line from where this trajectory is at `now_us` to `to_um` at `to_us`.
    pub(super) fn towards(&self, now_us: u64, to_um: f64, to_us: u64) -> Self {
        Self {
            from_um: self.at_um(now_us),
            from_us: now_us,
            to_um,
            to_us,
        }
    }

    pub(super) fn at_um(&self, now_us: u64) -> f64 {
        if now_us >= self.to_us {
            return self.to_um;
        }
        let part =
            now_us.saturating_sub(self.from_us) as f64 / (self.to_us - self.from_us).max(1) as f64;
        self.from_um + (self.to_um - self.from_um) * part
    }

    pub(super) fn ends_after(&self, now_us: u64) -> bool {
        now_us < self.to_us
    }
}

/// Slew limiter and converter.
#[derive(Debug, Clone, Copy)]
pub(super) struct Output {
    low_um: f64,
    high_um: f64,
    step_um: f64,
    longest_step_us: u64,
    /// The slew-limited displacement before the converter rounds it, um.
    ramp_um: f64,
    applied_um: f64,
    last_us: u64,
}

impl Output {
    pub(super) fn new(config: &BoardConfig) -> Self {
        let mut output = Self {
            low_um: config.low_um,
            high_um: config.high_um,
            step_um: config.step_um(),
            longest_step_us: u64::from(config.update_us),
            ramp_um: config.power_up_um,
            applied_um: config.power_up_um,
            last_us: 0,
        };
        output.applied_um = output.converted_um(config.power_up_um);
        output
    }

    pub(super) fn applied_um(&self) -> f64 {
        self.applied_um
    }

    /// Moves towards `target_um` for the time since the last call, at most one update period, at `rate_um_per_s` at most.
    ///
    /// What stands at the converter is always within half a converter step of a trajectory that keeps to the slew.
    pub(super) fn advance(&mut self, now_us: u64, target_um: f64, rate_um_per_s: f64) {
        let elapsed_us = now_us.saturating_sub(self.last_us);
        self.last_us = self.last_us.max(now_us);
        let reach_um = rate_um_per_s * 1e-6 * elapsed_us.min(self.longest_step_us) as f64;
        let target_um = target_um.clamp(self.low_um, self.high_um);
        let way_um = target_um - self.ramp_um;
        if way_um.abs() <= reach_um {
            self.ramp_um = target_um;
        } else {
            self.ramp_um += reach_um.copysign(way_um);
        }
        self.applied_um = self.converted_um(self.ramp_um);
    }

    pub(super) fn arrived(&self, target_um: f64) -> bool {
        self.ramp_um == target_um.clamp(self.low_um, self.high_um)
    }

    /// The nearest displacement that the converter can make.
    fn converted_um(&self, um: f64) -> f64 {
        let code = ((um - self.low_um) / self.step_um).round();
        (self.low_um + code * self.step_um).clamp(self.low_um, self.high_um)
    }
}
