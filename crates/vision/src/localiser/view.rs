//! The input of a fix: the frame, and the beads whose images are removed from its windows.

use crate::fix::Fix;
use crate::frame::Frame;

/// Most neighbours whose images are taken off a window.
const MOST_OTHERS: usize = 8;

/// What a fix looks at, and how.
#[derive(Debug, Clone, Copy)]
pub(super) struct View<'a> {
    pub frame: &'a Frame<'a>,
    pub others: Others,
    /// Whether this fix is an intermediate step to a better one: nothing is learnt from it.
    pub is_draft: bool,
    /// Whether a residual that is the same all round counts as none.
    pub pardons: bool,
}

impl<'a> View<'a> {
    /// A frame with one bead.
    pub(super) fn of(frame: &'a Frame<'a>) -> Self {
        View {
            frame,
            others: Others::default(),
            is_draft: false,
            pardons: false,
        }
    }
}

/// The beads taken off the windows of a fix: place in the frame, px, and contrast, grey levels.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Others {
    beads: [(f64, f64, f64); MOST_OTHERS],
    count: usize,
}

impl Others {
    pub(super) fn add(&mut self, fix: &Fix) {
        if let Some(free) = self.beads.get_mut(self.count) {
            *free = (fix.x_px, fix.y_px, fix.amplitude);
            self.count += 1;
        }
    }

    pub(super) fn beads(&self) -> impl Iterator<Item = &(f64, f64, f64)> {
        self.beads.iter().take(self.count)
    }
}
