//! How well a run kept its bead: how far the bead was from its reference, as far as fixes and estimate tell, and what the last word
//! of the run must say of it.
//!
//! A fix tells where the bead was when its frame was exposed. Between two fixes the estimate tells, with its uncertainty. If the
//! second fix is of the same bead, the way between them is that of the estimate, bent to meet the fix, and its uncertainty is that
//! of a Brownian bridge. A bead that does not feel the commands goes on as its last fixes went.

use crate::life::Request;
use crate::tick_record::{TickFlags, TickRecord};
use cellpos_control::design::bound_rms_um;
use cellpos_vision::Decision;
use serde::Serialize;

/// Standard deviations of hold within which a bead counts as held: by chance it is outside in one tick of a million.
const HELD_SIGMA: f64 = 5.0;
/// RMS of a hold over the lowest possible: PI, the widest of the laws, holds at 57 nm where 44.5 nm is possible.
const LAW_SHARE: f64 = 1.3;
/// Time constant of the share of time outside, in delays of the loop. A loop answers a disturbance within six delays, and PI's
/// integral within twenty; 40 delays outside without a break make the share 0.5.
const AWAY_DELAYS: f64 = 58.0;
/// Share of the last time outside from which a bead has strayed, and below which it is back.
const STRAYED: [f64; 2] = [0.5, 0.25];
/// Delays for which a reference must have stood still before a bead is expected there.
const STILL_DELAYS: f64 = 100.0;

/// What a hold is expected to be like.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hold {
    diffusion_um2_per_s: f64,
    period_s: f64,
    /// Exposure to the middle of the command's hold, s.
    delay_s: f64,
    sd_um: f64,
}

impl Hold {
    /// Of a bead of this diffusion (um^2/s), seen with this delay (s) in a loop of this period (s).
    pub fn new(diffusion_um2_per_s: f64, delay_s: f64, period_s: f64) -> Self {
        Self {
            diffusion_um2_per_s,
            period_s,
            delay_s: delay_s + 0.5 * period_s,
            sd_um: LAW_SHARE * bound_rms_um(diffusion_um2_per_s, 0.0, delay_s, period_s),
        }
    }

    /// Distance from the reference within which a bead counts as held, um; `variance_um2` is that of the fix.
    pub(crate) fn limit_um(&self, variance_um2: f64) -> f64 {
        let noise_um2 = if variance_um2 > 0.0 {
            variance_um2
        } else {
            0.0
        };
        HELD_SIGMA * (self.sd_um * self.sd_um + noise_um2).sqrt()
    }
}

/// Why a run that came to its end did not keep its bead.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum NotKept {
    /// The bead was lost, and one was taken that may be another.
    AnotherBead,
    /// It was out of sight when the run ended.
    OutOfSight,
    /// It did not follow the commands beyond a level: the actuator is clipped.
    Clipped,
    /// The loop had frozen it when the run ended, for a reason that would have ended the run had it lasted.
    Frozen,
    /// It was further from its reference, and for longer, than a loop that holds it lets it.
    Strayed,
}

/// How a run kept its bead.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Kept {
    /// Why it did not; `None`: it did.
    pub why: Option<NotKept>,
    /// RMS distance of the bead from its reference, nm: the noise of the fixes taken off, moments without a fix counted through the
    /// estimate and its uncertainty.
    pub rms_nm: Option<f64>,
    /// Share of the time within five standard deviations of hold, percent.
    pub held_percent: Option<f64>,
    /// Five standard deviations of hold, nm; `None` for a run that is not to hold a bead.
    pub held_within_nm: Option<f64>,
    /// Largest distance from a reference that stood still, um.
    pub furthest_um: f64,
    /// How often the bead strayed.
    pub strayed: u64,
    /// How often a bead was taken, after the one followed was lost, that may be another.
    pub other_beads: u64,
    /// Time without a fix while the loop ran, ms, and the part of it at the end of the run.
    pub unseen_ms: f64,
    /// Time without a fix at the end of the run, ms.
    pub unseen_at_end_ms: f64,
    /// Whether the bead did not follow the commands beyond a level.
    pub clipped: bool,
}

/// Sums over errors.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Sums {
    n: f64,
    sum: f64,
    squares: f64,
    /// Variances of the fixes among them.
    noise: f64,
    held: f64,
    peak: f64,
}

impl Sums {
    fn rms_nm(&self, noise: f64) -> Option<f64> {
        (self.n > 0.0).then(|| ((self.squares - noise).max(0.0) / self.n).sqrt() * 1e3)
    }
}

/// Ticks in a row without a fix. `k` counts them from 1; their errors are those of the estimate.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Gap {
    ticks: f64,
    sum: f64,
    squares: f64,
    /// Sums of error times `k`, of `k`, and of its square.
    by_k: f64,
    k: f64,
    k2: f64,
    variances: f64,
    held: f64,
    /// Largest error, and with its standard deviation.
    peak: f64,
    furthest: f64,
    last: f64,
    last_sd: f64,
}

impl Gap {
    fn add(&mut self, error_um: f64, sd_um: f64, limit_um: f64) {
        self.ticks += 1.0;
        self.sum += error_um;
        self.squares += error_um * error_um;
        self.by_k += error_um * self.ticks;
        self.k += self.ticks;
        self.k2 += self.ticks * self.ticks;
        self.variances += sd_um * sd_um;
        let likely_um = error_um.abs() + sd_um;
        self.held += f64::from(u8::from(likely_um <= limit_um));
        self.peak = self.peak.max(error_um.abs());
        self.furthest = self.furthest.max(likely_um);
        (self.last, self.last_sd) = (error_um, sd_um);
    }

    /// Its errors when nothing is known of its end.
    fn open(&self) -> Sums {
        Sums {
            n: self.ticks,
            sum: self.sum,
            squares: self.squares + self.variances,
            noise: 0.0,
            held: self.held,
            peak: self.furthest,
        }
    }

    /// Its errors when the bead was found at `error_um` after it; `walk_um2` is the variance of its walk in a tick, and
    /// `outside` the share of the gap outside the limit.
    fn closed(&self, error_um: f64, walk_um2: f64, outside: f64) -> Sums {
        let whole = self.ticks + 1.0;
        let bend = (error_um - self.last) / whole;
        let bridge = walk_um2 * (whole * whole - 1.0) / 6.0;
        let widest_um = (0.25 * walk_um2 * whole).sqrt();
        Sums {
            n: self.ticks,
            sum: self.sum + bend * self.k,
            squares: self.squares + 2.0 * bend * self.by_k + bend * bend * self.k2 + bridge,
            noise: 0.0,
            held: self.ticks * (1.0 - outside),
            peak: self.peak.max(error_um.abs()) + widest_um,
        }
    }
}

/// The last error that a fix showed.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Seen {
    time_ns: i64,
    error_um: f64,
}

/// A bead that does not feel the commands goes on as it goes: the way from the first fix of that time to the last.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Adrift {
    first: Seen,
    last: Seen,
}

impl Adrift {
    /// Error at a time after the last fix and its standard deviation, um, for a bead whose walk has this variance in a second.
    fn error_um(&self, now_ns: i64, walk_um2_per_s: f64) -> (f64, f64) {
        let seconds = |from_ns: i64, to_ns: i64| (to_ns - from_ns) as f64 * 1e-9;
        let watched_s = seconds(self.first.time_ns, self.last.time_ns);
        let since_s = seconds(self.last.time_ns, now_ns);
        if watched_s <= 0.0 {
            return (self.last.error_um, (walk_um2_per_s * since_s).sqrt());
        }
        let speed = (self.last.error_um - self.first.error_um) / watched_s;
        // Its own walk, and what the walk meanwhile left unknown of its speed.
        let variance_um2 = walk_um2_per_s * since_s * (1.0 + since_s / watched_s);
        (
            self.last.error_um + speed * since_s,
            variance_um2.max(0.0).sqrt(),
        )
    }
}

/// Watches how a run keeps its bead, record by record.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct KeepWatch {
    hold: Option<Hold>,
    sums: Sums,
    gap: Gap,
    /// Whether the ticks of the gap are among those whose errors count.
    gap_counts: bool,
    between: u32,
    seen: Option<Seen>,
    /// Reference, and since when it has stood still.
    still: Option<(f64, i64)>,
    /// Share of the last time outside, and whether that makes a bead that strayed.
    outside: f64,
    away: bool,
    strayed: u64,
    other_beads: u64,
    furthest_um: f64,
    blind_ns: i64,
    blind_since_ns: Option<i64>,
    last_ns: i64,
    /// Since when the bead has been frozen: nothing drives it back.
    frozen_since_ns: Option<i64>,
    clipped: bool,
    adrift: Option<Adrift>,
}

impl KeepWatch {
    pub(crate) fn expecting(hold: Hold) -> Self {
        Self {
            hold: Some(hold),
            ..Self::default()
        }
    }

    /// Whether the bead of a record is to be held: the loop is closed, and nobody asked for a freeze.
    pub(crate) fn is_held(record: &TickRecord) -> bool {
        let asked = record.request != Request::None as u8 && record.request != Request::Skip as u8;
        record.is_running() && !(record.flags.has(TickFlags::FREEZE) && asked)
    }

    /// The bead of a tick is not to be held.
    pub(crate) fn pause(&mut self) {
        if self.gap_counts {
            let open = self.gap.open();
            self.take(open);
        }
        self.blind_over(self.last_ns);
        self.gap = Gap::default();
        (self.seen, self.still, self.between) = (None, None, 0);
        (self.adrift, self.frozen_since_ns) = (None, None);
        (self.outside, self.away) = (0.0, false);
    }

    /// Takes a record whose bead is to be held; `counts` says whether its error is one that counts.
    pub(crate) fn add(&mut self, record: &TickRecord, counts: bool) {
        self.last_ns = record.time_ns;
        let frozen = record.flags.has(TickFlags::FREEZE);
        self.frozen_since_ns = frozen.then(|| self.frozen_since_ns.unwrap_or(record.time_ns));
        self.clipped |= record.flags.has(TickFlags::CLIPPED);
        let stands = |&(um, _): &(f64, i64)| um == record.target_um;
        self.still =
            Some((self.still.filter(stands)).unwrap_or((record.target_um, record.time_ns)));
        let error_um = record.error_um;
        if error_um.is_finite() {
            self.take_fix(record, error_um, counts);
        } else if record.flags.has(TickFlags::BETWEEN) && self.gap.ticks == 0.0 {
            self.between = self.between.saturating_add(1);
        } else {
            let (off_um, sd_um) = match &self.adrift {
                Some(adrift) => adrift.error_um(record.time_ns, self.walk_um2(1.0)),
                None => (
                    record.estimate_um - record.target_um,
                    record.estimate_sd_um.max(0.0),
                ),
            };
            if off_um.is_finite() {
                self.gap.add(off_um, sd_um, self.limit_um(f64::NAN));
                self.gap_counts = counts;
            }
            self.blind_since_ns.get_or_insert(record.time_ns);
            self.between = 0;
        }
    }

    fn limit_um(&self, variance_um2: f64) -> f64 {
        (self.hold).map_or(f64::INFINITY, |hold| hold.limit_um(variance_um2))
    }

    /// Variance of the bead's walk in a time, um^2.
    fn walk_um2(&self, seconds: f64) -> f64 {
        (self.hold).map_or(0.0, |hold| 2.0 * hold.diffusion_um2_per_s * seconds)
    }

    fn take_fix(&mut self, record: &TickRecord, error_um: f64, counts: bool) {
        let limit_um = self.limit_um(record.variance_um2);
        let other = record.decision == Decision::Reacquired as u8;
        self.other_beads += u64::from(other);
        let outside = self.outside_since(error_um, limit_um, record.time_ns);
        if self.gap.ticks > 0.0 && self.gap_counts {
            let walk_um2 = self.walk_um2(self.hold.map_or(0.0, |hold| hold.period_s));
            // Three standard deviations from where the lost one should be it is hardly the same.
            let elsewhere = (error_um - self.gap.last).abs() > 3.0 * self.gap.last_sd;
            let gap = if other && elsewhere {
                self.gap.open()
            } else {
                self.gap.closed(error_um, walk_um2, outside)
            };
            self.take(gap);
        }
        self.blind_over(record.time_ns);
        self.gap = Gap::default();
        if counts {
            let weight = 1.0 + f64::from(self.between);
            let variance_um2 = if record.variance_um2 > 0.0 {
                record.variance_um2
            } else {
                0.0
            };
            self.take(Sums {
                n: weight,
                sum: weight * error_um,
                squares: weight * error_um * error_um,
                noise: weight * variance_um2,
                held: weight * f64::from(u8::from(error_um.abs() <= limit_um)),
                peak: error_um.abs(),
            });
        }
        self.between = 0;
        let walk_um2 = self.frozen_since_ns.map_or(0.0, |since_ns| {
            self.walk_um2((record.time_ns - since_ns) as f64 * 1e-9)
        });
        let walked_um = self.limit_um(record.variance_um2.max(0.0) + walk_um2);
        let strayed = self.outside_since(error_um, walked_um, record.time_ns);
        self.judge(strayed, error_um, record.time_ns);
        let seen = Seen {
            time_ns: record.time_ns,
            error_um,
        };
        self.seen = Some(seen);
        self.adrift = record.flags.has(TickFlags::CLIPPED).then_some(Adrift {
            first: self.adrift.map_or(seen, |adrift| adrift.first),
            last: seen,
        });
    }

    /// The share of the time since the fix before in which the bead was further off than the limit: it went straight.
    fn outside_since(&self, error_um: f64, limit_um: f64, now_ns: i64) -> f64 {
        let ends = f64::from(u8::from(error_um.abs() > limit_um));
        let period_ns = self.hold.map_or(0.0, |hold| hold.period_s * 1e9);
        let near = |seen: &Seen| (now_ns - seen.time_ns) as f64 <= 1.5 * period_ns;
        let Some(before) = self.seen.filter(|seen| !near(seen)) else {
            return ends;
        };
        let (from_um, to_um) = (before.error_um.abs(), error_um.abs());
        let (low_um, high_um) = (from_um.min(to_um), from_um.max(to_um));
        if low_um > limit_um {
            1.0
        } else if high_um <= limit_um {
            0.0
        } else {
            (high_um - limit_um) / (high_um - low_um)
        }
    }

    /// Whether the bead has strayed from a reference that stands still; one that is frozen may walk.
    fn judge(&mut self, outside: f64, error_um: f64, now_ns: i64) {
        let Some(hold) = self.hold else { return };
        let ns = |delays: f64| delays * hold.delay_s * 1e9;
        let still = |(_, since_ns): (f64, i64)| (now_ns - since_ns) as f64 >= ns(STILL_DELAYS);
        if !self.still.is_some_and(still) {
            (self.outside, self.away) = (0.0, false);
            return;
        }
        self.furthest_um = self.furthest_um.max(error_um.abs());
        let since_ns = self.seen.map_or(0, |seen| now_ns - seen.time_ns);
        let kept = (-(since_ns as f64) / ns(AWAY_DELAYS)).exp();
        self.outside = outside + (self.outside - outside) * kept;
        let [strays, back] = STRAYED;
        if !self.away && self.outside >= strays {
            self.away = true;
            self.strayed += 1;
        } else if self.outside < back {
            self.away = false;
        }
    }

    fn take(&mut self, more: Sums) {
        let sums = &mut self.sums;
        sums.n += more.n;
        sums.sum += more.sum;
        sums.squares += more.squares;
        sums.noise += more.noise;
        sums.held += more.held;
        sums.peak = sums.peak.max(more.peak);
    }

    fn blind_over(&mut self, now_ns: i64) {
        if let Some(since_ns) = self.blind_since_ns.take() {
            self.blind_ns += now_ns - since_ns;
        }
    }

    /// All errors that count, those of a gap that is still open among them.
    fn all(&self) -> Sums {
        let mut all = *self;
        if self.gap_counts {
            all.take(self.gap.open());
        }
        all.sums
    }

    /// Positions that the errors are of: fixes, and moments without one.
    pub(crate) fn positions(&self) -> u64 {
        self.all().n as u64
    }

    /// RMS of measured position less reference, moments without a fix by the estimate, nm.
    pub(crate) fn rms_measured_nm(&self) -> Option<f64> {
        self.all().rms_nm(0.0)
    }

    /// Mean of the same, nm.
    pub(crate) fn mean_nm(&self) -> Option<f64> {
        let all = self.all();
        (all.n > 0.0).then(|| all.sum / all.n * 1e3)
    }

    /// Largest of the same, nm.
    pub(crate) fn peak_nm(&self) -> Option<f64> {
        let all = self.all();
        (all.n > 0.0).then_some(all.peak * 1e3)
    }

    /// What there is to say of the run so far.
    pub(crate) fn kept(&self) -> Kept {
        let all = self.all();
        let unseen_ns = self
            .blind_since_ns
            .map_or(0, |since_ns| self.last_ns - since_ns);
        let frozen = self.frozen_since_ns.is_some();
        let why = if self.other_beads > 0 {
            Some(NotKept::AnotherBead)
        } else if frozen && self.blind_since_ns.is_some() {
            Some(NotKept::OutOfSight)
        } else if self.clipped {
            Some(NotKept::Clipped)
        } else if frozen {
            Some(NotKept::Frozen)
        } else {
            (self.strayed > 0).then_some(NotKept::Strayed)
        };
        Kept {
            why,
            rms_nm: all.rms_nm(all.noise),
            held_percent: (all.n > 0.0 && self.hold.is_some())
                .then(|| 100.0 * (all.held / all.n).clamp(0.0, 1.0)),
            held_within_nm: self.hold.map(|hold| hold.limit_um(0.0) * 1e3),
            furthest_um: self.furthest_um,
            strayed: self.strayed,
            other_beads: self.other_beads,
            unseen_ms: (self.blind_ns + unseen_ns) as f64 * 1e-6,
            unseen_at_end_ms: unseen_ns as f64 * 1e-6,
            clipped: self.clipped,
        }
    }
}
