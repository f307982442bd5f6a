//! Collects the clues of a run's end on the way to the sink.

use crate::clues::Clues;
use crate::words::is_odd;
use crate::{say, words};
use cellpos_runtime::life::EventKind;
use cellpos_runtime::{Event, RunSink, Statistics, TickRecord};

/// Passes everything on to a sink, and keeps the events that explain why a run ended.
pub(crate) struct Witness<S> {
    pub(crate) sink: S,
    pub(crate) clues: Clues,
}

impl<S: RunSink> RunSink for Witness<S> {
    fn inner(&self) -> Option<&dyn RunSink> {
        Some(&self.sink)
    }

    fn inner_mut(&mut self) -> Option<&mut dyn RunSink> {
        Some(&mut self.sink)
    }

    fn tick(&mut self, record: &TickRecord) {
        self.sink.tick(record);
    }

    fn event(&mut self, event: &Event) {
        self.clues.note(event);
        // Report it while the bead is still held, not only after the run.
        let told = match event.kind {
            EventKind::ArmingPassed { gain_ratio, ci95 } => is_odd(gain_ratio, ci95),
            EventKind::DiskSlowStarted { .. } => true,
            _ => false,
        };
        if told {
            say::say(format!("WARNING: {}", words::sentence(&event.kind).1));
        }
        self.sink.event(event);
    }

    fn repeated(&mut self, last: &Event, count: u64) {
        self.clues.note(last);
        self.sink.repeated(last, count);
    }

    fn progress(&mut self, statistics: &Statistics) {
        self.sink.progress(statistics);
    }
}
