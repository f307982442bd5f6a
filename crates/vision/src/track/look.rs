//! The look at what else is in a picture whose bead has been taken already.

use super::Tracker;
use super::beside::Owed;
use super::neighbours::{Candidate, MAX_BEADS};
use crate::fix::FixQuality;
use crate::frame::Frame;

/// Radii of a bead beyond which its picture shows nothing of it.
const STILL_RADII: f64 = 3.0;

impl Tracker {
    /// Looks at what else is in a frame, the one given to [`Tracker::step_at_once`] before, if a look is due; whether one was.
    pub fn look_beside(&mut self, frame: &Frame) -> bool {
        let mut looked = false;
        if self.owed.is_some() {
            let mut scenery = std::mem::take(&mut self.scenery);
            looked = self.look_at_others(&scenery.without(*frame));
            self.scenery = scenery;
        }
        if std::mem::take(&mut self.learns) {
            self.learn_scenery(frame);
        }
        looked
    }

    fn look_at_others(&mut self, frame: &Frame) -> bool {
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
        self.update_neighbours(frame, &motion, ours.map(|(k, _)| k), time_s);
        if let Some((_, ours)) = ours {
            self.remember_beside(Some(&ours));
        }
        true
    }

    /// Learns what stands still in a frame whose bead was taken. Neither the bead nor what may swim is learnt; a neighbour that surely
    /// stands is, and is scenery from then on.
    fn learn_scenery(&mut self, frame: &Frame) {
        let Some(chosen) = self.chosen else { return };
        let radius_px = self.localiser.template().radius_px();
        let reach_px = STILL_RADII * radius_px;
        let mut moving = [((0.0, 0.0), 0.0); 1 + MAX_BEADS];
        let drawn_out_px = f64::hypot(self.streak_px.0, self.streak_px.1);
        moving[0] = (chosen.motion.position(), reach_px + drawn_out_px);
        let mut count = 1;
        for (place_px, sd_px) in self.neighbours.swimming(&chosen.motion) {
            moving[count] = (place_px, reach_px + 3.0 * sd_px);
            count += 1;
        }
        self.scenery.learn(frame, radius_px, &moving[..count]);
        let known = |place_px| self.scenery.is_known((place_px, radius_px));
        self.neighbours.leave_standing(known);
    }
}
