//! What is in the picture beside the chosen bead: dust, pieces of wall, and beads that are followed.

use super::Tracker;
use super::motion::Motion;
use super::neighbours::{Candidate, MAX_BEADS};
use crate::fix::FixQuality;
use crate::frame::Frame;

/// What was seen beside the chosen bead when it was last taken: places in the frame, px, and whether each is a bead.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Beside([Option<((f64, f64), bool)>; MAX_BEADS]);

impl Beside {
    /// The places given, each with whether it is a bead.
    pub(super) fn new(mut seen: impl Iterator<Item = ((f64, f64), bool)>) -> Self {
        Beside(core::array::from_fn(|_| seen.next()))
    }

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

/// A look beside a bead that was taken where it was predicted: what else is in the picture matters to the next frames only.
#[derive(Debug, Clone, Copy)]
pub(super) struct Owed {
    /// The bead's motion, as predicted for the frame.
    motion: Motion,
    bead: Candidate,
    time_s: f64,
}

impl Owed {
    pub(super) fn new(motion: Motion, bead: Candidate, time_s: f64) -> Self {
        Self {
            motion,
            bead,
            time_s,
        }
    }
}

impl Tracker {
    /// Looks at what else is in a frame, the one given to [`Tracker::step_at_once`] before, if a look is due; whether one was.
    pub fn look_beside(&mut self, frame: &Frame) -> bool {
        let Some(Owed {
            motion,
            bead,
            time_s,
        }) = self.owed.take()
        else {
            return false;
        };
        self.look_around(frame, false, Some(&bead));
        // The detector may miss the bead, or have no place left for it.
        self.add_candidate(bead);
        let radius_px = self.localiser.template().radius_px();
        let away_px =
            |c: &Candidate| f64::hypot(c.fix.x_px - bead.fix.x_px, c.fix.y_px - bead.fix.y_px);
        let near = |c: &Candidate| c.fix.verdict == FixQuality::Good && away_px(c) < radius_px;
        let seen = self.candidates.iter().enumerate();
        let ours = seen
            .filter_map(|(k, c)| c.filter(near).map(|c| (k, c)))
            .min_by(|a, b| away_px(&a.1).total_cmp(&away_px(&b.1)));
        let field = self.field(frame);
        self.neighbours.update(
            &motion,
            &self.candidates,
            ours.map(|(k, _)| k),
            time_s,
            &self.config,
            field,
        );
        if let Some((_, ours)) = ours {
            self.remember_beside(Some(&ours));
        }
        true
    }
}
