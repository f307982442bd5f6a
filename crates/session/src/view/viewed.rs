//! A sink that feeds the view with the run that passes through it.

use super::last_word;
use super::live_view::View;
use super::watcher::{Shown, Watcher};
use crate::ended::Ended;
use crate::failure::Failure;
use crate::words::Level;
use cellpos_runtime::{Event, RunSink, Statistics, Summary, TickRecord};
use std::sync::mpsc::Receiver;

/// A sink that feeds page and screen with the run that passes through it.
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

    /// The sink within.
    pub fn within(&self) -> &S {
        &self.sink
    }

    /// The sink within, by itself. The page shows the summary's own figures from now on.
    pub fn into_inner(self, summary: &Summary, ended: &Ended) -> S {
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

    /// The sink within, of a run whose board could not be armed: the page says why.
    pub fn refused(self, failure: &Failure) -> S {
        if let Some((mut watcher, _)) = self.page {
            watcher.over(last_word::of_refusal(failure));
        }
        self.sink
    }
}

impl<S: RunSink + Shown> RunSink for Viewed<S> {
    fn inner(&self) -> Option<&dyn RunSink> {
        Some(&self.sink)
    }

    fn inner_mut(&mut self) -> Option<&mut dyn RunSink> {
        Some(&mut self.sink)
    }

    fn tick(&mut self, record: &TickRecord) {
        self.sink.tick(record);
        if let Some((watcher, _)) = &mut self.page {
            watcher.show(record);
            watcher.count(record);
            watcher.take_counts(&record.counts);
            // The page shows a freeze as soon as it is in force, not at its next update.
            if watcher.turns(record) {
                watcher.show_state(record, &self.sink);
            }
        }
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::view::{Hello, Wanted};
    use cellpos_live::Feed;
    use cellpos_runtime::NoSink;
    use cellpos_runtime::live::Operator;
    use std::sync::Arc;

    #[test]
    fn a_second_run_on_the_same_page_goes_on_behind_the_first() {
        let mut view = View::open(
            &Wanted::default(),
            Hello::default(),
            &Arc::new(Operator::default()),
        )
        .unwrap();
        let (feed, mut hub) = Feed::new(Hello::default());
        view.watcher = Some(Watcher::new(vec![feed]));
        let run = |view: &mut View| {
            let mut sink = Viewed::new(NoSink, Some(view));
            let mut statistics = Statistics::default();
            for seq in 0..100 {
                let mut record = TickRecord::unknown();
                (record.seq, record.time_ns) = (seq, 1_000_000 * seq as i64);
                (record.wake_ns, record.compute_ns) = (20_000, 7_000);
                statistics.add(&record);
                sink.tick(&record);
            }
            sink.progress(&statistics);
            sink.give_back(Some(view));
        };
        run(&mut view);
        run(&mut view);
        let rows: Vec<_> = std::iter::from_fn(|| hub.next_row()).collect();
        assert_eq!(rows.len(), 200);
        assert!(rows.iter().zip(0..).all(|(row, n)| row.seq == n));
        assert!(rows.windows(2).all(|pair| pair[1].time_s >= pair[0].time_s));
        let last = std::iter::from_fn(|| hub.next_line()).last();
        let Some(cellpos_live::Line::State(state)) = last else {
            panic!("{last:?}");
        };
        assert_eq!(state.ticks, 200);
        // Within a step of the tail.
        let near =
            |told: Option<f64>, us: f64| told.is_some_and(|told| (told / us - 1.0).abs() < 0.017);
        assert!(
            near(state.wake_us, 20.0) && near(state.compute_us, 7.0),
            "{state:?}"
        );
    }
}
