//! Beads whose images are taken off a window.

use crate::fix::Fix;

/// Most neighbours whose images are taken off a window.
const MOST_OTHERS: usize = 8;
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
