//! What a script's sink keeps for a live page until the page takes it.

use cellpos_script::{AtRest, CycleRow};
use cellpos_session::view::{self, EventLine};
use std::collections::VecDeque;

/// Rows that the page has not taken yet; it takes some a few times a second. Without a page nothing is kept.
#[derive(Debug, Default)]
pub(super) struct Unshown {
    on: bool,
    pub(super) cycles: VecDeque<view::CycleRow>,
    pub(super) lines: VecDeque<EventLine>,
}

impl Unshown {
    /// What waits for a page, or for nobody.
    pub(super) fn new(on: bool) -> Self {
        Self {
            on,
            ..Self::default()
        }
    }

    /// A finished cycle, of a cell that was like this at rest.
    pub(super) fn cycle(&mut self, row: &CycleRow, rest: &AtRest) {
        if self.on {
            self.cycles.push_back(view::cycle_row(row, rest));
        }
    }

    /// What was found or marked.
    pub(super) fn line(&mut self, time_s: f64, level: &'static str, text: String) {
        if self.on {
            self.lines.push_back(EventLine {
                time_s,
                level,
                text,
            });
        }
    }
}
