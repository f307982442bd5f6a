//! Objects that keep their place while cells pass: dirt on the glass, a fold of the wall. Only that identifies them, whatever
//! their look.
//!
//! An object that has kept its place for some frames stays once the commanded flow would have carried a cell away from there, or
//! the cell that is followed has gone its own width. The cell that is followed never counts: the loop holds it still.

use crate::cells::Cell;

/// Most objects remembered.
const MOST: usize = 16;
/// Frames in which an object must have kept its place, to a share of its width.
const FRAMES: u32 = 20;
const PLACE: f64 = 0.1;
/// Frames without it after which it is forgotten.
const FORGOTTEN: u32 = 200;

/// An object that has not moved since it was seen first.
#[derive(Debug, Clone, Copy)]
struct Still {
    x_px: f64,
    y_px: f64,
    width_px: f64,
    frames: u32,
    unseen: u32,
    /// Where the flow would have carried it since, px.
    carried_px: (f64, f64),
    /// Where the cell followed was then, px.
    followed_px: Option<(f64, f64)>,
    passed: bool,
}

/// The objects of a view that have not moved. Allocates nothing.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Stays {
    still: [Option<Still>; MOST],
}

impl Still {
    fn new(cell: &Cell, followed_px: Option<(f64, f64)>) -> Self {
        Still {
            x_px: cell.x_px,
            y_px: cell.y_px,
            width_px: cell.axes_px().1.max(1.0),
            frames: 1,
            unseen: 0,
            carried_px: (0.0, 0.0),
            followed_px,
            passed: false,
        }
    }

    fn is(&self, cell: &Cell) -> bool {
        f64::hypot(self.x_px - cell.x_px, self.y_px - cell.y_px) <= PLACE * self.width_px
    }
}

impl Stays {
    /// Takes in the objects of a frame. `carried_px` is the motion by the commanded flow since the previous frame, and `followed`
    /// the followed cell if it was seen in this frame.
    pub(super) fn see(&mut self, cells: &[Cell], carried_px: (f64, f64), followed: Option<&Cell>) {
        let place = followed.map(|c| (c.x_px, c.y_px));
        for slot in &mut self.still {
            let Some(still) = slot else { continue };
            let own = followed.is_some_and(|cell| still.is(cell));
            if own || still.unseen >= FORGOTTEN {
                *slot = None;
                continue;
            }
            still.unseen = still.unseen.saturating_add(1);
            still.carried_px.0 += carried_px.0;
            still.carried_px.1 += carried_px.1;
            if still.followed_px.is_none() {
                still.followed_px = place;
            }
            let gone_px = match (still.followed_px, place) {
                (Some(from), Some(to)) => f64::hypot(to.0 - from.0, to.1 - from.1),
                _ => 0.0,
            };
            let carried_px = f64::hypot(still.carried_px.0, still.carried_px.1);
            still.passed |= gone_px.max(carried_px) > still.width_px;
        }
        for cell in cells.iter().take(MOST) {
            let is_followed = place == Some((cell.x_px, cell.y_px));
            if cell.at_border || is_followed {
                continue;
            }
            if let Some(still) = self.still.iter_mut().flatten().find(|still| still.is(cell)) {
                if still.unseen > 0 {
                    still.frames = still.frames.saturating_add(1);
                }
                still.unseen = 0;
                continue;
            }
            let Some(slot) = self.oldest() else {
                continue;
            };
            if slot.is_none_or(|still| still.unseen > 0) {
                *slot = Some(Still::new(cell, place));
            }
        }
    }

    /// The slot that was not seen for longest, or a free one.
    fn oldest(&mut self) -> Option<&mut Option<Still>> {
        (self.still.iter_mut()).max_by_key(|slot| slot.map_or(u32::MAX, |still| still.unseen))
    }

    /// Takes in that a cell did not move with the PZT.
    pub(super) fn add(&mut self, cell: &Cell) {
        if let Some(slot) = self.oldest() {
            *slot = Some(Still {
                frames: FRAMES,
                passed: true,
                ..Still::new(cell, None)
            });
        }
    }

    /// Whether this is something that stays.
    pub(super) fn holds(&self, cell: &Cell) -> bool {
        let mut still = self.still.iter().flatten();
        still.any(|still| still.passed && still.frames >= FRAMES && still.is(cell))
    }
}
