//! The tuning follows the estimate.
//!
//! Towards caution (more gain than tuned for) at once, towards boldness slowly. While the tuning is within the interval of the estimate it
//! settles there.

use super::belief::Finding;
use serde::Serialize;

/// Where the tuning stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
#[serde(rename_all = "kebab-case")]
#[repr(u8)]
pub enum AdaptMode {
    /// Too little motion so far, or nothing to learn from: the bead is lost or held by something, or the loop does not control it.
    /// Nothing changes.
    #[default]
    Learning = 0,
    /// The tuning in force agrees with the estimate.
    Known = 1,
    /// The estimate has left the tuning in force, which is on its way to it.
    Uncertain = 2,
    /// The estimate is beyond the gains or delays that the law can be tuned to. The tuning is at the end of its range.
    AtLimit = 3,
}

/// Delays that the law can be tuned to, beyond the design's, samples.
pub(super) const DELAYS: [f64; TUNINGS] = [-1.0, -0.5, 0.0, 0.5, 1.0, 1.5];
/// How many, and half the step between two.
pub(super) const TUNINGS: usize = 6;
const HALF_STEP: f64 = 0.5 * (DELAYS[1] - DELAYS[0]);
/// The design's own among them.
pub(super) const NOMINAL: usize = 2;
/// Largest gain over the design's that the law is tuned to, and largest design's over the gain.
const RANGE: f64 = 2.5;
/// Largest change per tick of the logarithm of the gain in force downwards: something that holds the bead is known by its stillness after
/// some 200 ticks, and the gain in force has changed by 10 % then. Half the gain is in force 1.4 s after it is known at 1 kHz.
const DOWN_PER_TICK: f64 = 0.0005;
/// Standard deviations of a 95 % interval. A tuning outside of it follows the estimate at once.
pub(super) const INTERVAL: f64 = cellpos_numeric::statistics::Z95;
/// Logarithm of the odds by which a delay in force is too short, or too long: it is outside a 95 % interval.
const DELAY_SURE: f64 = 3.66;
/// Logarithm of the odds of a change that is reported: one of 3000 is false if the noise is as it is measured.
const REPORT_SURE: f64 = 8.0;
/// A change of the gain that is reported, by its logarithm. The tuning, and a standard deviation of the estimate, must first be within half
/// of that change of the estimate, so that one step is reported once.
pub(super) const REPORTED_GAIN: f64 = 0.14;

/// A change of the tuning that a run reports.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AdaptNews {
    /// Estimated gain before and now, over the design's.
    pub gain: [f64; 2],
    /// Delay in force beyond the design's before and now, samples.
    pub delay_samples: [f64; 2],
    /// Ticks that the change took.
    pub ticks: u64,
}

impl AdaptNews {
    /// With times in ticks, `interval` from fix to fix.
    pub(super) fn in_ticks(self, interval: f64) -> Self {
        Self {
            ticks: (self.ticks as f64 * interval).round() as u64,
            ..self
        }
    }
}

/// The tuning in force, and how it came to be.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Retuning {
    pub log_gain: f64,
    pub member: usize,
    pub mode: AdaptMode,
    reported: Reported,
    /// Ticks since the tuning in force left the one reported last.
    away: u64,
}

/// The plant as it was reported last.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Reported {
    log_gain: f64,
    log_sd: f64,
    member: usize,
}

/// What a tick does to the delay in force.
enum DelayStep {
    None,
    Taken,
    /// The law cannot be tuned to the delay that the estimate asks for.
    Blocked,
}

impl Default for Retuning {
    fn default() -> Self {
        Self {
            log_gain: 0.0,
            member: NOMINAL,
            mode: AdaptMode::Learning,
            reported: Reported {
                log_gain: 0.0,
                log_sd: 0.0,
                member: NOMINAL,
            },
            away: 0,
        }
    }
}

impl Retuning {
    /// A tick in which nothing may change.
    pub(super) fn wait(&mut self) {
        self.mode = AdaptMode::Learning;
    }

    /// A tick in which the estimate may come into force.
    pub(super) fn follow(&mut self, found: Option<&Finding>, usable: &[bool; TUNINGS]) {
        // What is surely less than any plant's is no gain: something holds the bead.
        let of_a_plant = |found: &&Finding| found.gain + found.gain_sd > 1.0 / RANGE;
        let Some(found) = found.filter(of_a_plant) else {
            self.wait();
            return;
        };
        let sd = found.log_sd;
        let off = found.log_gain - self.log_gain;
        let outside = off.abs() > INTERVAL * sd;
        self.go(if outside { off } else { off * DOWN_PER_TICK });
        // The range ends short of the estimate by more than its uncertainty.
        let beyond = off.abs() > sd && self.log_gain == self.log_gain_after(off);
        self.mode = match self.follow_delay(found, usable) {
            DelayStep::Blocked => AdaptMode::AtLimit,
            _ if beyond => AdaptMode::AtLimit,
            DelayStep::Taken => AdaptMode::Uncertain,
            DelayStep::None if outside => AdaptMode::Uncertain,
            DelayStep::None => AdaptMode::Known,
        };
    }

    /// To a gain that was measured otherwise, with its standard deviation, if it is surely the larger one.
    pub(super) fn caution(&mut self, gain: f64, sd: f64) {
        if gain > 0.0 && gain - INTERVAL * sd > self.log_gain.exp() {
            self.go(gain.ln() - self.log_gain);
        }
    }

    /// Towards another gain, by the logarithm, no faster than it may.
    pub(super) fn go(&mut self, way: f64) {
        self.log_gain = self.log_gain_after(way);
    }

    /// Where that leads, within [`RANGE`].
    fn log_gain_after(&self, way: f64) -> f64 {
        (self.log_gain + way.max(-DOWN_PER_TICK)).clamp(-RANGE.ln(), RANGE.ln())
    }

    fn follow_delay(&mut self, found: &Finding, usable: &[bool; TUNINGS]) -> DelayStep {
        let [longer, shorter] = found.delay_odds(DELAYS[self.member], HALF_STEP);
        let next = if longer > DELAY_SURE {
            self.member + 1
        } else if shorter > DELAY_SURE {
            self.member.wrapping_sub(1)
        } else {
            return DelayStep::None;
        };
        if !usable.get(next).copied().unwrap_or(false) {
            return DelayStep::Blocked;
        }
        self.member = next;
        DelayStep::Taken
    }

    /// The change to report after this tick, if any: the gain surely differs from the one reported last by more than that one's interval,
    /// or the delay surely is another one.
    pub(super) fn news(&mut self, found: Option<&Finding>) -> Option<AdaptNews> {
        let before = self.reported;
        let moved = (self.log_gain - before.log_gain).abs() > 0.5 * REPORTED_GAIN
            || self.member != before.member;
        self.away = if moved {
            self.away.saturating_add(1)
        } else {
            0
        };
        let found = found?;
        let off = (found.log_gain - self.log_gain).abs();
        if off.max(found.log_sd) > 0.5 * REPORTED_GAIN {
            return None;
        }
        let change = (found.log_gain - before.log_gain).abs();
        // Odds of a normal distribution, to its second order.
        let sure = (2.0 * REPORT_SURE).sqrt() * found.log_sd;
        let farther = 0.5 * REPORTED_GAIN + INTERVAL * before.log_sd + sure;
        let gain = change > farther;
        let surely_not = |member: usize, sure: f64| {
            let [longer, shorter] = found.delay_odds(DELAYS[member], HALF_STEP);
            longer.max(shorter) > sure
        };
        // The delay in force is the likeliest: on the way to a longer one, one in between is not reported.
        let delay = surely_not(before.member, REPORT_SURE) && !surely_not(self.member, 0.0);
        if !(gain || delay) {
            return None;
        }
        if gain {
            (self.reported.log_gain, self.reported.log_sd) = (found.log_gain, found.log_sd);
        }
        if delay {
            self.reported.member = self.member;
        }
        let news = AdaptNews {
            gain: [before, self.reported].map(|one| one.log_gain.exp()),
            delay_samples: [before, self.reported].map(|one| DELAYS[one.member]),
            ticks: self.away,
        };
        self.away = 0;
        Some(news)
    }
}
