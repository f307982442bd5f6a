//! What is in the picture beside the chosen bead: dust, pieces of wall, and beads that are followed.

use super::Tracker;
use super::neighbours::{Candidate, MAX_BEADS, is_sight};

/// What was seen beside the chosen bead when it was last taken: places in the frame, px, and whether each is a bead.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Beside([Option<((f64, f64), bool)>; MAX_BEADS]);

impl Beside {
    /// Whether something stood at a place. No flow has carried the chosen bead there since: its image is not drawn out that far.
    pub(super) fn stood(&self, place_px: (f64, f64), radius_px: f64) -> bool {
        self.near(place_px, radius_px).next().is_some()
    }

    /// Whether what stood at a place was no bead.
    pub(super) fn is_no_bead(&self, place_px: (f64, f64), radius_px: f64) -> bool {
        self.stood(place_px, radius_px) && self.near(place_px, radius_px).all(|is_bead| !is_bead)
    }

    fn near(&self, (x, y): (f64, f64), radius_px: f64) -> impl Iterator<Item = bool> {
        let near = move |p: &&((f64, f64), bool)| f64::hypot(p.0.0 - x, p.0.1 - y) < radius_px;
        self.0
            .iter()
            .flatten()
            .filter(near)
            .map(|(_, is_bead)| *is_bead)
    }
}

impl Tracker {
    /// Remembers what is seen besides the chosen bead, which is `ours`. A bead that touches another may be refused for once: what
    /// is followed as a neighbour stays a bead.
    pub(super) fn remember_beside(&mut self, ours: &Candidate) {
        let radius_px = self.localiser.template().radius_px();
        let is_near = |(x, y): (f64, f64), (u, v): (f64, f64)| f64::hypot(x - u, y - v) < radius_px;
        let mut beside = Beside::default();
        let others = self.candidates.iter().flatten();
        let others = others.filter(|c| !is_near(c.seen_px, (ours.fix.x_px, ours.fix.y_px)));
        for (slot, c) in beside.0.iter_mut().zip(others) {
            let followed = self.chosen.is_some_and(|chosen| {
                let mut known = self.neighbours.confirmed(&chosen.motion, &self.config);
                known.any(|(x, y, _)| is_near(c.seen_px, (x, y)))
            });
            let fit_px = (c.fix.x_px, c.fix.y_px);
            let is_bead = is_sight(&c.fix) && is_near(c.seen_px, fit_px);
            *slot = Some((c.seen_px, followed || is_bead));
        }
        self.beside = beside;
    }
}
