//! The data of page and screen, from the rows of the recorder.

use super::last_word;
use super::possible::Possible;
use super::tail::Tail;
use crate::adapt;
use crate::connect::Reached;
use crate::ended::Ended;
use crate::words::{Level, safe_reason, sentence};
use cellpos_live::{Banner, ClipLine, CycleRow, EventLine, Feed, LastWord, Row, State};
use cellpos_runtime::life::EventKind;
use cellpos_runtime::{
    Event, Life, NoSink, Statistics, Summary, TickCounts, TickFlags, TickRecord,
};

/// Further facts of a sink for the page, besides the rows.
pub trait Shown {
    /// Completes the state of the run.
    fn complete(&self, state: &mut State) {
        let _ = state;
    }
    /// The next newly finished cycle.
    fn next_cycle(&mut self) -> Option<CycleRow> {
        None
    }
    /// The next event that the sink found, an alarm or a mark.
    fn next_line(&mut self) -> Option<EventLine> {
        None
    }
    /// The next newly written clip.
    fn next_clip(&mut self) -> Option<ClipLine> {
        None
    }
}

impl Shown for NoSink {}

/// Number of states between two reports of the tails of the ticks' times.
const TAILS_EVERY: u32 = 10;

/// Feeds page and screen with rows of the recorder, or with rows read from a folder.
pub(super) struct Watcher {
    feeds: Vec<Feed>,
    pub(super) state: State,
    freeze: String,
    pub(super) safe: String,
    wake: Tail,
    compute: Tail,
    told: u32,
    /// Life and freeze of the newest tick.
    standing: (u8, bool),
    /// Ticks, time in s, and counts of the runs before this one on the same page.
    before: (u64, f64, TickCounts),
    /// Index of the first column of adaptation among the law's columns.
    adaptation_at: Option<usize>,
    pub(super) possible: Option<Possible>,
}

impl Watcher {
    pub(super) fn new(feeds: Vec<Feed>) -> Self {
        Self {
            feeds,
            state: State::default(),
            freeze: String::new(),
            safe: String::new(),
            wake: Tail::new(),
            compute: Tail::new(),
            told: 0,
            standing: (0, false),
            before: (0, 0.0, TickCounts::default()),
            adaptation_at: None,
            possible: None,
        }
    }

    /// The same with the lowest possible error.
    pub(super) fn with_possible(mut self, possible: Option<Possible>) -> Self {
        self.possible = possible;
        self
    }

    /// The same for a run whose record has the columns of adaptation there.
    pub(super) fn with_adaptation(mut self, adaptation_at: Option<usize>) -> Self {
        self.adaptation_at = adaptation_at;
        self
    }

    /// The next rows belong to another run and are shown after the present ones.
    pub(super) fn next_run(&mut self) {
        let counts = TickCounts {
            skipped: self.state.skipped,
            frames_lost: self.state.frames_lost,
            stale: self.state.stale,
        };
        self.before = (self.state.ticks, self.state.time_s, counts);
        self.freeze.clear();
        self.safe.clear();
    }

    fn time_s(&self, time_ns: i64) -> f64 {
        self.before.1 + time_ns as f64 * 1e-9
    }

    /// A tick as it is drawn.
    pub(super) fn row(&mut self, row: &Row) {
        self.feeds.iter_mut().for_each(|feed| feed.row(row));
    }

    /// What happened.
    pub(super) fn event_line(&mut self, line: EventLine) {
        self.feeds
            .iter_mut()
            .for_each(|feed| feed.event(line.clone()));
    }

    /// A cycle is over.
    pub(super) fn cycle(&mut self, cycle: CycleRow) {
        self.feeds.iter_mut().for_each(|feed| feed.cycle(cycle));
    }

    /// A clip is on the disk.
    pub(super) fn clip(&mut self, clip: ClipLine) {
        self.feeds
            .iter_mut()
            .for_each(|feed| feed.clip(clip.clone()));
    }

    /// How the run stands.
    pub(super) fn tell_state(&mut self) {
        let Self { feeds, state, .. } = self;
        feeds.iter_mut().for_each(|feed| feed.state(state.clone()));
    }

    /// Shows a tick.
    pub(super) fn show(&mut self, record: &TickRecord) {
        self.row(&Row {
            seq: (self.before.0 + record.seq) as u32,
            time_s: self.time_s(record.time_ns),
            measured_um: record.measured_um as f32,
            target_um: record.target_um as f32,
            target_then_um: (record.measured_um - record.error_um) as f32,
            command_um: record.command_um as f32,
            zero_flow_um: record.neutral_um as f32,
            length_um: record.length_um as f32,
            area_um2: record.area_um2 as f32,
            gain: self.gain(record),
            wake_us: record.wake_ns as f32 * 1e-3,
            compute_us: record.compute_ns as f32 * 1e-3,
            flags: record.flags.0,
            life: record.life,
        });
    }

    /// Estimated gain of the plant over the model's; NaN without an estimate.
    fn gain(&self, record: &TickRecord) -> f32 {
        let columns = self.adaptation_at.and_then(|at| record.law.get(at..));
        columns
            .and_then(adapt::recorded)
            .and_then(|now| now.gain_estimate)
            .map_or(f32::NAN, |[gain, _]| gain as f32)
    }

    /// Counts a tick.
    pub(super) fn count(&mut self, record: &TickRecord) {
        self.wake.add(record.wake_ns);
        self.compute.add(record.compute_ns);
        if let Some(possible) = &mut self.possible {
            possible.count(record);
        }
        let time_s = self.time_s(record.time_ns);
        let state = &mut self.state;
        state.time_s = time_s;
        state.ticks = self.before.0 + record.seq + 1;
        state.late += u64::from(record.flags.has(TickFlags::LATE));
        state.coasted += u64::from(record.flags.has(TickFlags::COASTING));
    }

    /// Takes the loop's own counts: the summary as if the run had ended with this tick.
    pub(super) fn take_counts(&mut self, counts: &TickCounts) {
        let (.., before) = &self.before;
        self.state.skipped = before.skipped + counts.skipped;
        self.state.frames_lost = before.frames_lost + counts.frames_lost;
        self.state.stale = before.stale + counts.stale;
    }

    /// Whether a tick differs in state from the one before: frozen, parked or running.
    pub(super) fn turns(&mut self, record: &TickRecord) -> bool {
        let standing = (record.life, record.flags.has(TickFlags::FREEZE));
        std::mem::replace(&mut self.standing, standing) != standing
    }

    /// Reports the state of the run after a tick.
    pub(super) fn show_state(&mut self, record: &TickRecord, sink: &impl Shown) {
        self.state.banner = self.banner(record);
        sink.complete(&mut self.state);
        self.tell_state();
    }

    /// Shows an event and counts it.
    pub(super) fn event(&mut self, event: &Event, times: u64) {
        match event.kind {
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

    /// Tells what happened.
    pub(super) fn tell(&mut self, time_ns: i64, level: Level, text: String) {
        self.event_line(EventLine {
            time_s: self.time_s(time_ns),
            level: level.name(),
            text,
        });
    }

    /// Reports the state of the run.
    pub(super) fn progress(&mut self, statistics: &Statistics, sink: &impl Shown) {
        let Some(record) = statistics.last() else {
            return;
        };
        self.state.rms_nm = statistics.rms_measured_nm();
        self.state.fix_noise_nm = statistics.fix_noise_um().map(|um| um * 1e3);
        self.tails();
        self.show_state(record, sink);
    }

    /// Reports the tails of the ticks' times, and the lowest possible error, from time to time: a search through all counts.
    pub(super) fn tails(&mut self) {
        if self.told.is_multiple_of(TAILS_EVERY) {
            self.state.wake_us = self.wake.p999_us();
            self.state.compute_us = self.compute.p999_us();
            let possible = self.possible.as_ref().zip(self.state.fix_noise_nm);
            self.state.bound_nm = possible.and_then(|(it, noise_nm)| it.so_far_nm(noise_nm));
        }
        self.told = self.told.wrapping_add(1);
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
            Some(Life::Running) => {
                let columns = self.adaptation_at.and_then(|at| record.law.get(at..));
                let adaptation = columns
                    .and_then(adapt::recorded)
                    .map(|now| adapt::text(&now));
                let adaptation = adaptation.map_or_else(String::new, |text| format!("; {text}"));
                ("running", format!("The loop is closed{adaptation}."))
            }
            Some(Life::Safe) => ("safe", format!("The PZT parks: {}.", self.safe)),
            _ => (
                "armed",
                "The bead is being looked for, and the plant's answer is checked.".to_string(),
            ),
        };
        Banner { state, reason }
    }

    /// The figures of the run's own summary, and its end.
    pub(super) fn conclude(&mut self, summary: &Summary, ended: &Ended) {
        let counts = &summary.counts;
        let before = std::mem::take(&mut self.state);
        self.state = State {
            rms_nm: summary.rms_measured_nm,
            fix_noise_nm: summary.fix_noise_nm,
            bound_nm: self.bound_of(Reached::of(summary)),
            wake_us: Some(summary.wake_us.p999),
            compute_us: Some(summary.tick_us.p999),
            late: counts.late,
            skipped: counts.skipped,
            frames_lost: counts.frames_lost,
            stale: counts.stale,
            coasted: counts.coasted,
            records_lost: summary.records_lost,
            ..before
        };
        self.over(ended.last_word());
    }

    /// The lowest possible error of a run that is over, nm.
    pub(super) fn bound_of(&self, run: Option<Reached>) -> Option<f64> {
        self.possible.as_ref()?.of(&run?)
    }

    /// The run is over.
    pub(super) fn over(&mut self, word: LastWord) {
        self.state.banner = Banner {
            state: match word.how {
                "safe" => "safe",
                "failed" | "not-kept" => "failed",
                _ => "over",
            },
            reason: word.seen.clone(),
        };
        self.state.last_word = Some(word);
        self.state.left_s = None;
        self.state.next = None;
        self.tell_state();
    }
}

impl Drop for Watcher {
    /// A run without a summary has a final message nevertheless.
    fn drop(&mut self) {
        if self.state.last_word.is_none() && self.state.ticks > 0 {
            self.over(last_word::of_silence());
        }
    }
}
