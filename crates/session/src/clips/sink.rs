//! Decides when to keep a clip: around events, and at the times of the schedule.

use super::Clips;
use super::moment::Moment;
use crate::view::{ClipLine, CycleRow, EventLine, Shown, State};
use cellpos_runtime::life::EventKind;
use cellpos_runtime::{Event, RunSink, Statistics, TickRecord};

/// Moments of a script's plan, in their order: time in the plan, s, and name.
pub type Schedule = Vec<(f64, String)>;

/// Least time between two clips of events, s: the first clip shows an intermittent fault.
const APART_S: f64 = 10.0;

/// A sink that keeps clips of the run that passes through it.
pub struct Clipped<S> {
    sink: S,
    clips: Option<Clips>,
    schedule: Schedule,
    next: usize,
    events: bool,
    last: Option<TickRecord>,
    last_event_s: f64,
}

impl<S> Clipped<S> {
    /// A sink with clips, or the bare sink without them. `events`: whether events are kept.
    pub fn new(sink: S, clips: Option<Clips>, schedule: Schedule, events: bool) -> Self {
        Self {
            sink,
            clips,
            schedule,
            next: 0,
            events,
            last: None,
            last_event_s: f64::NEG_INFINITY,
        }
    }

    /// The sink within.
    pub fn within(&self) -> &S {
        &self.sink
    }

    /// The sink within, and the clips.
    pub fn into_parts(self) -> (S, Option<Clips>) {
        (self.sink, self.clips)
    }

    fn keep(&self, record: &TickRecord, name: String) {
        if let Some(moments) = self.clips.as_ref().and_then(|clips| clips.moments.as_ref()) {
            // The thread is gone only if it failed, which it reports at the end.
            let _ = moments.send(Moment {
                frame: (record.frame_id, record.mid_exposure_ns),
                at_ns: record.time_ns,
                name,
            });
        }
    }

    fn happened(&mut self, event: &Event) {
        let name = match event.kind {
            EventKind::FreezeStarted { .. } => "frozen",
            EventKind::SafeLatched { .. } => "safe",
            EventKind::BeadReacquired { .. } => "reacquired",
            EventKind::StuckStarted => "stuck",
            _ => return,
        };
        let time_s = event.time_ns as f64 * 1e-9;
        // The clip of the run's end is always kept.
        if name != "safe" && time_s - self.last_event_s < APART_S {
            return;
        }
        if let Some(record) = self.last.filter(|_| self.events) {
            self.last_event_s = time_s;
            self.keep(&record, format!("{time_s:011.3}s-{name}"));
        }
    }
}

impl<S: RunSink> RunSink for Clipped<S> {
    fn inner(&self) -> Option<&dyn RunSink> {
        Some(&self.sink)
    }

    fn inner_mut(&mut self) -> Option<&mut dyn RunSink> {
        Some(&mut self.sink)
    }

    fn tick(&mut self, record: &TickRecord) {
        while let Some((at_s, name)) = self.schedule.get(self.next) {
            if (record.plan_ns as f64) < at_s * 1e9 {
                break;
            }
            self.keep(record, name.clone());
            self.next += 1;
        }
        self.last = Some(*record);
        self.sink.tick(record);
    }

    fn event(&mut self, event: &Event) {
        self.happened(event);
        self.sink.event(event);
    }

    fn progress(&mut self, statistics: &Statistics) {
        self.sink.progress(statistics);
    }
}

impl<S: Shown> Shown for Clipped<S> {
    fn complete(&self, state: &mut State) {
        self.sink.complete(state);
    }

    fn next_cycle(&mut self) -> Option<CycleRow> {
        self.sink.next_cycle()
    }

    fn next_line(&mut self) -> Option<EventLine> {
        self.sink.next_line()
    }

    fn next_clip(&mut self) -> Option<ClipLine> {
        self.clips.as_ref().and_then(Clips::next_kept)
    }
}
