//! The output stage: the target of the output, and its motion within range, slew and converter steps.
//!
//! All numbers are integers: rates in nm/s, times in us, displacements before the converter in fm. So the slew of one microsecond
//! at 1 nm/s is still 1 fm.

use crate::Config;
use core::num::NonZeroU64;

/// Femtometres in a picometre.
const FM: i64 = 1_000;

/// Target of the output as a function of time: a straight line, then constant.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Trajectory {
    from_pm: i32,
    from_us: u64,
    to_pm: i32,
    to_us: u64,
}

impl Trajectory {
    /// Level from the beginning.
    pub(crate) const fn hold(pm: i32) -> Self {
        Self {
            from_pm: pm,
            from_us: 0,
            to_pm: pm,
            to_us: 0,
        }
    }

    /// A line from where this trajectory is at `now_us` to `to_pm` at `to_us`.
    pub(crate) fn towards(&self, now_us: u64, to_pm: i32, to_us: u64) -> Self {
        Self {
            from_pm: self.at_pm(now_us),
            from_us: now_us,
            to_pm,
            to_us,
        }
    }

    pub(crate) fn at_pm(&self, now_us: u64) -> i32 {
        let Some(span_us) = self
            .to_us
            .checked_sub(self.from_us)
            .and_then(NonZeroU64::new)
            .filter(|_| now_us < self.to_us)
        else {
            return self.to_pm;
        };
        let passed_us = now_us.saturating_sub(self.from_us);
        let way_pm = self.to_pm.abs_diff(self.from_pm);
        // At most 2^32 pm times a bridge of some ms: far below 2^64; and not above `way_pm`, so it fits its type again.
        let part_pm = (u64::from(way_pm).saturating_mul(passed_us) / span_us) as u32;
        if self.to_pm >= self.from_pm {
            self.from_pm.saturating_add_unsigned(part_pm)
        } else {
            self.from_pm.saturating_sub_unsigned(part_pm)
        }
    }

    pub(crate) fn ends_after(&self, now_us: u64) -> bool {
        now_us < self.to_us
    }
}

/// Slew limiter and converter.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Output {
    low_pm: i32,
    high_pm: i32,
    /// Width of the range, fm.
    range_fm: NonZeroU64,
    highest_code: NonZeroU64,
    longest_step_us: u64,
    /// The slew-limited displacement before the converter rounds it, fm.
    ramp_fm: i64,
    code: u16,
    last_us: u64,
}

impl Output {
    pub(crate) fn new(config: &Config) -> Self {
        let (low_pm, high_pm) = (config.limits.low_pm, config.limits.high_pm);
        let range_fm = u64::from(high_pm.abs_diff(low_pm)) * FM as u64;
        let mut output = Self {
            low_pm,
            high_pm,
            range_fm: NonZeroU64::new(range_fm).unwrap_or(NonZeroU64::MIN),
            highest_code: NonZeroU64::new(u64::from(config.highest_code()))
                .unwrap_or(NonZeroU64::MIN),
            longest_step_us: u64::from(config.update_us),
            ramp_fm: i64::from(config.power_up_pm) * FM,
            code: 0,
            last_us: 0,
        };
        output.code = output.converted();
        output
    }

    /// The code at the converter.
    pub(crate) const fn code(&self) -> u16 {
        self.code
    }

    /// The displacement at the converter, pm.
    pub(crate) fn applied_pm(&self) -> i32 {
        let range_pm = self.range_fm.get() / FM as u64;
        let half = self.highest_code.get() / 2;
        let above_pm = (u64::from(self.code) * range_pm + half) / self.highest_code;
        // The highest code gives the range itself, so the sum is at most `high_pm`.
        self.low_pm.saturating_add_unsigned(above_pm as u32)
    }

    /// Moves towards `target_pm` for the time since the last call, at most one update period, at `rate_nm_per_s` at most.
    ///
    /// The converter's displacement is always within half a step of a trajectory that respects the slew limit.
    pub(crate) fn advance(&mut self, now_us: u64, target_pm: i32, rate_nm_per_s: u32) {
        let elapsed_us = now_us.saturating_sub(self.last_us);
        self.last_us = self.last_us.max(now_us);
        let reach_fm = u64::from(rate_nm_per_s) * elapsed_us.min(self.longest_step_us);
        let target_fm = self.target_fm(target_pm);
        if target_fm.abs_diff(self.ramp_fm) <= reach_fm {
            self.ramp_fm = target_fm;
        } else if target_fm > self.ramp_fm {
            self.ramp_fm = self.ramp_fm.saturating_add_unsigned(reach_fm);
        } else {
            self.ramp_fm = self.ramp_fm.saturating_sub_unsigned(reach_fm);
        }
        self.code = self.converted();
    }

    pub(crate) fn arrived(&self, target_pm: i32) -> bool {
        self.ramp_fm == self.target_fm(target_pm)
    }

    fn target_fm(&self, pm: i32) -> i64 {
        i64::from(pm.max(self.low_pm).min(self.high_pm)) * FM
    }

    /// The nearest code: (ramp - low) / range * highest, rounded.
    fn converted(&self) -> u16 {
        let above_fm = self
            .ramp_fm
            .saturating_sub(i64::from(self.low_pm) * FM)
            .max(0) as u64;
        let above_fm = above_fm.min(self.range_fm.get());
        // At most 4e12 fm times 65535: below 2^58.
        ((above_fm * self.highest_code.get() + self.range_fm.get() / 2) / self.range_fm) as u16
    }
}
