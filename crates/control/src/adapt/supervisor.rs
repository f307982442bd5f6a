//! What of an estimate comes into force, and how fast.
//!
//! Towards caution (more gain, more delay than believed) at once and all the way; towards boldness slowly, and to the near end
//! of the estimate's interval only. Not at all while the two agree.

use super::window::{DELAYS, Finding, MEMBERS, NOMINAL};
use serde::Serialize;

/// What the supervisor is doing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
#[serde(rename_all = "kebab-case")]
#[repr(u8)]
pub enum AdaptMode {
    /// Too little motion so far to say anything of the plant.
    #[default]
    Waiting = 0,
    /// What is in force agrees with the estimate.
    Agreeing = 1,
    /// The tuning is on its way to the estimate.
    Moving = 2,
    /// The bead is lost or held by something, or the loop does not control it: nothing is learned and nothing changes.
    Paused = 3,
    /// The estimate is one that no plant can have: back to the design.
    Retreating = 4,
    /// The estimate has left what was confirmed: a small motion of the loop's own decides whether it is the plant's.
    Testing = 5,
    /// A disturbance makes the estimate wrong; the gain is known by the loop's own motion, which goes on.
    Disturbed = 6,
}

/// Gains, over the design's, that the law is tuned to.
pub(super) const LEAST_GAIN: f64 = 0.4;
pub(super) const MOST_GAIN: f64 = 2.5;
/// An estimate surely beyond these is none of a plant.
const DOUBT: [f64; 2] = [0.3, 4.0];
/// Difference (of logarithms) at which the tuning sets out, at which it stops, and the same in standard uncertainties.
const SET_OUT: (f64, f64) = (0.01, 2.5);
const ARRIVED: (f64, f64) = (0.003, 1.0);
/// Largest change per tick of the logarithm of the gain in force, upwards and downwards.
const UP_PER_TICK: f64 = 0.15;
const DOWN_PER_TICK: f64 = 0.003;
/// Difference of delays that is worth a change, samples; noise variances by which the other delay must fit better.
const DELAY_OFF: f64 = 0.3;
const DELAY_SURE: f64 = 20.0;
/// Ticks between two changes of the delay, upwards and downwards.
const DELAY_TICKS: [u16; 2] = [2, 50];
/// Ticks for which less delay must have been better: what begins to shake the bead is a line after less.
const LESS_TICKS: u16 = 400;
/// Ticks that a retreat lasts at least.
const RETREAT_TICKS: u16 = 1000;
/// A retreat is told of after so many.
const DOUBTFUL_TICKS: u16 = 1500;
/// What is told of: change of the logarithm of the gain; of the delay, samples.
const TOLD_GAIN: f64 = 0.14;
const TOLD_DELAY: f64 = 0.5;
/// A change is told of when nothing has moved for so many ticks, or when it has grown to this.
const SETTLED_TICKS: u16 = 500;
const TOLD_AT_ONCE: f64 = 0.4;

/// A change of the tuning that is worth telling of.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AdaptNews {
    /// Gain in force before and now, over the design's.
    pub gain: [f64; 2],
    /// Delay in force beyond the design's before and now, samples.
    pub delay_samples: [f64; 2],
    /// Ticks that the change took.
    pub ticks: u64,
    /// It is a retreat to the design, on doubt.
    pub retreat: bool,
}

impl AdaptNews {
    /// With times in ticks, of which there are so many from fix to fix.
    pub(super) fn in_ticks(self, interval: f64) -> Self {
        Self {
            ticks: (self.ticks as f64 * interval).round() as u64,
            ..self
        }
    }
}

/// The tuning in force, and how it came to be.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Force {
    pub log_gain: f64,
    pub member: usize,
    pub mode: AdaptMode,
    moving: bool,
    since_delay: u16,
    /// Ticks in a row in which less delay was surely better.
    less: u16,
    retreat: u16,
    told: (f64, usize),
    /// Ticks since what is in force left what was told; ticks without motion.
    away: u64,
    still: u16,
    retreat_told: bool,
    /// Ticks of a retreat so far.
    doubtful: u16,
}

impl Default for Force {
    fn default() -> Self {
        Self {
            log_gain: 0.0,
            member: NOMINAL,
            mode: AdaptMode::Waiting,
            moving: false,
            since_delay: u16::MAX,
            less: 0,
            retreat: 0,
            told: (0.0, NOMINAL),
            away: 0,
            still: 0,
            retreat_told: false,
            doubtful: 0,
        }
    }
}

impl Force {
    /// A tick in which nothing may change.
    pub fn pause(&mut self) {
        self.mode = AdaptMode::Paused;
        self.moving = false;
    }

    /// A tick in which the estimate may come into force. Whether it is one of doubt, in which what was found is worth nothing.
    /// The logarithm of the gain goes no lower than `least` and no higher than `most`, unless it is there.
    pub fn follow(
        &mut self,
        found: Option<&Finding>,
        usable: &[bool; MEMBERS],
        [least, most]: [f64; 2],
    ) -> bool {
        self.since_delay = self.since_delay.saturating_add(1);
        self.still = self.still.saturating_add(1);
        let Some(found) = found else {
            self.less = 0;
            if self.mode != AdaptMode::Retreating {
                self.mode = AdaptMode::Waiting;
            }
            if self.retreat > 0 {
                self.retreat_step();
            }
            return false;
        };
        let sure = 3.0 * found.gain_sd;
        if found.gain + sure < DOUBT[0] || found.gain - sure > DOUBT[1] {
            self.retreat = RETREAT_TICKS;
            self.retreat_step();
            return true;
        }
        if self.retreat > 0 {
            self.retreat_step();
            return false;
        }
        self.retreat_told = false;
        let aim = found.log_gain().min(most.max(self.log_gain)).max(least);
        let (off, sd) = (aim - self.log_gain, found.log_sd());
        let (smallest, sds) = if self.moving { ARRIVED } else { SET_OUT };
        self.moving = off.abs() > smallest.max(sds * sd);
        if self.moving {
            // Towards boldness to the near end of the interval and no further.
            self.go(if off < 0.0 { (off + sd).min(0.0) } else { off });
        }
        let delay_moves = self.follow_delay(found, usable);
        self.mode = if self.moving || delay_moves {
            AdaptMode::Moving
        } else {
            AdaptMode::Agreeing
        };
        false
    }

    fn go(&mut self, way: f64) {
        let before = self.log_gain;
        self.log_gain = (before + way.clamp(-DOWN_PER_TICK, UP_PER_TICK))
            .clamp(LEAST_GAIN.ln(), MOST_GAIN.ln());
        if (self.log_gain - before).abs() > 1e-4 {
            self.still = 0;
        }
    }

    fn follow_delay(&mut self, found: &Finding, usable: &[bool; MEMBERS]) -> bool {
        let off = found.delay - DELAYS[self.member];
        if off.abs() < DELAY_OFF {
            self.less = 0;
            return false;
        }
        let next = if off > 0.0 {
            self.member + 1
        } else {
            self.member.wrapping_sub(1)
        };
        let open = usable.get(next).copied().unwrap_or(false);
        let surely = open && found.worse[self.member] - found.worse[next] > DELAY_SURE;
        self.less = if surely && off < 0.0 {
            self.less.saturating_add(1)
        } else {
            0
        };
        let bold = off < 0.0 && self.less < LESS_TICKS;
        if bold || !surely || self.since_delay < DELAY_TICKS[usize::from(off < 0.0)] {
            return false;
        }
        self.member = next;
        self.since_delay = 0;
        self.still = 0;
        true
    }

    /// A tick in which nothing is known any more: a step of the way back to a gain (its logarithm) that was, and to the delay last
    /// told of.
    pub fn back_to(&mut self, log_gain: f64) {
        self.go(log_gain - self.log_gain);
        self.step_delay(self.told.1);
    }

    /// A step of the way back to the design.
    fn retreat_step(&mut self) {
        self.mode = AdaptMode::Retreating;
        self.moving = false;
        self.retreat = self.retreat.saturating_sub(1);
        self.go(-self.log_gain);
        self.step_delay(NOMINAL);
    }

    fn step_delay(&mut self, to: usize) {
        if self.member != to && self.since_delay >= DELAY_TICKS[1] {
            self.member = if self.member > to {
                self.member - 1
            } else {
                self.member + 1
            };
            self.since_delay = 0;
        }
    }

    /// A tick of which nothing is told: a change has to stand for a while after it.
    pub fn hush(&mut self) {
        self.still = 0;
    }

    /// What is worth telling of after this tick.
    pub fn news(&mut self) -> Option<AdaptNews> {
        let (told_gain, told_member) = self.told;
        let gain_off = (self.log_gain - told_gain).abs();
        let delay_off = (DELAYS[self.member] - DELAYS[told_member]).abs();
        self.away = if gain_off > 0.02 || delay_off > 0.0 {
            self.away.saturating_add(1)
        } else {
            0
        };
        // A retreat from next to nothing is none, nor one that is soon over: something shook the bead.
        let retreating = self.mode == AdaptMode::Retreating;
        self.doubtful = if retreating {
            self.doubtful.saturating_add(1)
        } else {
            0
        };
        let far = told_gain.abs() > TOLD_GAIN || told_member != NOMINAL;
        let lasting = self.doubtful > DOUBTFUL_TICKS;
        let doubt = lasting && !self.retreat_told && far;
        let much = !retreating && (gain_off > TOLD_GAIN || delay_off >= TOLD_DELAY);
        let settled = self.still >= SETTLED_TICKS || gain_off > TOLD_AT_ONCE;
        if !(doubt || (much && settled)) {
            return None;
        }
        let news = AdaptNews {
            gain: [told_gain.exp(), self.log_gain.exp()],
            delay_samples: [DELAYS[told_member], DELAYS[self.member]],
            ticks: self.away,
            retreat: self.mode == AdaptMode::Retreating,
        };
        self.retreat_told |= doubt;
        self.told = (self.log_gain, self.member);
        self.away = 0;
        Some(news)
    }
}
