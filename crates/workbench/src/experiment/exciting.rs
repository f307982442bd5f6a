//! The sink for the ticks of an identification: passes them to the waiting thread and into the run folder.

use cellpos_ident::experiment::Span;
use cellpos_record::RunWriter;
use cellpos_runtime::{Event, RunSink, Statistics, TickRecord};
pub(crate) use cellpos_session::exciting::SETTLE_TICKS;
use cellpos_session::recording::Recording;
use cellpos_session::view::{Shown, State};
use std::sync::mpsc::Sender;

/// Passes every tick to the thread that waits for the run, and to the run folder.
pub(crate) struct Handing {
    recording: Recording,
    ticks: Sender<TickRecord>,
    /// The segments, by ticks since the first segment.
    spans: Vec<Span>,
    /// The tick in which the loop was closed, and the newest tick.
    closed: Option<u64>,
    newest: u64,
    period_s: f64,
}

impl Handing {
    /// Of a run that measures `spans`, by ticks since the first span, at a period of `period_s`.
    pub(crate) fn new(
        writer: Option<RunWriter>,
        ticks: Sender<TickRecord>,
        spans: &[Span],
        period_s: f64,
    ) -> Self {
        Self {
            recording: Recording::new(writer, None),
            ticks,
            spans: spans.to_vec(),
            closed: None,
            newest: 0,
            period_s,
        }
    }

    /// The run folder's writer, to be finished.
    pub(crate) fn into_writer(self) -> Option<RunWriter> {
        self.recording.into_writer()
    }
}

impl RunSink for Handing {
    fn inner(&self) -> Option<&dyn RunSink> {
        Some(&self.recording)
    }

    fn inner_mut(&mut self) -> Option<&mut dyn RunSink> {
        Some(&mut self.recording)
    }

    fn tick(&mut self, record: &TickRecord) {
        self.recording.tick(record);
        if self.closed.is_none() && record.is_running() {
            self.closed = Some(record.seq);
        }
        self.newest = record.seq;
        // No receiver: the run has ended already.
        let _ = self.ticks.send(*record);
    }

    fn event(&mut self, event: &Event) {
        self.recording.event(event);
    }

    fn progress(&mut self, statistics: &Statistics) {
        self.recording.progress(statistics);
    }
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
