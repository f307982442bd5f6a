//! An excitation on top of a held bead, for a run of an identification.

use cellpos_ident::experiment::{Plan, Turn};
use cellpos_runtime::{ReferenceGenerator, ReferenceInput, ReferenceOutput, Stage};

/// Ticks at rest between closing the loop and the first segment.
pub const SETTLE_TICKS: usize = 500;

/// Ticks at rest after the last segment: the effect of the excitation decays and zero flow is known again before the bead is
/// frozen there.
pub const REST_TICKS: usize = 400;

/// Holds the bead at 0 um and plays the excitation, counted from the tick in which the loop was closed.
///
/// If the bead is frozen for as long as a segment may lack positions ([`Plan::lost_frames`]), the segment is invalid and its rest is not
/// played. So a loop at rest catches the bead that is found again, and the next segment begins from there. After a shorter freeze, as a
/// machine that stalls causes, it plays on where the clock is.
#[derive(Debug, Clone)]
pub struct Exciting {
    excitation_um: Vec<f64>,
    /// First tick of each segment.
    starts: Vec<usize>,
    /// Tick up to which nothing is played.
    quiet_until: usize,
    now: Option<usize>,
    /// Tick in which the freeze began.
    frozen_at: Option<usize>,
    /// Length of a freeze that ends its segment, ticks.
    patience: usize,
}

impl Exciting {
    /// Plays the segments `todo` of a plan.
    pub fn new(plan: &Plan, todo: &[Turn]) -> Self {
        let schedule = plan.schedule(todo);
        let starts = schedule.spans.iter().map(|span| span.start).collect();
        Self::playing(schedule.excitation_um, starts, plan.lost_frames)
    }

    fn playing(excitation_um: Vec<f64>, starts: Vec<usize>, patience: usize) -> Self {
        Self {
            excitation_um,
            starts,
            quiet_until: 0,
            now: None,
            frozen_at: None,
            patience,
        }
    }

    /// The tick of the excitation, once it has begun.
    fn at(&self) -> Option<usize> {
        self.now?.checked_sub(SETTLE_TICKS)
    }
}

impl ReferenceGenerator for Exciting {
    fn step(&mut self, input: &ReferenceInput, preview_um: &mut [f64]) -> ReferenceOutput {
        preview_um.fill(0.0);
        let tick = usize::try_from(input.tick).unwrap_or(usize::MAX);
        self.now = input.running.then_some(tick);
        let frozen_at = self.frozen_at.unwrap_or(tick);
        self.frozen_at = input.frozen.then_some(frozen_at);
        if let (true, Some(at)) = (input.frozen, self.at())
            && tick - frozen_at >= self.patience
        {
            let next = self.starts.iter().copied().find(|&start| start > at);
            self.quiet_until = next.unwrap_or(usize::MAX);
        }
        ReferenceOutput {
            reference_um: 0.0,
            plan_ns: -1,
            stage: Stage::None,
            phase: None,
            motion: 0,
        }
    }

    fn excitation_um(&self) -> f64 {
        let at = self.at().filter(|&at| at >= self.quiet_until);
        at.and_then(|at| self.excitation_um.get(at))
            .copied()
            .unwrap_or(0.0)
    }

    fn finished(&self) -> bool {
        self.at()
            .is_some_and(|at| at >= self.excitation_um.len() + REST_TICKS)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Output of two segments of three ticks each, with the bead frozen in some ticks, and the tick of their end. A freeze of two ticks is
    /// too long for a segment.
    fn played(frozen: impl Fn(usize) -> bool) -> (Vec<f64>, usize) {
        let mut exciting = Exciting::playing(vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0], vec![0, 3], 1);
        let mut all = Vec::new();
        for tick in 0.. {
            let input = ReferenceInput {
                running: true,
                frozen: frozen(tick),
                skip: false,
                tick: tick as u64,
                sample_s: 1e-3,
                position_um: None,
                age_ticks: 0,
                length_um: None,
                target_um: None,
            };
            let said = exciting.step(&input, &mut []);
            assert_eq!(said.reference_um, 0.0);
            if exciting.finished() {
                return (all, tick);
            }
            all.push(exciting.excitation_um());
        }
        unreachable!("it ends")
    }

    #[test]
    fn it_rests_before_the_first_segment_and_behind_the_last() {
        let (all, over) = played(|_| false);
        assert_eq!(over, SETTLE_TICKS + 6 + REST_TICKS);
        assert!(all[..SETTLE_TICKS].iter().all(|um| *um == 0.0));
        assert_eq!(
            all[SETTLE_TICKS..SETTLE_TICKS + 6],
            [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
        );
        assert!(all[SETTLE_TICKS + 6..].iter().all(|um| *um == 0.0));
    }

    #[test]
    fn what_is_left_of_a_segment_in_which_the_bead_was_frozen_for_long_is_not_played() {
        let (all, over) = played(|tick| (SETTLE_TICKS..SETTLE_TICKS + 2).contains(&tick));
        assert_eq!(
            all[SETTLE_TICKS..SETTLE_TICKS + 6],
            [1.0, 0.0, 0.0, 4.0, 5.0, 6.0]
        );
        assert_eq!(
            over,
            SETTLE_TICKS + 6 + REST_TICKS,
            "the plan is the clock's"
        );
        let (all, _) = played(|tick| (SETTLE_TICKS + 3..SETTLE_TICKS + 5).contains(&tick));
        assert!(all[SETTLE_TICKS + 4..].iter().all(|um| *um == 0.0));
        let (all, _) = played(|tick| tick < SETTLE_TICKS);
        assert_eq!(all[SETTLE_TICKS], 1.0, "a freeze before it spoils nothing");
        let (all, _) = played(|tick| tick == SETTLE_TICKS + 1);
        assert_eq!(
            all[SETTLE_TICKS..SETTLE_TICKS + 6],
            [1.0, 2.0, 3.0, 4.0, 5.0, 6.0],
            "nor does a short one"
        );
    }
}
