//! What a run of an identification plays, and where its ticks go.

use cellpos_ident::experiment::Span;
use cellpos_runtime::{
    Event, Life, ReferenceGenerator, ReferenceInput, ReferenceOutput, RunSink, Stage, Statistics,
    TickRecord,
};
use cellpos_session::view::{Shown, State};
use std::sync::mpsc::Sender;

/// Ticks at rest between closing the loop and the first segment.
pub(crate) const SETTLE_TICKS: usize = 500;

/// Holds the bead at 0 um and plays the excitation, counted from where the loop was closed.
#[derive(Debug)]
pub(crate) struct Exciting {
    excitation_um: Vec<f64>,
    now: Option<usize>,
}

impl Exciting {
    /// An excitation, um, tick by tick.
    pub(crate) fn new(excitation_um: &[f64]) -> Self {
        Self {
            excitation_um: excitation_um.to_vec(),
            now: None,
        }
    }
}

impl ReferenceGenerator for Exciting {
    fn step(&mut self, input: &ReferenceInput, preview_um: &mut [f64]) -> ReferenceOutput {
        preview_um.fill(0.0);
        let tick = usize::try_from(input.tick).unwrap_or(usize::MAX);
        self.now = input.running.then_some(tick);
        ReferenceOutput {
            reference_um: 0.0,
            plan_ns: -1,
            stage: Stage::None,
            phase: None,
            motion: 0,
        }
    }

    fn excitation_um(&self) -> f64 {
        let at = self.now.and_then(|tick| tick.checked_sub(SETTLE_TICKS));
        at.and_then(|k| self.excitation_um.get(k))
            .copied()
            .unwrap_or(0.0)
    }

    fn finished(&self) -> bool {
        self.now
            .is_some_and(|tick| tick >= SETTLE_TICKS + self.excitation_um.len())
    }
}

/// Hands every tick on, to whoever waits for the run.
pub(crate) struct Handing {
    ticks: Sender<TickRecord>,
    /// The segments, by ticks since the first of them.
    spans: Vec<Span>,
    /// The tick in which the loop was closed, and the newest.
    closed: Option<u64>,
    newest: u64,
    period_s: f64,
}

impl Handing {
    /// Of a run that measures `spans`, by ticks since the first of them, at a period of `period_s`.
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
        if self.closed.is_none() && record.life == Life::Running as u8 {
            self.closed = Some(record.seq);
        }
        self.newest = record.seq;
        // Nobody who hears it: the run is given up already.
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
