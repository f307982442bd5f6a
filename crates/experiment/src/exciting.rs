//! Segments of an identification's run, and the sink of its ticks.

use cellpos_ident::experiment::{Schedule, Span};
use cellpos_runtime::{
    Event, ReferenceGenerator, ReferenceInput, ReferenceOutput, RunSink, Stage, Statistics,
    TickRecord,
};
use cellpos_session::view::{Shown, State};
use std::sync::mpsc::Sender;

/// Ticks at rest between closing the loop and the first segment.
pub(crate) const SETTLE_TICKS: usize = 500;

/// Ticks at rest after the last segment: the loop settles and knows the zero flow again before the bead is frozen there.
pub(crate) const REST_TICKS: usize = 400;

/// Holds the bead at 0 um and plays the excitation, counted from where the loop was closed.
///
/// A segment with a frozen bead is spoilt; the rest is not played. The bead that is found again is caught
/// by a loop at rest, not by one that is being shaken, and the next segment begins from there.
#[derive(Debug)]
pub(crate) struct Exciting {
    excitation_um: Vec<f64>,
    /// First tick of each segment.
    starts: Vec<usize>,
    /// Until when nothing is played.
    quiet_until: usize,
    now: Option<usize>,
}

impl Exciting {
    pub(crate) fn new(schedule: &Schedule) -> Self {
        Self {
            excitation_um: schedule.excitation_um.clone(),
            starts: schedule.spans.iter().map(|span| span.start).collect(),
            quiet_until: 0,
            now: None,
        }
    }

    /// The tick of the schedule, once it has begun.
    fn at(&self) -> Option<usize> {
        self.now?.checked_sub(SETTLE_TICKS)
    }
}

impl ReferenceGenerator for Exciting {
    fn step(&mut self, input: &ReferenceInput, preview_um: &mut [f64]) -> ReferenceOutput {
        preview_um.fill(0.0);
        let tick = usize::try_from(input.tick).unwrap_or(usize::MAX);
        self.now = input.running.then_some(tick);
        if let (true, Some(at)) = (input.frozen, self.at()) {
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

/// Hands every tick on, to whoever waits for the run.
pub(crate) struct Handing {
    ticks: Sender<TickRecord>,
    /// The segments, by ticks since the first one.
    spans: Vec<Span>,
    /// The tick in which the loop was closed, and the newest.
    closed: Option<u64>,
    newest: u64,
    period_s: f64,
}

impl Handing {
    /// Of a run that measures `spans`, by ticks since the first one, at a period of `period_s`.
    pub(crate) fn new(ticks: Sender<TickRecord>, spans: &[Span], period_s: f64) -> Self {
        Self {
            ticks,
            spans: spans.to_vec(),
            closed: None,
            newest: 0,
            period_s,
        }
    }
}

impl RunSink for Handing {
    fn tick(&mut self, record: &TickRecord) {
        if self.closed.is_none() && record.is_running() {
            self.closed = Some(record.seq);
        }
        self.newest = record.seq;
        // No receiver: the run has already ended.
        let _ = self.ticks.send(*record);
    }
    fn event(&mut self, _: &Event) {}
    fn progress(&mut self, _: &Statistics) {}
}

impl Shown for Handing {
    fn complete(&self, state: &mut State) {
        let Some(closed) = self.closed else {
            return;
        };
        let since = usize::try_from(self.newest - closed).unwrap_or(usize::MAX);
        let now = since.saturating_sub(SETTLE_TICKS);
        let begun = (self.spans.iter()).filter(|span| span.start <= now).count();
        let end = (self.spans.last()).map_or(0, |span| span.start + span.rows);
        state.doing = Some(format!("Segment {begun} of {}", self.spans.len()));
        state.left_s = Some(self.period_s * (SETTLE_TICKS + end).saturating_sub(since) as f64);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_ident::experiment::{Schedule, Span};

    /// What two segments of three ticks each play, with the bead frozen in some ticks, and when they are over.
    fn played(frozen: impl Fn(usize) -> bool) -> (Vec<f64>, usize) {
        let span = |index: usize| Span {
            index,
            start: 3 * index,
            settle: 0,
            rows: 3,
        };
        let mut exciting = Exciting::new(&Schedule {
            excitation_um: vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0],
            spans: vec![span(0), span(1)],
        });
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
    fn what_is_left_of_a_segment_in_which_the_bead_was_frozen_is_not_played() {
        let (all, over) = played(|tick| tick == SETTLE_TICKS + 1);
        assert_eq!(
            all[SETTLE_TICKS..SETTLE_TICKS + 6],
            [1.0, 0.0, 0.0, 4.0, 5.0, 6.0]
        );
        assert_eq!(
            over,
            SETTLE_TICKS + 6 + REST_TICKS,
            "the plan is the clock's"
        );
        let (all, _) = played(|tick| tick == SETTLE_TICKS + 4);
        assert!(all[SETTLE_TICKS + 4..].iter().all(|um| *um == 0.0));
        let (all, _) = played(|tick| tick < SETTLE_TICKS);
        assert_eq!(all[SETTLE_TICKS], 1.0, "a freeze before it spoils nothing");
    }
}
