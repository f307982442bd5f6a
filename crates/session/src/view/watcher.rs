//! What the recorder is given, shown on the page as it passes through.

use super::View;
use crate::words::{Level, safe_reason, sentence};
use cellpos_live::{Banner, CycleRow, EventLine, Feed, Row, State};
use cellpos_runtime::life::EventKind;
use cellpos_runtime::recorder::Unconfirmed;
use cellpos_runtime::{Event, Life, RunSink, Statistics, Summary, TickFlags, TickRecord};
use std::sync::mpsc::Receiver;

/// What a sink knows of its run that the page is to show besides what passes through it.
pub trait Shown {
    /// Completes how the run stands.
    fn complete(&self, state: &mut State) {
        let _ = state;
    }
    /// The next cycle that was finished since.
    fn next_cycle(&mut self) -> Option<CycleRow> {
        None
    }
    /// The next thing that the sink found by itself since, an alarm or a mark.
    fn next_line(&mut self) -> Option<EventLine> {
        None
    }
}

/// References of the last ticks: the error of a position is counted from where the bead was to be when it was exposed.
const TARGETS: usize = 16;

/// What feeds the page, from what the recorder is given, or from what is read in its folder.
pub(super) struct Watcher {
    pub(super) feed: Feed,
    targets: [(i64, f64); TARGETS],
    pub(super) state: State,
    freeze: String,
    pub(super) safe: String,
}

/// A sink that shows a page what passes through it.
pub struct Viewed<S> {
    sink: S,
    page: Option<(Watcher, Receiver<String>)>,
}

impl<S> Viewed<S> {
    /// A sink without a page, or with one.
    pub fn new(sink: S, view: Option<&mut View>) -> Self {
        let page =
            view.and_then(|view| Some((Watcher::new(view.feed.take()?), view.notes.take()?)));
        Self { sink, page }
    }

    /// The sink within. The page shows the summary's own figures from now on.
    pub fn into_inner(self, summary: &Summary, ended: &str) -> S {
        if let Some((mut watcher, _)) = self.page {
            watcher.conclude(summary, ended);
        }
        self.sink
    }

    /// The sink within, of a run that did not come to a summary.
    pub fn into_sink(self) -> S {
        self.sink
    }
}

impl Watcher {
    pub(super) fn new(feed: Feed) -> Self {
        Self {
            feed,
            targets: [(i64::MIN, f64::NAN); TARGETS],
            state: State::default(),
            freeze: String::new(),
            safe: String::new(),
        }
    }

    /// Shows a tick.
    pub(super) fn show(&mut self, record: &TickRecord) {
        self.targets.copy_within(0..TARGETS - 1, 1);
        self.targets[0] = (record.time_ns, record.target_um);
        let exposed_ns = record.mid_exposure_ns;
        let then = self.targets.iter().find(|(ns, _)| *ns <= exposed_ns);
        self.feed.row(&Row {
            seq: record.seq as u32,
            time_s: record.time_ns as f64 * 1e-9,
            measured_um: record.measured_um as f32,
            target_um: record.target_um as f32,
            target_then_um: then.map_or(f32::NAN, |(_, um)| *um as f32),
            command_um: record.command_um as f32,
            zero_flow_um: record.neutral_um as f32,
            length_um: record.length_um as f32,
            wake_us: record.wake_ns as f32 * 1e-3,
            compute_us: record.compute_ns as f32 * 1e-3,
            flags: record.flags.0,
            life: record.life,
        });
    }

    /// Counts a tick.
    pub(super) fn count(&mut self, record: &TickRecord) {
        let state = &mut self.state;
        state.time_s = record.time_ns as f64 * 1e-9;
        state.ticks = record.seq + 1;
        state.late += u64::from(record.flags.has(TickFlags::LATE));
        state.stale += u64::from(record.flags.has(TickFlags::STALE));
        state.coasted += u64::from(record.flags.has(TickFlags::COASTING));
    }

    fn event(&mut self, event: &Event, times: u64) {
        match event.kind {
            EventKind::FramesDropped { count } => self.state.frames_lost += count * times,
            EventKind::TicksSkipped { count } => self.state.skipped += count * times,
            EventKind::FreezeStarted { .. } => self.freeze = sentence(&event.kind).1,
            EventKind::SafeLatched { reason } => self.safe = safe_reason(reason).to_string(),
            _ => {}
        }
        let (level, mut text) = sentence(&event.kind);
        if times > 1 {
            text = format!("{text} ({times} times more in this second)");
        }
        self.tell(event.time_ns, level, text);
    }

    fn tell(&mut self, time_ns: i64, level: Level, text: String) {
        self.feed.event(EventLine {
            time_s: time_ns as f64 * 1e-9,
            level: level.name(),
            text,
        });
    }

    fn progress(&mut self, statistics: &Statistics, sink: &impl Shown) {
        let Some(record) = statistics.last() else {
            return;
        };
        self.state.rms_nm = statistics.rms_measured_nm();
        self.state.banner = self.banner(record);
        sink.complete(&mut self.state);
        self.feed.state(self.state.clone());
    }

    pub(super) fn banner(&self, record: &TickRecord) -> Banner {
        let (state, reason) = match Life::from_number(record.life) {
            Some(Life::Running) if record.flags.has(TickFlags::FREEZE) => {
                ("frozen", self.freeze.clone())
            }
            Some(Life::Running) if record.flags.has(TickFlags::COASTING) => (
                "running",
                "No position: the loop runs on prediction.".to_string(),
            ),
            Some(Life::Running) => ("running", "The loop is closed.".to_string()),
            Some(Life::Safe) => ("safe", format!("The PZT parks: {}.", self.safe)),
            _ => (
                "armed",
                "The bead is being looked for, and the plant's answer is checked.".to_string(),
            ),
        };
        Banner { state, reason }
    }

    fn conclude(&mut self, summary: &Summary, ended: &str) {
        let counts = &summary.counts;
        self.state.banner = Banner {
            state: if summary.state == Life::Safe {
                "safe"
            } else {
                "over"
            },
            reason: format!("The run is over: {ended}"),
        };
        self.state.rms_nm = summary.rms_measured_nm;
        self.state.late = counts.late;
        self.state.skipped = counts.skipped;
        self.state.frames_lost = counts.frames_lost;
        self.state.stale = counts.stale;
        self.state.coasted = counts.coasted;
        self.state.records_lost = summary.records_lost;
        self.state.left_s = None;
        self.state.next = None;
        self.feed.state(self.state.clone());
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
                watcher.feed.event(line);
            }
            while let Some(cycle) = self.sink.next_cycle() {
                watcher.feed.cycle(cycle);
            }
            watcher.progress(statistics, &self.sink);
        }
        self.sink.progress(statistics);
    }
}
