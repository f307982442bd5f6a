//! The tuning follows the estimate.
//!
//! Towards caution (more gain than believed) at once and all the way; towards boldness slowly, and to the near end of the estimate's
//! interval only. While the two agree the tuning settles at the estimate, no faster than the estimate itself changes.

use super::evidence::Finding;
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
}

/// Delays that the law can be tuned to, beyond the design's, samples.
pub(super) const DELAYS: [f64; TUNINGS] = [-1.0, -0.5, 0.0, 0.5, 1.0, 1.5];
/// How many.
pub(super) const TUNINGS: usize = 6;
/// The design's own among them.
pub(super) const NOMINAL: usize = 2;
/// Gains, over the design's, that the law is tuned to.
const GAINS: [f64; 2] = [0.4, 2.5];
/// Distance from the estimate at which the tuning sets out, towards caution and towards boldness, standard deviations. If the logarithm is
/// known to [`VAGUE`] only, it is twice that. The way towards boldness ends at [`ARRIVED`].
const SET_OUT: [f64; 2] = [1.5, 2.0];
const VAGUE: f64 = 0.2;
const ARRIVED: f64 = 0.7;
/// Ticks in which the tuning settles at an estimate that it agrees with: less than the estimate needs to change.
const SETTLE_TICKS: f64 = 1500.0;
/// Largest change per tick of the logarithm of the gain in force, upwards and downwards.
const UP_PER_TICK: f64 = 0.15;
const DOWN_PER_TICK: f64 = 0.001;
/// Logarithm of the likelihood ratio that makes a delay longer, and shorter.
const DELAY_SURE: [f64; 2] = [3.0, 8.0];
/// Ticks between two changes of the delay.
const DELAY_TICKS: u16 = 20;
/// A change of the gain that is reported: of its logarithm, and of how many standard deviations. The tuning, and a standard deviation of the
/// estimate, must first be within half of that change of the estimate, so that one step is reported once.
const REPORTED_GAIN: f64 = 0.14;
const REPORTED_SURE: f64 = 5.0;

/// A change of the tuning that a run reports.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AdaptNews {
    /// Gain in force before and now, over the design's.
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
    moving: bool,
    since_delay: u16,
    reported: (f64, usize),
    /// Ticks since the tuning in force left the one reported last.
    away: u64,
}

impl Default for Retuning {
    fn default() -> Self {
        Self {
            log_gain: 0.0,
            member: NOMINAL,
            mode: AdaptMode::Learning,
            moving: false,
            since_delay: u16::MAX,
            reported: (0.0, NOMINAL),
            away: 0,
        }
    }
}

impl Retuning {
    /// A tick in which nothing may change.
    pub(super) fn wait(&mut self) {
        self.mode = AdaptMode::Learning;
        self.moving = false;
    }

    /// A tick in which the estimate may come into force.
    pub(super) fn follow(&mut self, found: Option<&Finding>, usable: &[bool; TUNINGS]) {
        self.since_delay = self.since_delay.saturating_add(1);
        // What is surely less than any plant's is no gain: something holds the bead.
        let of_a_plant = |found: &&Finding| found.gain + found.gain_sd > GAINS[0];
        let Some(found) = found.filter(of_a_plant) else {
            self.wait();
            return;
        };
        let (off, sd) = (found.log_gain() - self.log_gain, found.log_sd());
        let near = off.min(0.0) + ARRIVED * sd;
        self.moving = if self.moving {
            off > 0.0 || near < 0.0
        } else {
            off.abs() > SET_OUT[usize::from(off < 0.0)] * (1.0 + (sd / VAGUE).powi(2)) * sd
        };
        self.go(match self.moving {
            true if off > 0.0 => off,
            true => near.min(0.0),
            false => off / SETTLE_TICKS,
        });
        self.moving &= off.abs() > UP_PER_TICK || off < 0.0;
        let delay_moves = self.follow_delay(found, usable);
        self.mode = if self.moving || delay_moves {
            AdaptMode::Uncertain
        } else {
            AdaptMode::Known
        };
    }

    /// Towards another gain, by the logarithm, no faster than it may.
    pub(super) fn go(&mut self, way: f64) {
        self.log_gain = (self.log_gain + way.clamp(-DOWN_PER_TICK, UP_PER_TICK))
            .clamp(GAINS[0].ln(), GAINS[1].ln());
    }

    fn follow_delay(&mut self, found: &Finding, usable: &[bool; TUNINGS]) -> bool {
        let off = found.delay - DELAYS[self.member];
        let next = if off > 0.0 {
            self.member + 1
        } else {
            self.member.wrapping_sub(1)
        };
        // Half way to the next, less towards caution.
        let half = if off > 0.0 { 0.2 } else { 0.3 };
        if off.abs() < half
            || self.since_delay < DELAY_TICKS
            || !usable.get(next).copied().unwrap_or(false)
        {
            return false;
        }
        let sure = DELAY_SURE[usize::from(off < 0.0)];
        if found.ratio(DELAYS[next], DELAYS[self.member]) < sure {
            return false;
        }
        self.member = next;
        self.since_delay = 0;
        true
    }

    /// The change to report after this tick, if any.
    pub(super) fn news(&mut self, found: Option<&Finding>) -> Option<AdaptNews> {
        let (reported_gain, reported_member) = self.reported;
        let gain_off = (self.log_gain - reported_gain).abs();
        let moved = gain_off > 0.02 || self.member != reported_member;
        self.away = if moved {
            self.away.saturating_add(1)
        } else {
            0
        };
        let found = found?;
        let off = (found.log_gain() - self.log_gain).abs();
        if self.moving || off.max(found.log_sd()) > 0.5 * REPORTED_GAIN {
            return None;
        }
        let sure = (found.log_gain() - reported_gain).abs() > REPORTED_SURE * found.log_sd();
        let gain = gain_off > REPORTED_GAIN && sure;
        let late = DELAYS[self.member] - DELAYS[reported_member];
        let delay = late.abs() >= 0.5
            && found.ratio(found.delay, DELAYS[reported_member])
                > 0.5 * REPORTED_SURE * REPORTED_SURE;
        if !(gain || delay) {
            return None;
        }
        let news = AdaptNews {
            gain: [reported_gain.exp(), self.log_gain.exp()],
            delay_samples: [DELAYS[reported_member], DELAYS[self.member]],
            ticks: self.away,
        };
        self.reported = (self.log_gain, self.member);
        self.away = 0;
        Some(news)
    }
}
