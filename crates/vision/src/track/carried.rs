//! Beads that a flow carries while the frame is exposed, and what it does not carry.

use super::beside::Beside;
use super::neighbours::{Candidate, MAX_BEADS, is_sight};
use super::{Chosen, Tracker};
use crate::fix::FixQuality;
use crate::frame::Frame;

/// A way during an exposure below which an image is not drawn out enough to matter, px: it widens by a twelfth of its square.
pub(super) const STREAK_PX: f64 = 0.5;

impl Tracker {
    /// Fits again what is unlike the bead: a step of the flow that carried it there draws its image out, too.
    pub(super) fn fit_as_carried(&mut self, frame: &Frame, chosen: &Chosen) {
        let since_s = chosen.motion.since_s();
        if self.exposure_s <= 0.0 || since_s <= 0.0 {
            return;
        }
        let radius_px = self.localiser.template().radius_px();
        let mut refitted = [None; MAX_BEADS];
        for (slot, again) in self.candidates.iter_mut().zip(&mut refitted) {
            let Some(c) = *slot else { continue };
            let good = |c: &Candidate| {
                c.fix.verdict == FixQuality::Good
                    && chosen.identity.agrees(&self.config, &c.fix, c.size)
            };
            let from = chosen.motion.position();
            let way = (c.seen_px.0 - from.0, c.seen_px.1 - from.1);
            let along_px = f64::hypot(way.0, way.1) * self.exposure_s / since_s;
            if good(&c) || along_px < STREAK_PX || self.beside.stood(c.seen_px, radius_px) {
                continue;
            }
            let share = self.exposure_s / since_s;
            self.localiser.expect_streak((
                self.streak_px.0 + way.0 * share,
                self.streak_px.1 + way.1 * share,
            ));
            let fix = self.localiser.locate(frame, Some(c.seen_px));
            let carried = Candidate::new(fix, None);
            if good(&carried) {
                *slot = None;
                *again = Some(carried);
            }
        }
        self.localiser.expect_streak(self.streak_px);
        let drawn_out_px = f64::hypot(self.streak_px.0, self.streak_px.1) + radius_px;
        for c in refitted.into_iter().flatten() {
            // A fit with the wrong streak to the same light is no other bead, and one bead found twice is one.
            for slot in &mut self.candidates {
                let same = |o: &Candidate| {
                    let apart_px = f64::hypot(o.fix.x_px - c.fix.x_px, o.fix.y_px - c.fix.y_px);
                    let good = o.fix.verdict == FixQuality::Good
                        && chosen.identity.agrees(&self.config, &o.fix, o.size);
                    !good && apart_px < drawn_out_px
                };
                if slot.as_ref().is_some_and(same) {
                    *slot = None;
                }
            }
            self.add_candidate(c);
        }
    }

    /// Remembers what is seen besides the chosen bead, which is `ours`, if it is seen. A bead that touches another may be refused for once:
    /// what is followed as a neighbour stays a bead.
    pub(super) fn remember_beside(&mut self, ours: Option<&Candidate>) {
        let radius_px = self.localiser.template().radius_px();
        let is_near = |(x, y): (f64, f64), (u, v): (f64, f64)| f64::hypot(x - u, y - v) < radius_px;
        let is_other = |c: &&Candidate| {
            ours.is_none_or(|ours| !is_near(c.seen_px, (ours.fix.x_px, ours.fix.y_px)))
        };
        let is_bead = |c: &Candidate| {
            let followed = self.chosen.is_some_and(|chosen| {
                let mut known = self.neighbours.confirmed(&chosen.motion, &self.config);
                known.any(|(x, y, _)| is_near(c.seen_px, (x, y)))
            });
            followed || is_sight(&c.fix) && is_near(c.seen_px, (c.fix.x_px, c.fix.y_px))
        };
        let others = self.candidates.iter().flatten().filter(is_other);
        self.beside = Beside::new(others.map(|c| (c.seen_px, is_bead(c))));
    }
}
