//! What is measured again after a run that did not measure all of its plan, and whether another run may.

use crate::experiment::on_rig::{Acquired, Trouble};
use cellpos_ident::experiment::{Plan, RecordedSegment, Turn};
use cellpos_runtime::SafeReason;
use cellpos_runtime::life::Refusal;
use cellpos_session::Ended;

/// Runs in a row without a new segment after which a person must look.
const IN_VAIN: usize = 5;

/// The segments of a plan that one run after another measures.
#[derive(Debug)]
pub(crate) struct Again {
    /// Times that the bead left the view, by segment.
    spoilt: Vec<u32>,
    in_vain: usize,
    had_bead: bool,
}

impl Again {
    pub(crate) fn of(plan: &Plan) -> Self {
        Self {
            spoilt: vec![0; plan.segments.len()],
            in_vain: 0,
            had_bead: false,
        }
    }

    /// Segments not measured yet. After the first loss of the bead in one, which may be chance, it runs again as planned. After another
    /// one the rig moves the bead further than the model predicts: half the amplitude, then a quarter. What the machine spoilt runs again
    /// as it was.
    pub(crate) fn missing(&self, records: &[RecordedSegment]) -> Vec<Turn> {
        let is_missing = |index: usize| records.iter().all(|r| r.index != index);
        let all = self.spoilt.iter().enumerate();
        all.filter(|(index, _)| is_missing(*index))
            .map(|(index, times)| {
                let part = [1.0, 1.0, 0.5].get(*times as usize);
                Turn {
                    index,
                    part: part.copied().unwrap_or(0.25),
                }
            })
            .collect()
    }

    /// Takes in a run; `records` holds its segments and those before.
    pub(crate) fn learn(&mut self, acquired: &Acquired, records: &[RecordedSegment]) {
        self.in_vain = if acquired.records.is_empty() {
            self.in_vain + 1
        } else {
            0
        };
        self.had_bead |= !acquired.rows.pzt_um.is_empty();
        // Of a run that a lost bead ended, the first missing segment lost it.
        let lost = matches!(&acquired.trouble, Some(Trouble::Ended(ended)) if !ended.may_pass());
        for (place, turn) in self.missing(records).iter().enumerate() {
            let out_of_view = acquired.out_of_view.contains(&turn.index);
            self.spoilt[turn.index] += u32::from(out_of_view || lost && place == 0);
        }
    }

    /// Whether another run may succeed without a person's action: a stall may be over, and after a lost bead another may come.
    pub(crate) fn may_go_on(&self, trouble: &Trouble) -> bool {
        self.in_vain < IN_VAIN
            && match trouble {
                Trouble::Spoilt { .. } => true,
                Trouble::Ended(ended) => self.may_pass(ended),
            }
    }

    fn may_pass(&self, ended: &Ended) -> bool {
        let lost = ended.refusal.is_some_and(Refusal::lacks_a_bead)
            || ended.reason == Some(SafeReason::BeadLost);
        ended.may_pass() || self.had_bead && lost
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_segment_that_fails_again_and_again_is_run_more_gently_and_one_that_failed_once_is_not() {
        let measured = RecordedSegment {
            index: 1,
            from: 0,
            age_s: None,
            input: Vec::new(),
            output: Vec::new(),
        };
        let again = Again {
            spoilt: vec![0, 3, 1, 2, 7],
            in_vain: 0,
            had_bead: true,
        };
        let turns = again.missing(&[measured]);
        let turns: Vec<(usize, f64)> = turns.iter().map(|turn| (turn.index, turn.part)).collect();
        assert_eq!(turns, [(0, 1.0), (2, 1.0), (3, 0.5), (4, 0.25)]);
    }
}
