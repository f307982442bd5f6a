//! The look at what else is in a picture whose bead has been taken already.

use super::Tracker;
use super::beside::Owed;
use super::neighbours::Candidate;
use crate::fix::FixQuality;
use crate::frame::Frame;

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
        self.update_neighbours(frame, &motion, ours.map(|(k, _)| k), time_s);
        if let Some((_, ours)) = ours {
            self.remember_beside(Some(&ours));
        }
        true
    }
}
