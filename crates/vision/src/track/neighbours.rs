//! Other beads in the frame, followed so that the chosen one is not mistaken for another.

use super::config::TrackerConfig;
use super::motion::{Motion, Randomness};
use crate::fix::{Fix, FixQuality};

/// Beads looked at in a frame.
pub(crate) const MAX_BEADS: usize = 8;
/// Time without a sight after which a neighbour that was last seen within the frame is forgotten, s.
const MEMORY_S: f64 = 2.0;
/// Share of a new fix in a neighbour's amplitude.
const AMPLITUDE_SHARE: f64 = 0.05;
/// Cost, as minus twice the log likelihood, of a known bead that is not seen, and of a bead that is seen but not known. One new bead a second in 100 x 60 px at 1000 frames/s has 1.7e-7 a px^2 and frame, 31.
const MISS: f64 = 30.0;

/// A bead seen in the frame, fitted.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Candidate {
    pub fix: Fix,
    pub size: Option<(f64, f64)>,
    /// Where light was seen, px: a fit that expects another motion may have gone elsewhere from there.
    pub seen_px: (f64, f64),
}

impl Candidate {
    /// A fit, whatever it started from.
    pub(super) fn new(fix: Fix, size: Option<(f64, f64)>) -> Self {
        Self {
            fix,
            size,
            seen_px: (fix.x_px, fix.y_px),
        }
    }
}

/// Whose a fix is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Claim {
    Ours,
    Unclear,
}

/// Whether a fix tells where a neighbour is: one cut by the border still does, a place outside the frame does not.
pub(super) fn is_sight(fix: &Fix) -> bool {
    matches!(fix.verdict, FixQuality::Good | FixQuality::AtBorder) && fix.amplitude != 0.0
}

/// The way from one bead to another as a fix.
fn between(from: &Fix, to: &Fix) -> Fix {
    Fix {
        x_px: to.x_px - from.x_px,
        y_px: to.y_px - from.y_px,
        var_x_px2: to.var_x_px2 + from.var_x_px2,
        var_y_px2: to.var_y_px2 + from.var_y_px2,
        ..*to
    }
}

#[derive(Debug, Clone, Copy)]
struct Neighbour {
    motion: Motion,
    /// From the chosen bead to it. A flow, however it steps, carries both.
    apart: Motion,
    /// Where it is if it stands on the glass, by how much more likely the fixes so far are if it does (twice the logarithm), and whether
    /// that is sure.
    stand: Motion,
    stands: f64,
    is_standing: bool,
    amplitude: f64,
    seen_s: f64,
    /// Frames in which it was seen.
    sights: u32,
    sight: Sight,
}

/// Whether a neighbour is seen.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Sight {
    Seen,
    /// Not since another bead was near enough to hide it.
    Hidden,
    /// Not since it went out of sight with no bead near: over the border, or out of focus. That it is not seen now is no surprise.
    Gone,
}

/// What a frame shows.
#[derive(Debug, Clone, Copy)]
pub(super) struct Field {
    pub width_px: usize,
    pub height_px: usize,
    /// Beads nearer to each other may be seen as one.
    pub touching_px: f64,
}

impl Neighbour {
    /// Whether it has been seen as often as a bead is before it is followed. What has not may be a fit gone astray.
    fn is_confirmed(&self, config: &TrackerConfig) -> bool {
        self.sights >= config.confirm_frames
    }

    fn new(own: &Fix, c: &Candidate, time_s: f64) -> Self {
        Neighbour {
            motion: Motion::new(&c.fix),
            apart: Motion::new(&between(own, &c.fix)),
            stand: Motion::standing(&c.fix),
            stands: 0.0,
            is_standing: false,
            amplitude: c.fix.amplitude,
            seen_s: time_s,
            sights: 1,
            sight: Sight::Seen,
        }
    }

    /// Weighs whether it stands: a free bead is nowhere as still as one on the glass, and goes with the flow.
    fn weigh(&mut self, swims: f64, fix: &Fix, certainty: f64) {
        let stands = self.stand.quiet_cost(fix);
        // What comes loose is known within a few sights.
        self.stands = (self.stands + swims - stands).clamp(-certainty, 2.0 * certainty);
        self.is_standing = self.stands > if self.is_standing { 0.0 } else { certainty };
        if self.stands > -certainty {
            self.stand.update(fix);
        } else {
            self.stand = Motion::standing(fix);
        }
    }

    /// Its motion where the chosen bead is as `ours` says: whichever is known better, its own or the way between them.
    fn beside(&self, ours: &Motion) -> Motion {
        if self.is_standing {
            return self.stand;
        }
        self.swims_beside(ours)
    }

    /// The same by the way between them alone: a flow that steps carries both.
    fn carried_with(&self, ours: &Motion) -> Motion {
        if self.is_standing {
            return self.stand;
        }
        ours.plus(&self.apart)
    }

    /// Its motion if it swims.
    fn swims_beside(&self, ours: &Motion) -> Motion {
        let carried = ours.plus(&self.apart);
        if carried.sd_px() < self.motion.sd_px() {
            carried
        } else {
            self.motion
        }
    }
}

/// Beads near the chosen one.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Neighbours {
    beads: [Option<Neighbour>; MAX_BEADS],
}

type Candidates = [Option<Candidate>; MAX_BEADS];

impl Neighbours {
    /// Predicted positions (px) and amplitudes (grey levels) of the neighbours of a bead that moves as `ours`, as far as they have
    /// been seen often enough.
    pub(super) fn confirmed(
        &self,
        ours: &Motion,
        config: &TrackerConfig,
    ) -> impl Iterator<Item = (f64, f64, f64)> {
        let surely = self
            .beads
            .iter()
            .flatten()
            .filter(|n| n.is_confirmed(config));
        surely.map(|n| {
            let (x, y) = n.beside(ours).position();
            (x, y, n.amplitude)
        })
    }

    pub(super) fn count(&self) -> usize {
        self.beads.iter().flatten().count()
    }

    /// Those that may swim beside a bead that moves as `ours`: where, and how well that is known, px.
    pub(super) fn swimming(&self, ours: &Motion) -> impl Iterator<Item = ((f64, f64), f64)> {
        let swimming = self.beads.iter().flatten().filter(|n| !n.is_standing);
        swimming.map(|n| {
            let motion = n.beside(ours);
            (motion.position(), motion.sd_px())
        })
    }

    /// Forgets those that surely stand at a place that is known otherwise.
    pub(super) fn leave_standing(&mut self, is_known: impl Fn((f64, f64)) -> bool) {
        for slot in &mut self.beads {
            if slot.is_some_and(|n| n.is_standing && is_known(n.stand.position())) {
                *slot = None;
            }
        }
    }

    pub(super) fn predict(
        &mut self,
        dt_s: f64,
        flow_px_per_s: (f64, f64),
        randomness: &Randomness,
    ) {
        let between = randomness.between();
        for n in self.beads.iter_mut().flatten() {
            n.motion.predict(dt_s, flow_px_per_s, randomness);
            n.apart.predict(dt_s, (0.0, 0.0), &between);
            n.stand.predict(dt_s, (0.0, 0.0), &Randomness::GLASS);
        }
    }

    /// Whether the candidate `best` is surely the chosen bead, whose motion is `ours`: every other reading of the frame
    /// (the chosen bead is another candidate, however badly fitted, or hidden, and `best` is a neighbour) must cost more
    /// by `certainty`.
    pub(super) fn claim(
        &self,
        ours: &Motion,
        candidates: &Candidates,
        best: usize,
        least_amplitude: f64,
        certainty: f64,
    ) -> Claim {
        let best_cost = self.cost(ours, candidates, Some(best));
        let mut other_cost = f64::INFINITY;
        for (k, c) in candidates.iter().enumerate() {
            // Where there is next to nothing, the chosen bead is not.
            if k != best
                && c.is_some_and(|c| {
                    c.fix.amplitude * least_amplitude.signum() > least_amplitude.abs()
                })
            {
                other_cost = other_cost.min(self.cost(ours, candidates, Some(k)));
            }
        }
        // Hidden only if a neighbour could be what is seen.
        if self.count() > 0 {
            other_cost = other_cost.min(self.cost(ours, candidates, None));
        }
        if other_cost - best_cost > certainty {
            Claim::Ours
        } else {
            Claim::Unclear
        }
    }

    /// Cost of the reading in which the chosen bead is the candidate `own`, or hidden, in a flow that is quiet or has stepped.
    pub(super) fn cost(&self, ours: &Motion, candidates: &Candidates, own: Option<usize>) -> f64 {
        let own_fix = own.and_then(|k| Some(candidates.get(k)?.as_ref()?.fix));
        let Some(fix) = own_fix else {
            return MISS + self.cost_of_others(candidates, None, |n| n.beside(ours));
        };
        let there = Motion::at(&fix, ours);
        let quiet = self.cost_of_others(candidates, own, |n| n.beside(&there));
        let stepped = self.cost_of_others(candidates, own, |n| n.carried_with(&there));
        (ours.quiet_cost(&fix) + quiet).min(ours.step_cost(&fix) + stepped)
    }

    /// Cost of the other beads, with their motion, and of unknown beads.
    fn cost_of_others(
        &self,
        candidates: &Candidates,
        own: Option<usize>,
        motion: impl Fn(&Neighbour) -> Motion,
    ) -> f64 {
        let (sights, cost) = self.sights(candidates, own, |n, c| motion(n).surprise(&c.fix));
        let unknown = |(k, c): &(usize, &Option<Candidate>)| {
            let is_bead = c.is_some_and(|c| c.fix.verdict == FixQuality::Good);
            is_bead && own != Some(*k) && !sights.contains(&Some(*k))
        };
        cost + MISS * candidates.iter().enumerate().filter(unknown).count() as f64
    }

    /// Assigns candidates other than `own` to the beads, the surest first, each candidate once; and the cost. A bead without a
    /// candidate that explains it better than a miss counts as not seen.
    fn sights(
        &self,
        candidates: &Candidates,
        own: Option<usize>,
        cost_of: impl Fn(&Neighbour, &Candidate) -> f64,
    ) -> ([Option<usize>; MAX_BEADS], f64) {
        let (mut sights, mut cost) = ([None; MAX_BEADS], 0.0);
        let (mut used, mut open) = ([false; MAX_BEADS], [false; MAX_BEADS]);
        if let Some(flag) = own.and_then(|k| used.get_mut(k)) {
            *flag = true;
        }
        for (flag, bead) in open.iter_mut().zip(&self.beads) {
            *flag = bead.is_some();
        }
        loop {
            let mut least = (MISS, None);
            for (i, n) in self.beads.iter().enumerate().filter(|(i, _)| open[*i]) {
                for (k, c) in candidates.iter().enumerate().filter(|(k, _)| !used[*k]) {
                    let (Some(n), Some(c)) = (n, c) else { continue };
                    let surprise = cost_of(n, c);
                    if is_sight(&c.fix) && surprise < least.0 {
                        least = (surprise, Some((i, k)));
                    }
                }
            }
            let (surprise, Some((i, k))) = least else {
                break;
            };
            cost += surprise;
            (open[i], used[k], sights[i]) = (false, true, Some(k));
        }
        let hidden = self.beads.iter().zip(open).filter(|(_, open)| *open);
        let missed = hidden
            .filter(|(n, _)| n.is_some_and(|n| n.sight != Sight::Gone))
            .count();
        (sights, cost + MISS * missed as f64)
    }

    /// Takes in the other beads seen with the chosen bead (`taken`, whose motion is `ours`). While the chosen bead itself is
    /// not seen, a candidate that it could be does not count as a sight of a neighbour.
    pub(super) fn update(
        &mut self,
        ours: &Motion,
        candidates: &Candidates,
        taken: Option<usize>,
        time_s: f64,
        config: &TrackerConfig,
        field: Field,
    ) {
        let taken_fix = taken.and_then(|k| Some(candidates.get(k)?.as_ref()?.fix));
        let known = taken_fix.map_or(*ours, |fix| Motion::at(&fix, ours));
        let stepped = taken_fix.is_some_and(|fix| ours.has_stepped(&fix));
        let moves = |n: &Neighbour| {
            if stepped {
                n.carried_with(&known)
            } else {
                n.beside(&known)
            }
        };
        let (sights, _) = self.sights(candidates, taken, |n, c| {
            let surprise = moves(n).surprise(&c.fix);
            let lead = ours.surprise(&c.fix) - surprise;
            if taken.is_none() && lead < config.certainty {
                f64::INFINITY
            } else {
                surprise
            }
        });
        for (slot, sight) in self.beads.iter_mut().zip(sights) {
            let Some(n) = slot else { continue };
            if sight.is_none() && n.sight == Sight::Seen {
                let (x, y) = moves(n).position();
                let near =
                    |c: &Candidate| f64::hypot(c.fix.x_px - x, c.fix.y_px - y) < field.touching_px;
                let mut beads = candidates.iter().enumerate();
                let hides = |(k, c): (usize, &Option<Candidate>)| {
                    (taken == Some(k) || sights.contains(&Some(k))) && c.is_some_and(|c| near(&c))
                };
                let alone = taken.is_some() && !beads.any(hides);
                n.sight = if alone { Sight::Gone } else { Sight::Hidden };
            }
            if let Some(c) = sight.and_then(|k| candidates.get(k)?.as_ref()) {
                let swims = n.swims_beside(&known).surprise(&c.fix);
                n.weigh(swims, &c.fix, config.certainty);
                n.motion.update(&c.fix);
                if let Some(own) = &taken_fix {
                    n.apart.update(&between(own, &c.fix));
                }
                n.amplitude += AMPLITUDE_SHARE * (c.fix.amplitude - n.amplitude);
                n.seen_s = time_s;
                n.sights = n.sights.saturating_add(1);
                n.sight = Sight::Seen;
            } else if let Some(own) = taken_fix.filter(|_| stepped) {
                // The flow took it along, unseen.
                n.motion.carry(ours.way_to(&own));
            }
            // While the chosen bead is out of sight nobody is forgotten: it may have been hidden by just this one.
            let motion = moves(n);
            let (x, y) = motion.position();
            let sure_px = 3.0 * motion.sd_px();
            let beyond = |c: f64, len: usize| c < -sure_px || c > len as f64 - 1.0 + sure_px;
            let left = beyond(x, field.width_px) || beyond(y, field.height_px);
            let memory_s = if left { config.coast_limit_s } else { MEMORY_S };
            let unseen_s = time_s - n.seen_s;
            let doubtful = !n.is_confirmed(config) && unseen_s > 0.0;
            if doubtful || taken.is_some() && unseen_s > memory_s {
                *slot = None;
            }
        }
        // What is left over is a new neighbour, as long as the chosen bead itself is in sight: otherwise it may be it.
        let Some(own) = taken_fix else { return };
        for (k, c) in candidates.iter().enumerate() {
            if let Some(c) = c
                && taken != Some(k)
                && !sights.contains(&Some(k))
                && is_sight(&c.fix)
                && let Some(free) = self.beads.iter_mut().find(|n| n.is_none())
            {
                *free = Some(Neighbour::new(&own, c, time_s));
            }
        }
    }
}
