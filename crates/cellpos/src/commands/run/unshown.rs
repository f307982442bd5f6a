//! What a script's sink keeps for a live page until the page takes it.

use cellpos_script::CycleRow;
use cellpos_session::view::{self, EventLine};
use std::collections::VecDeque;

/// What is to be shown and was not yet; the page takes some of it a few times a second. Without a page nothing is kept.
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

    /// A finished cycle.
    pub(super) fn cycle(&mut self, row: &CycleRow) {
        if self.on {
            let known = |value: f64| value.is_finite().then_some(value);
            self.cycles.push_back(view::CycleRow {
                cycle: row.cycle + 1,
                amplitude_um: known(row.reached_um),
                stretch: known(row.length_peak_um / row.length_start_um),
                recovery_s: known(row.recovery_s),
            });
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
