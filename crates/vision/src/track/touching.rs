//! Beads whose images overlap: what one template fits badly is fitted as several beads, and a flow carries them alike.

use super::carried::STREAK_PX;
use super::motion::Motion;
use super::neighbours::{Candidate, Field, MAX_BEADS, is_sight};
use super::{Chosen, Tracker};
use crate::fix::FixQuality;
use crate::frame::Frame;
use crate::joint::MOST_TOGETHER;
use crate::localiser::{Start, Together};

/// Beads nearer than this many radii are fitted together: the corner of a window is 2.6 radii from its middle, and a ring's image
/// ends at 2.4.
const TOUCHING_RADII: f64 = 5.0;

/// Where beads are looked for together.
type Starts = [Start; MOST_TOGETHER];

impl Tracker {
    fn touching_px(&self) -> f64 {
        TOUCHING_RADII * self.localiser.template().radius_px()
    }

    /// Takes in the other beads of the candidates; the bead that moves as `ours` is the candidate `taken`.
    pub(super) fn update_neighbours(
        &mut self,
        frame: &Frame,
        ours: &Motion,
        taken: Option<usize>,
        time_s: f64,
    ) {
        let field = Field {
            width_px: frame.width,
            height_px: frame.height,
            touching_px: self.touching_px(),
        };
        (self.neighbours).update(ours, &self.candidates, taken, time_s, &self.config, field);
    }

    /// Locates every bead that the detector sees, those near each other together; with `carried` also as a step of the flow draws
    /// them out that has carried the chosen bead to one of them. One that is `known` and stands alone is not located again. Whether
    /// all that are near each other were beads.
    pub(super) fn look_around(
        &mut self,
        frame: &Frame,
        carried: bool,
        known: Option<&Candidate>,
    ) -> bool {
        self.candidates = [None; MAX_BEADS];
        self.detector.detect(frame);
        let (mut seen, mut count) = ([(0.0, 0.0); MAX_BEADS], 0);
        for (place, blob) in seen.iter_mut().zip(self.detector.found()) {
            *place = (blob.x_px, blob.y_px);
            count += 1;
        }
        let seen = &seen[..count];
        let radius_px = self.localiser.template().radius_px();
        let mut no_bead = [false; MAX_BEADS];
        for (flag, place) in no_bead.iter_mut().zip(seen) {
            *flag = self.beside.is_no_bead(*place, radius_px);
        }
        // What is no bead is fitted with none: their fit would not be good. In a search two that touch may have been taken for that.
        let alone = no_bead.map(|flag| flag && self.chosen.is_some());
        // Of the places where no bead was, one in each frame is tried in every way.
        let in_full = self.frames as usize % count.max(1);
        let (mut done, mut all_seen) = ([false; MAX_BEADS], true);
        for k in 0..count {
            if done[k] {
                continue;
            }
            let members = self.group(seen, &alone, k);
            let size = members.iter().filter(|m| **m).count();
            if (2..=MOST_TOGETHER).contains(&size) {
                // Seen or not: from another of them it would be the same fit.
                let first = members.iter().position(|m| *m) == Some(k);
                if first && self.locate_group(frame, seen, &members, carried) {
                    for (flag, member) in done.iter_mut().zip(members) {
                        *flag |= member;
                    }
                    continue;
                }
                all_seen = false;
            }
            let (x, y) = seen[k];
            let is_it = |c: &&Candidate| f64::hypot(c.fix.x_px - x, c.fix.y_px - y) < radius_px;
            let candidate = if let Some(known) = known.filter(is_it) {
                *known
            } else {
                let fix = if no_bead[k] && k != in_full {
                    self.localiser.locate_where_none_was(frame, seen[k])
                } else {
                    self.localiser.locate(frame, Some(seen[k]))
                };
                Candidate {
                    size: self.localiser.relative_size(&fix),
                    seen_px: seen[k],
                    fix,
                }
            };
            self.add_candidate(candidate);
        }
        self.rejected.see(&self.candidates, self.apart_px());
        all_seen
    }

    /// Distance below which two fixes are of one object, px.
    pub(super) fn apart_px(&self) -> f64 {
        0.5 * self.localiser.template().radius_px()
    }

    /// Adds a candidate unless one is already there.
    pub(super) fn add_candidate(&mut self, c: Candidate) {
        let apart_px = self.apart_px();
        let good = |c: &Candidate| c.fix.verdict == FixQuality::Good;
        let same =
            |o: &Candidate| f64::hypot(o.fix.x_px - c.fix.x_px, o.fix.y_px - c.fix.y_px) < apart_px;
        if let Some(other) = self.candidates.iter_mut().flatten().find(|o| same(o)) {
            if good(&c) && !good(other) {
                *other = c;
            }
        } else if let Some(free) = self.candidates.iter_mut().find(|s| s.is_none()) {
            *free = Some(c);
        }
    }

    /// Those of the places that are near to the place `k`, or to one that is; of those that stand alone none.
    fn group(&self, seen: &[(f64, f64)], alone: &[bool; MAX_BEADS], k: usize) -> [bool; MAX_BEADS] {
        let reach_px = self.touching_px();
        let mut members = [false; MAX_BEADS];
        members[k] = true;
        // A chain of places grows by at least one in each round, or is whole.
        let mut grows = !alone[k];
        while grows {
            grows = false;
            for i in 0..seen.len() {
                let joins = !members[i]
                    && !alone[i]
                    && (0..seen.len()).any(|o| {
                        members[o]
                            && f64::hypot(seen[i].0 - seen[o].0, seen[i].1 - seen[o].1) < reach_px
                    });
                members[i] |= joins;
                grows |= joins;
            }
        }
        members
    }

    /// Fits a group of places together; whether all were beads.
    fn locate_group(
        &mut self,
        frame: &Frame,
        seen: &[(f64, f64)],
        members: &[bool; MAX_BEADS],
        carried: bool,
    ) -> bool {
        let (mut starts, mut n): (Starts, _) = (Default::default(), 0);
        for (place, _) in seen.iter().zip(members).filter(|(_, member)| **member) {
            if let Some(start) = starts.get_mut(n) {
                start.place_px = *place;
                n += 1;
            }
        }
        let starts = &starts[..n];
        let mut together = self.localiser.locate_together(frame, starts);
        if carried && !together.is_some_and(|t| t.all_seen()) {
            // A step of the flow that has carried the chosen bead to one of them draws every image out.
            let (beside, radius_px) = (self.beside, self.localiser.template().radius_px());
            let came = |to: &&Start| !beside.stood(to.place_px, radius_px);
            let ways = |from| {
                starts
                    .iter()
                    .filter(came)
                    .map(move |to| way(from, to.place_px))
            };
            for way_px in self.chosen.into_iter().flat_map(ways) {
                let fitted = self.locate_carried(frame, starts, way_px);
                together = fitted.filter(Together::all_seen).or(together);
            }
        }
        let Some(together) = together.filter(Together::all_seen) else {
            return false;
        };
        for fix in together.fixes() {
            self.add_candidate(Candidate::new(*fix, None));
        }
        true
    }

    /// Fits beads together as images that a step of the flow by `way_px` since the last fix has drawn out.
    fn locate_carried(
        &mut self,
        frame: &Frame,
        starts: &[Start],
        way_px: (f64, f64),
    ) -> Option<Together> {
        let since_s = self.chosen?.motion.since_s();
        let share = if since_s > 0.0 {
            self.exposure_s / since_s
        } else {
            0.0
        };
        if f64::hypot(way_px.0, way_px.1) * share < STREAK_PX {
            return None;
        }
        let (x_px, y_px) = self.streak_px;
        self.localiser
            .expect_streak((x_px + way_px.0 * share, y_px + way_px.1 * share));
        let together = self.localiser.locate_together(frame, starts);
        self.localiser.expect_streak(self.streak_px);
        together
    }

    /// If the picture shows fewer beads than are known, fits the chosen bead and its neighbours together,
    /// at the predictions, and shifted to the nearest light. The results replace the
    /// candidates near by that were fitted as if they were alone.
    pub(super) fn part_touching_beads(&mut self, frame: &Frame, chosen: &Chosen) {
        let radius_px = self.localiser.template().radius_px();
        let (mut starts, n) = self.predicted_group(chosen);
        let starts = &mut starts[..n];
        if n < 2 {
            return;
        }
        let (mut x, mut y) = (0.0, 0.0);
        for start in starts.iter() {
            let share = 1.0 / n as f64;
            x += share * start.place_px.0;
            y += share * start.place_px.1;
        }
        let away_px = |c: &Candidate| f64::hypot(c.seen_px.0 - x, c.seen_px.1 - y);
        let reach_px = self.touching_px();
        let is_seen = |c: &&Candidate| is_sight(&c.fix) && away_px(c) < reach_px;
        if self.candidates.iter().flatten().filter(is_seen).count() >= n {
            return;
        }
        let mut best = self.localiser.locate_together(frame, starts);
        let lights = self.candidates.iter().flatten();
        let nearest = lights.min_by(|a, b| away_px(a).total_cmp(&away_px(b)));
        let light = nearest.map(|c| (c.seen_px.0 - x, c.seen_px.1 - y));
        if let Some(way_px) = light
            && !best.is_some_and(|t| t.all_seen())
        {
            for start in starts.iter_mut() {
                start.place_px.0 += way_px.0;
                start.place_px.1 += way_px.1;
            }
            let still = self.localiser.locate_together(frame, starts);
            let drawn_out = self.locate_carried(frame, starts, way_px);
            for found in [still, drawn_out].into_iter().flatten() {
                let better = |b: Together| found.residual_ratio() < b.residual_ratio();
                if best.is_none_or(better) {
                    best = Some(found);
                }
            }
        }
        let Some(best) = best.filter(Together::all_seen) else {
            return;
        };
        for fix in best.fixes() {
            for slot in &mut self.candidates {
                // A fit as if alone is drawn towards the other bead.
                let is_beside = |c: &Candidate| {
                    let apart_px = f64::hypot(c.fix.x_px - fix.x_px, c.fix.y_px - fix.y_px);
                    apart_px < radius_px && best.fixes().all(|f| *f != c.fix)
                };
                if slot.as_ref().is_some_and(is_beside) {
                    *slot = None;
                }
            }
            self.add_candidate(Candidate::new(*fix, None));
        }
    }

    /// Where the chosen bead and the neighbours that touch it are predicted. A contrast is known to a third of the change that
    /// is allowed at most.
    fn predicted_group(&self, chosen: &Chosen) -> (Starts, usize) {
        let reach_px = self.touching_px();
        let own_px = chosen.motion.position();
        let share = self.config.max_amplitude_change / 3.0;
        let contrast = |amplitude: f64| Some((amplitude, share * amplitude.abs()));
        let neighbours = self.neighbours.confirmed(&chosen.motion, &self.config);
        let near = neighbours.filter(|(x, y, _)| f64::hypot(x - own_px.0, y - own_px.1) < reach_px);
        let own = (own_px.0, own_px.1, chosen.identity.amplitude());
        let (mut starts, mut n): (Starts, _) = (Default::default(), 0);
        for (start, (x, y, amplitude)) in starts.iter_mut().zip(std::iter::once(own).chain(near)) {
            *start = Start {
                place_px: (x, y),
                contrast: contrast(amplitude),
            };
            n += 1;
        }
        (starts, n)
    }
}

/// From a prediction to a place, px.
fn way(from: Chosen, (x_px, y_px): (f64, f64)) -> (f64, f64) {
    let (x, y) = from.motion.position();
    (x_px - x, y_px - y)
}
