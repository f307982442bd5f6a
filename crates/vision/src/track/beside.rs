//! What is in the picture beside the chosen bead: dust, pieces of wall, and beads that are followed.

use super::motion::Motion;
use super::neighbours::{Candidate, MAX_BEADS};

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
    pub(super) motion: Motion,
    pub(super) bead: Candidate,
    pub(super) time_s: f64,
}
