//! Objects that look like a bead and did not move with the PZT: beads on the glass, dirt.

use super::neighbours::{Candidate, MAX_BEADS};
use crate::fix::{Fix, FixQuality};

/// Their places in the picture, px, the oldest first to be forgotten. Allocates nothing.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Rejected {
    places_px: [Option<(f64, f64)>; MAX_BEADS],
    count: usize,
}

impl Rejected {
    pub(super) fn add(&mut self, place_px: (f64, f64)) {
        self.places_px[self.count % MAX_BEADS] = Some(place_px);
        self.count = self.count.wrapping_add(1);
    }

    /// Whether a fix is of one that was rejected: within `apart_px`, as near as no two objects are told apart.
    pub(super) fn holds(&self, fix: &Fix, apart_px: f64) -> bool {
        let mut places = self.places_px.iter().flatten();
        places.any(|(x, y)| f64::hypot(fix.x_px - x, fix.y_px - y) < apart_px)
    }

    /// Takes in what a look at the whole picture has found: the glass drifts, and what is on it goes along.
    pub(super) fn see(&mut self, seen: &[Option<Candidate>], apart_px: f64) {
        for place in self.places_px.iter_mut().flatten() {
            let away = |fix: &Fix| f64::hypot(fix.x_px - place.0, fix.y_px - place.1);
            let good = seen.iter().flatten().map(|c| c.fix);
            let nearest = good
                .filter(|fix| fix.verdict == FixQuality::Good && away(fix) < apart_px)
                .min_by(|a, b| away(a).total_cmp(&away(b)));
            if let Some(fix) = nearest {
                place.0 += FOLLOWING * (fix.x_px - place.0);
                place.1 += FOLLOWING * (fix.y_px - place.1);
            }
        }
    }
}

/// Share of a new fix in the place: a bead that swims past, for some ten frames, does not take the place along.
const FOLLOWING: f64 = 1e-3;
