//! A sink that shows what passes through it.

use super::live_view::View;
use super::watcher::{Shown, Watcher};
use crate::words::Level;
use cellpos_runtime::recorder::Unconfirmed;
use cellpos_runtime::{Event, RunSink, Statistics, Summary, TickRecord};
use std::sync::mpsc::Receiver;

/// A sink that shows page and screen what passes through it.
pub struct Viewed<S> {
    sink: S,
    page: Option<(Watcher, Receiver<String>)>,
}

impl<S> Viewed<S> {
    /// A sink without a page, or with one.
    pub fn new(sink: S, view: Option<&mut View>) -> Self {
        let page = view.and_then(|view| Some((view.watcher.take()?, view.notes.take()?)));
        Self { sink, page }
    }

    /// The sink within. The page shows the summary's own figures from now on.
    pub fn into_inner(self, summary: &Summary, ended: &str) -> S {
        if let Some((mut watcher, _)) = self.page {
            watcher.conclude(summary, ended);
        }
        self.sink
    }

    /// The sink within, of a run after which the same page shows another one.
    pub fn give_back(self, view: Option<&mut View>) -> S {
        if let (Some((mut watcher, notes)), Some(view)) = (self.page, view) {
            watcher.next_run();
            (view.watcher, view.notes) = (Some(watcher), Some(notes));
        }
        self.sink
    }

    /// The sink within, of a run that did not come to a summary.
    pub fn into_sink(self) -> S {
        self.sink
    }
}

impl<S: RunSink + Shown> RunSink for Viewed<S> {
    fn tick(&mut self, record: &TickRecord) {
        if let Some((watcher, _)) = &mut self.page {
            watcher.show(record);
            watcher.count(record);
        }
        self.sink.tick(record);
    }

    fn event(&mut self, event: &Event) {
        if let Some((watcher, _)) = &mut self.page {
            watcher.event(event, 1);
        }
        self.sink.event(event);
    }

    fn repeated(&mut self, last: &Event, count: u64) {
        if let Some((watcher, _)) = &mut self.page {
            watcher.event(last, count);
        }
        self.sink.repeated(last, count);
    }

    fn note(&mut self, time_ns: i64, text: &str) {
        self.sink.note(time_ns, text);
    }

    fn is_ready(&self) -> bool {
        self.sink.is_ready()
    }

    fn is_refused(&self) -> bool {
        self.sink.is_refused()
    }

    fn unconfirmed(&self) -> Unconfirmed {
        self.sink.unconfirmed()
    }

    fn learned(&mut self, motion: u16, state: &cellpos_control::LearnerState) {
        self.sink.learned(motion, state);
    }

    fn progress(&mut self, statistics: &Statistics) {
        if let Some((watcher, notes)) = &mut self.page {
            let time_ns = statistics.last().map_or(0, |record| record.time_ns);
            while let Ok(text) = notes.try_recv() {
                self.sink.note(time_ns, &text);
                watcher.tell(time_ns, Level::Info, format!("Note: {text}"));
            }
            while let Some(line) = self.sink.next_line() {
                watcher.event_line(line);
            }
            while let Some(cycle) = self.sink.next_cycle() {
                watcher.cycle(cycle);
            }
            while let Some(clip) = self.sink.next_clip() {
                watcher.clip(clip);
            }
            watcher.progress(statistics, &self.sink);
        }
        self.sink.progress(statistics);
    }
}
