//! Frames that gave no position, by what vision decided about them.

use cellpos_record::export::columns::DECISION;
use cellpos_runtime::{TickFlags, TickRecord};
use std::collections::BTreeMap;

/// Counts of frames without a position, by decision.
#[derive(Debug, Default)]
pub(super) struct Unused(BTreeMap<u8, u64>);

impl Unused {
    /// The next tick.
    pub(super) fn add(&mut self, r: &TickRecord) {
        if r.flags.has(TickFlags::LOST) {
            *self.0.entry(r.decision).or_default() += 1;
        }
    }

    /// A sentence about them; empty if every frame gave a position.
    pub(super) fn sentence(&self, what: &str) -> String {
        let all: u64 = self.0.values().sum();
        let mut kinds: Vec<(u64, &str)> = (DECISION.iter())
            .filter_map(|&(number, name)| Some((*self.0.get(&number)?, name)))
            .collect();
        kinds.sort_by_key(|(count, _)| std::cmp::Reverse(*count));
        let why: Vec<String> = (kinds.iter())
            .map(|(count, name)| format!("{count} {name}"))
            .collect();
        let why = match why.is_empty() {
            true => String::new(),
            false => format!(" (vision: {})", why.join(", ")),
        };
        match all {
            0 => String::new(),
            1 => format!(" One frame gave no position of the {what}{why}."),
            many => format!(" {many} frames gave no position of the {what}{why}."),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bead_that_was_seen_and_not_trusted_is_told_from_an_empty_frame() {
        let mut unused = Unused::default();
        assert_eq!(unused.sentence("bead"), "");
        for decision in [8, 8, 0, 1] {
            let mut tick = TickRecord::unknown();
            tick.decision = decision;
            if decision != 0 {
                tick.flags.set(TickFlags::LOST);
            }
            unused.add(&tick);
        }
        assert_eq!(
            unused.sentence("bead"),
            " 3 frames gave no position of the bead (vision: 2 other-bead, 1 nothing-found)."
        );
    }
}
