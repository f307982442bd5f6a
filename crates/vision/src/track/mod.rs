//! Following one bead from frame to frame, never on to another without saying so.
//!
//! Each frame ends in one of four states and one decision. The bead's motion is predicted from the commanded flow and
//! an estimated drift. A fix that lies within the gate of the prediction and agrees in intensity, size and residual is taken.
//! If there is none, the whole frame is looked at: a bead that is alone in it is taken wherever a step of the flow can have
//! carried it. Other beads near by are followed too: when two beads have touched, a fix is taken only if every reading in
//! which it belongs to the other is less likely by a set margin. Otherwise the tracker coasts and, after its limit, is
//! lost: being lost is an answer, following another bead is not.

mod beside;
mod carried;
mod cell;
mod config;
mod identity;
mod look;
mod motion;
mod neighbours;
mod rejected;
mod scenery;
mod standing;
mod stays;
mod touching;

use crate::config::ConfigError;
use crate::detector::Detector;
use crate::fix::{Fix, FixQuality};
use crate::frame::Frame;
use crate::localiser::Localiser;
use beside::{Beside, Owed};
pub use cell::{CellStep, CellTracker};
pub use config::{Commanded, Decision, TrackState, TrackStep, TrackerConfig};
use identity::Identity;
use motion::{Motion, Randomness};
use neighbours::{Candidate, Claim, MAX_BEADS, Neighbours};
use rejected::Rejected;
use scenery::Scenery;
use standing::{Chosen as Sighted, Standing};

/// Frames between measurements of the size while tracking.
const SIZE_STRIDE: u32 = 8;

/// Share of what noise, shape and change may be, a mean over the last fixes, from which the end is near, and below which it no longer
/// is; and the share of a new fix in the mean.
const NEAR_LIMIT: (f64, f64) = (0.7, 0.6);
const NEAR_FORGETTING: f64 = 1.0 / 32.0;

/// Share of the chosen bead's amplitude below which a candidate is not a bead.
const LEAST_SHARE: f64 = 0.3;

/// The bead chosen, or on the way to it.
#[derive(Debug, Clone, Copy)]
struct Chosen {
    motion: Motion,
    identity: Identity,
    confirmed: u32,
    last_fix_s: f64,
}

/// Tracks one bead. Allocates only when made.
#[derive(Debug, Clone)]
pub struct Tracker {
    config: TrackerConfig,
    randomness: Randomness,
    localiser: Localiser,
    detector: Detector,
    neighbours: Neighbours,
    standing: Standing,
    chosen: Option<Chosen>,
    aim: Option<(f64, f64)>,
    frames: u32,
    /// Expected way during this frame's exposure, px, and the exposure time, s.
    streak_px: (f64, f64),
    exposure_s: f64,
    candidates: [Option<Candidate>; MAX_BEADS],
    /// What else was seen when the chosen bead was last taken among others.
    beside: Beside,
    /// A look beside the bead, which was taken without it.
    owed: Option<Owed>,
    rejected: Rejected,
    /// What stands still in the picture, and whether this frame is to be learnt.
    scenery: Scenery,
    learns: bool,
    /// Share of what may be that the last fixes have used, and whether the end is near.
    used: f64,
    near_limit: bool,
}

impl Tracker {
    /// A tracker that searches.
    ///
    /// # Errors
    /// Names the first setting that cannot be used.
    pub fn new(localiser: Localiser, config: TrackerConfig) -> Result<Self, ConfigError> {
        config.check()?;
        let detector = Detector::new(&localiser, 4 * MAX_BEADS);
        Ok(Tracker {
            config,
            randomness: Randomness::of(&config),
            localiser,
            detector,
            neighbours: Neighbours::default(),
            standing: Standing::default(),
            chosen: None,
            aim: None,
            frames: 0,
            streak_px: (0.0, 0.0),
            exposure_s: 0.0,
            candidates: [None; MAX_BEADS],
            beside: Beside::default(),
            owed: None,
            rejected: Rejected::default(),
            scenery: Scenery::new(),
            learns: false,
            used: 0.0,
            near_limit: false,
        })
    }

    /// Where the tracker stands.
    pub fn state(&self) -> TrackState {
        self.standing.state
    }

    /// The localiser in use.
    pub fn localiser(&self) -> &Localiser {
        &self.localiser
    }

    /// Forgets the bead and searches for the one nearest to `aim` (px), or for the strongest without an aim. This is
    /// the operator's way to settle what the tracker calls ambiguous.
    pub fn choose(&mut self, aim: Option<(f64, f64)>) {
        self.aim = aim;
        self.scenery.forget();
        self.search_anew();
    }

    /// Forgets the bead and searches as at the start.
    pub fn search_anew(&mut self) {
        self.chosen = None;
        self.neighbours = Neighbours::default();
        self.beside = Beside::default();
        self.owed = None;
        self.standing.state = TrackState::Searching;
    }

    /// Says that what is followed is no free bead: it did not move with the PZT. It is not chosen again where it stands.
    pub fn reject(&mut self) {
        if let Some(chosen) = self.chosen {
            self.rejected.add(chosen.motion.position());
            self.search_anew();
        }
    }

    /// Takes in the frame exposed about `time_s`, with what was commanded: a flow velocity since the frame before (px/s), or
    /// all of [`Commanded`]. Without a frame, or with a time that has not moved on, the prediction is carried on.
    pub fn step(
        &mut self,
        frame: Option<&Frame>,
        time_s: f64,
        commanded: impl Into<Commanded>,
    ) -> TrackStep {
        let step = self.step_at_once(frame, time_s, commanded);
        if let Some(frame) = frame {
            self.look_beside(frame);
        }
        TrackStep {
            neighbours: self.neighbours.count() as u8,
            ..step
        }
    }

    /// As [`Tracker::step`], but leaves to [`Tracker::look_beside`] what this fix does not need, for whom the fix is urgent.
    pub fn step_at_once(
        &mut self,
        frame: Option<&Frame>,
        time_s: f64,
        commanded: impl Into<Commanded>,
    ) -> TrackStep {
        self.owed = None;
        let Commanded {
            flow_px_per_s,
            streak_px,
            turn_px,
            exposure_s,
        } = commanded.into();
        self.streak_px = self
            .chosen
            .map_or(streak_px, |c| c.motion.way_px(streak_px, exposure_s));
        self.exposure_s = exposure_s;
        let turn_px = (self.chosen).map_or(turn_px, |c| c.motion.way_px(turn_px, 0.0));
        self.localiser.expect_streak(self.streak_px);
        self.localiser.expect_turn(turn_px);
        let (dt_s, time_s) = self.standing.elapse(time_s);
        self.frames = self.frames.wrapping_add(1);
        if let Some(chosen) = &mut self.chosen {
            chosen.motion.predict(dt_s, flow_px_per_s, &self.randomness);
        }
        self.neighbours
            .predict(dt_s, flow_px_per_s, &self.randomness);
        let before = self.chosen;
        let mut scenery = std::mem::take(&mut self.scenery);
        let seen = frame.map(|frame| scenery.without(*frame));
        let (decision, fix) = match (&seen, self.chosen) {
            (None, _) => (Decision::NoFrame, None),
            (Some(frame), None) => self.search(frame, time_s),
            (Some(frame), Some(chosen)) if chosen.confirmed < self.config.confirm_frames => {
                self.confirm(frame, chosen, time_s)
            }
            (Some(frame), Some(chosen)) => self.follow(frame, chosen, time_s),
        };
        self.scenery = scenery;
        let decision = match decision {
            Decision::Accepted if self.near_limit => Decision::NearLimit,
            other => other,
        };
        let sighted = |chosen: Chosen| Sighted {
            motion: chosen.motion,
            confirmed: chosen.confirmed >= self.config.confirm_frames,
            last_fix_s: chosen.last_fix_s,
        };
        let (before, now) = (before.map(sighted), self.chosen.map(sighted));
        let limit_s = self.config.coast_limit_s;
        let step = self.standing.settle(decision, fix, before, now, limit_s);
        self.learns = step.state == TrackState::Tracking
            && decision.is_accepted()
            && self.frames.is_multiple_of(self.config.neighbour_stride);
        TrackStep {
            neighbours: self.neighbours.count() as u8,
            ..step
        }
    }

    /// Takes a fix into the mean of what is used up.
    fn take_use(&mut self, used: f64) {
        self.used += NEAR_FORGETTING * (used - self.used);
        let (from, below) = NEAR_LIMIT;
        self.near_limit = self.used > if self.near_limit { below } else { from };
    }

    fn search(&mut self, frame: &Frame, time_s: f64) -> (Decision, Option<Fix>) {
        self.look_around(frame, false, None);
        let aim = self.aim;
        let distance = |c: &Candidate| match aim {
            Some((x, y)) => f64::hypot(c.fix.x_px - x, c.fix.y_px - y),
            None => -c.fix.snr,
        };
        let good = self
            .candidates
            .iter()
            .flatten()
            .filter(|c| c.fix.verdict == FixQuality::Good);
        let apart_px = self.apart_px();
        let best = good
            .filter(|c| !self.rejected.holds(&c.fix, apart_px))
            .min_by(|a, b| distance(a).total_cmp(&distance(b)))
            .copied();
        self.remember_beside(best.as_ref());
        let Some(best) = best else {
            let seen = self.candidates.iter().flatten().next().map(|c| c.fix);
            let decision = |fix: Fix| match fix.verdict {
                FixQuality::Good => Decision::Stays,
                verdict => Decision::refusing(verdict),
            };
            return (seen.map_or(Decision::NothingFound, decision), seen);
        };
        self.chosen = Some(Chosen {
            motion: Motion::new(&best.fix),
            identity: Identity::new(&best.fix, best.size),
            confirmed: 1,
            last_fix_s: time_s,
        });
        (Decision::Confirming, Some(best.fix))
    }

    fn confirm(
        &mut self,
        frame: &Frame,
        mut chosen: Chosen,
        time_s: f64,
    ) -> (Decision, Option<Fix>) {
        let fix = (self.localiser).locate(frame, Some(chosen.motion.position()));
        let mut seen = Candidate::new(fix, self.localiser.relative_size(&fix));
        let mut stays = self.is_predicted(&chosen, &seen);
        if !stays {
            self.look_around(frame, false, None);
            let away = |c: &Candidate| chosen.motion.distance2(&c.fix);
            let others = self.candidates.iter().flatten();
            if let Some(nearest) = others.min_by(|a, b| away(a).total_cmp(&away(b))) {
                seen = *nearest;
                stays = self.is_predicted(&chosen, &seen);
            }
        }
        let Candidate { fix, size, .. } = seen;
        if stays {
            chosen.motion.update(&fix);
            chosen.identity.update(&fix, size);
            chosen.confirmed += 1;
            chosen.last_fix_s = time_s;
            self.chosen = Some(chosen);
            let done = chosen.confirmed >= self.config.confirm_frames;
            return (
                if done {
                    Decision::Accepted
                } else {
                    Decision::Confirming
                },
                Some(fix),
            );
        }
        // Not a bead that stays: search again with the next frame.
        self.chosen = None;
        (Decision::refusing(fix.verdict), Some(fix))
    }

    fn follow(&mut self, frame: &Frame, chosen: Chosen, time_s: f64) -> (Decision, Option<Fix>) {
        let tracking = self.standing.state == TrackState::Tracking;
        if tracking && self.neighbours.count() == 0 {
            let fix = self.localiser.locate(frame, Some(chosen.motion.position()));
            let size = if self.frames.is_multiple_of(SIZE_STRIDE) {
                self.localiser.relative_size(&fix)
            } else {
                None
            };
            let candidate = Candidate::new(fix, size);
            if self.is_predicted(&chosen, &candidate) {
                if self.frames.is_multiple_of(self.config.neighbour_stride) {
                    self.owed = Some(Owed {
                        motion: chosen.motion,
                        bead: candidate,
                        time_s,
                    });
                }
                self.take(chosen, &candidate, time_s);
                return (Decision::Accepted, Some(fix));
            }
        }
        self.follow_among_others(frame, chosen, time_s)
    }

    /// The careful way: every bead in the frame is located and the whole frame is explained.
    fn follow_among_others(
        &mut self,
        frame: &Frame,
        chosen: Chosen,
        time_s: f64,
    ) -> (Decision, Option<Fix>) {
        let all_seen = self.look_around(frame, false, None);
        // One that is where it was predicted was carried nowhere, unless another one may have come there.
        let mut seen = self.candidates.iter().flatten();
        let quiet = self.neighbours.count() == 0 && seen.any(|c| self.is_predicted(&chosen, c));
        if !quiet {
            if !all_seen {
                self.look_around(frame, true, None);
            }
            self.look_at_prediction(frame, &chosen);
            self.fit_as_carried(frame, &chosen);
            self.part_touching_beads(frame, &chosen);
        }

        let alone = self.is_alone();
        let (mut best, mut nearest) = (None::<usize>, None::<Fix>);
        let mut misfit = None;
        for (k, c) in self.candidates.iter().enumerate() {
            let Some(c) = c else { continue };
            let nearer = nearest
                .is_none_or(|n| chosen.motion.distance2(&c.fix) < chosen.motion.distance2(&n));
            if nearer {
                nearest = Some(c.fix);
                misfit = Some(if c.fix.verdict != FixQuality::Good {
                    Decision::refusing(c.fix.verdict)
                } else if !self.within_reach(&chosen.motion, &c.fix) {
                    Decision::OutsideGate
                } else {
                    Decision::OtherBead
                });
            }
            let mut ok = c.fix.verdict == FixQuality::Good && self.looks_like(&chosen, c, alone);
            // A lost bead may come back anywhere; a coasting one where the flow can have carried it.
            ok &= (self.standing.state == TrackState::Lost
                && !self.rejected.holds(&c.fix, self.apart_px()))
                || self.within_reach(&chosen.motion, &c.fix);
            let cost = |i| {
                self.neighbours
                    .cost(&chosen.motion, &self.candidates, Some(i))
            };
            if ok && best.is_none_or(|b| cost(k) < cost(b)) {
                best = Some(k);
            }
        }
        let least_amplitude = LEAST_SHARE * chosen.identity.amplitude();
        let claim = best.map(|b| {
            let certainty = self.config.certainty;
            self.neighbours.claim(
                &chosen.motion,
                &self.candidates,
                b,
                least_amplitude,
                certainty,
            )
        });
        let taken = match claim {
            Some(Claim::Ours) => best,
            _ => None,
        };
        self.update_neighbours(frame, &chosen.motion, taken, time_s);
        match (
            taken.and_then(|k| self.candidates.get(k).copied().flatten()),
            claim,
        ) {
            (Some(c), _) => {
                let decision = match self.standing.state {
                    TrackState::Tracking | TrackState::Searching => Decision::Accepted,
                    TrackState::Coasting => Decision::Regained,
                    TrackState::Lost => Decision::Reacquired,
                };
                let restarted = if decision == Decision::Reacquired {
                    Chosen {
                        motion: Motion::new(&c.fix),
                        ..chosen
                    }
                } else {
                    chosen
                };
                self.take(restarted, &c, time_s);
                self.remember_beside(Some(&c));
                (decision, Some(c.fix))
            }
            (None, Some(_)) => (Decision::Ambiguous, nearest),
            (None, None) => (misfit.unwrap_or(Decision::NothingFound), nearest),
        }
    }

    /// Whether a candidate is the bead, where it was predicted and with the look that it had.
    fn is_predicted(&self, chosen: &Chosen, c: &Candidate) -> bool {
        c.fix.verdict == FixQuality::Good
            && self.within_gate(&chosen.motion, &c.fix)
            && chosen.identity.agrees(&self.config, &c.fix, c.size)
    }

    /// The detector misses a bead that touches a stronger one; the fit at the prediction may still see it.
    fn look_at_prediction(&mut self, frame: &Frame, chosen: &Chosen) {
        let (x, y) = chosen.motion.position();
        let radius_px = self.localiser.template().radius_px();
        let is_there = |c: &Candidate| {
            c.fix.verdict == FixQuality::Good
                && f64::hypot(c.fix.x_px - x, c.fix.y_px - y) < radius_px
        };
        if !self.candidates.iter().flatten().any(is_there) {
            let fix = self.localiser.locate(frame, Some((x, y)));
            let size = self.localiser.relative_size(&fix);
            self.add_candidate(Candidate::new(fix, size));
        }
    }

    /// Whether the bead was seen within the coast limit, and no other one is in the picture.
    fn is_alone(&self) -> bool {
        let good = |c: &&Candidate| c.fix.verdict == FixQuality::Good;
        matches!(
            self.standing.state,
            TrackState::Tracking | TrackState::Coasting
        ) && self.neighbours.count() == 0
            && self.candidates.iter().flatten().filter(good).count() == 1
    }

    /// Whether a candidate looks like the bead. One that is alone, where the last fix predicts it, and looks as it did then, is ours,
    /// whatever it swims over: a frame without a fix changes neither.
    fn looks_like(&self, chosen: &Chosen, c: &Candidate, alone: bool) -> bool {
        let goes_on = alone
            && self.within_gate(&chosen.motion, &c.fix)
            && chosen.identity.goes_on(&self.config, &c.fix, c.size);
        goes_on || chosen.identity.agrees(&self.config, &c.fix, c.size)
    }

    fn take(&mut self, mut chosen: Chosen, c: &Candidate, time_s: f64) {
        let changed = chosen.identity.change_used(&self.config, &c.fix, c.size);
        self.take_use(changed.max(c.fix.range_used));
        chosen.motion.update(&c.fix);
        chosen.identity.update(&c.fix, c.size);
        chosen.last_fix_s = time_s;
        self.chosen = Some(chosen);
    }

    fn within_gate(&self, motion: &Motion, fix: &Fix) -> bool {
        let (x, y) = motion.position();
        motion.distance2(fix) <= self.config.gate_sigma * self.config.gate_sigma
            || f64::hypot(fix.x_px - x, fix.y_px - y) <= self.config.least_gate_px
    }

    /// Whether any flow that the actuator can drive has carried the bead there since its last fix.
    fn within_reach(&self, motion: &Motion, fix: &Fix) -> bool {
        let (x, y) = motion.way_to(fix);
        f64::hypot(x, y) <= self.config.fastest_flow_px_per_s * motion.since_s()
            || self.within_gate(motion, fix)
    }
}
