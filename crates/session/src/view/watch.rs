//! The page of a run that is read from its folder: a finished run, or one that another process runs.

use super::cycle::cycle_row;
use super::hello::{Page, hello_of};
use super::last_word;
use super::live_view::film_of;
use super::possible::Possible;
use super::served::{Server, ViewAddress, serve};
use super::watcher::Watcher;
use crate::clips;
use crate::connect::Reached;
use crate::failure::Failure;
use crate::recorded;
use cellpos_live::{Banner, EventLine, Feed};
use cellpos_record::{CYCLES_CSV, Event, Follow, RunEnd, Sessions};
use cellpos_runtime::{Statistics, TickFlags, TickRecord};
use cellpos_script::{AtRest, CycleRow, read_cycles};
use std::collections::{BTreeSet, VecDeque};
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Rows handed to the page at once: half of its ring.
const ROWS_AT_ONCE: usize = 4096;
/// Time of a run that the page holds, s.
const HELD_S: f64 = 600.0;
/// If nothing is added to an unfinished run for this time, its program or its disk has failed.
const SILENT_AFTER: Duration = Duration::from_secs(5);
/// Largest part of the table of cycles to read at once, bytes.
const MOST_TABLE: u64 = 16 << 20;
/// Interval between two looks into the folder of clips.
const CLIPS_EVERY: Duration = Duration::from_secs(1);

/// A page that shows a run folder. It requests nothing from the program that writes it, and accepts no requests itself.
pub struct Watch {
    server: Server,
    watcher: Watcher,
    follow: Follow,
    folder: PathBuf,
    statistics: Statistics,
    waiting: VecDeque<TickRecord>,
    most_waiting: usize,
    last: Option<TickRecord>,
    changed: Instant,
    cycles: CyclesRead,
    at_rest: AtRest,
    session: PathBuf,
    clips: (Option<Instant>, BTreeSet<String>),
    over: bool,
}

impl Watch {
    /// Serves the page of the newest session of a run.
    ///
    /// # Errors
    /// There is no run, its `run.toml` is invalid, or the address cannot be used.
    pub fn open(folder: &Path, at: ViewAddress) -> Result<Self, Failure> {
        let sessions = Sessions::of(folder).map_err(Failure::input)?;
        let newest = sessions.readers.last().map_or(folder, |(_, r)| r.folder());
        let session = newest.to_owned();
        let follow = Follow::open(newest).map_err(Failure::input)?;
        let setup = recorded::setup(follow.reader())?;
        let meta = follow.reader().meta().ok();
        let diffusion = meta
            .and_then(recorded::diffusion_of_run_um2_per_s)
            .unwrap_or(f64::NAN);
        let folder_name = folder.file_name().unwrap_or(folder.as_os_str());
        let page = Page {
            name: folder_name.to_string_lossy().into_owned(),
            subtitle: meta.map_or_else(String::new, |meta| meta.command_line.join(" ")),
            steered: false,
            notes: false,
            script: folder.join(CYCLES_CSV).is_file(),
        };
        let mut hello = hello_of(&setup, diffusion, &page);
        hello.recorded = true;
        hello.cell = meta.is_some_and(recorded::followed_a_cell);
        let most_waiting = (HELD_S * 1e6 / hello.period_us) as usize;
        let adaptation_at = hello.adaptation_at;
        let (feed, hub) = Feed::new(hello);
        let of = session.clone();
        let server = serve(at, Arc::new(move |name| film_of(&of, name)), hub, |_| ())?;
        Ok(Self {
            server,
            watcher: Watcher::new(vec![feed])
                .with_adaptation(adaptation_at)
                .with_possible(Possible::new(&setup, diffusion)),
            follow,
            folder: folder.to_owned(),
            statistics: Statistics::default(),
            waiting: VecDeque::new(),
            most_waiting,
            last: None,
            changed: Instant::now(),
            cycles: CyclesRead::default(),
            at_rest: AtRest::default(),
            session,
            clips: (None, BTreeSet::new()),
            over: false,
        })
    }

    /// The link of a viewer, for printing.
    pub fn link(&self) -> String {
        self.server.viewer_url()
    }

    /// Shows everything written since the last call; a few calls a second are enough. Returns whether there is more to show at
    /// once.
    ///
    /// # Errors
    /// The folder cannot be read any more.
    pub fn look(&mut self) -> Result<bool, Failure> {
        self.read()?;
        let mut sent = 0;
        while sent < ROWS_AT_ONCE
            && let Some(row) = self.waiting.pop_front()
        {
            self.watcher.show(&row);
            sent += 1;
        }
        for event in self.follow.events().map_err(Failure::failed)? {
            self.count(&event);
            self.watcher.event_line(line(&event));
        }
        for row in self.cycles.more(&self.folder.join(CYCLES_CSV)) {
            self.at_rest.take(&row);
            self.watcher.cycle(cycle_row(&row, &self.at_rest));
        }
        self.look_for_clips();
        self.tell();
        Ok(!self.waiting.is_empty())
    }

    /// Takes the new rows. It counts all of a long run, and keeps those that the page can hold.
    fn read(&mut self) -> Result<(), Failure> {
        let Self {
            follow,
            watcher,
            statistics,
            waiting,
            last,
            changed,
            most_waiting,
            ..
        } = self;
        let take = |rows: &[TickRecord]| {
            *changed = Instant::now();
            for row in rows {
                watcher.count(row);
                watcher.state.stale += u64::from(row.flags.has(TickFlags::STALE));
                statistics.add(row);
                if waiting.len() == *most_waiting {
                    waiting.pop_front();
                }
                waiting.push_back(*row);
                *last = Some(*row);
            }
        };
        follow.rows(take).map_err(Failure::failed)
    }

    fn count(&mut self, event: &Event) {
        let number = |key: &str| event.data.get(key).and_then(serde_json::Value::as_u64);
        let count = number("count").unwrap_or(1) * number("times").unwrap_or(1);
        match event.event.as_str() {
            "frames-dropped" => self.watcher.state.frames_lost += count,
            "ticks-skipped" => self.watcher.state.skipped += count,
            "safe-latched" => self.watcher.safe = reason(event),
            _ => {}
        }
    }

    fn look_for_clips(&mut self) {
        let (looked, known) = &mut self.clips;
        if looked.is_some_and(|at| at.elapsed() < CLIPS_EVERY) {
            return;
        }
        *looked = Some(Instant::now());
        for clip in clips::list(&self.session) {
            if known.insert(clip.name.clone()) {
                self.watcher.clip(clip);
            }
        }
    }

    fn tell(&mut self) {
        if self.over {
            return;
        }
        let state = &mut self.watcher.state;
        state.rms_nm = self.statistics.rms_measured_nm();
        state.fix_noise_nm = self.statistics.fix_noise_um().map(|um| um * 1e3);
        let silent = self.changed.elapsed() > SILENT_AFTER;
        // The end comes after the last row, so look for it when no row comes any more.
        let end = (self.changed.elapsed() > SILENT_AFTER / 5)
            .then(|| self.follow.end())
            .flatten();
        if let Some(end) = end.filter(|_| self.waiting.is_empty()) {
            self.over = true;
            conclude(&mut self.watcher, &end);
            return;
        }
        // If a run continues, its final message is withdrawn.
        state.last_word = None;
        if silent {
            let word = last_word::of_gone(self.changed.elapsed().as_secs());
            state.banner = Banner {
                state: "disconnected",
                reason: word.seen.clone(),
            };
            state.last_word = Some(word);
        } else if let Some(last) = &self.last {
            self.watcher.state.banner = self.watcher.banner(last);
        }
        self.watcher.tails();
        self.watcher.tell_state();
    }
}

/// How much of the per-cycle table was read. A row never changes once it is written.
#[derive(Debug, Default)]
struct CyclesRead {
    head: String,
    bytes: u64,
}

impl CyclesRead {
    /// The rows after those read before; none if the table cannot be read.
    fn more(&mut self, path: &Path) -> Vec<CycleRow> {
        let length = std::fs::metadata(path).map_or(0, |meta| meta.len());
        if length <= self.bytes {
            return vec![];
        }
        let read = || -> std::io::Result<String> {
            let mut file = std::fs::File::open(path)?;
            file.seek(SeekFrom::Start(self.bytes))?;
            let mut text = vec![];
            file.take(MOST_TABLE).read_to_end(&mut text)?;
            // An incomplete line may end within a character; it is read again.
            Ok(String::from_utf8_lossy(&text).into_owned())
        };
        let Ok(text) = read() else { return vec![] };
        let whole = cellpos_record::whole_text(&text);
        self.bytes += whole.len() as u64;
        let rows = if self.head.is_empty() {
            let head = whole.lines().next().unwrap_or("");
            self.head = format!("{head}\n");
            read_cycles(whole)
        } else {
            read_cycles(&format!("{}{whole}", self.head))
        };
        rows.rows
    }
}

fn conclude(watcher: &mut Watcher, end: &RunEnd) {
    let number = |key: &str| {
        let value = end.summary.get(key)?;
        value.as_float().or(value.as_integer().map(|n| n as f64))
    };
    let count = |key: &str, counted: u64| number(key).map_or(counted, |n| n as u64);
    let state = &mut watcher.state;
    state.rms_nm = number("rms_measured_nm").or(state.rms_nm);
    state.fix_noise_nm = number("fix_noise_nm").or(state.fix_noise_nm);
    state.late = count("late", state.late);
    state.skipped = count("skipped", state.skipped);
    state.frames_lost = count("frames_lost", state.frames_lost);
    state.stale = count("stale", state.stale);
    state.coasted = count("coasted", state.coasted);
    state.records_lost = end.rows_lost;
    let tail = |name: &str| {
        let value = end.summary.get(name)?.get("p999")?;
        value.as_float().or(value.as_integer().map(|n| n as f64))
    };
    state.wake_us = tail("wake_us").or(state.wake_us);
    state.compute_us = tail("tick_us").or(state.compute_us);
    let oldest = (end.summary.get("exposure_to_command_us"))
        .and_then(|frames| frames.get("max")?.as_float());
    let used = oldest.is_some_and(|us| us > 0.0);
    let reached = number("fix_noise_nm").map(|fix_noise_nm| Reached {
        fix_noise_nm,
        loop_delay_ms: number("loop_delay_ms").filter(|_| used),
        rms_true_nm: number("rms_true_nm"),
        rms_measured_nm: number("rms_measured_nm"),
        duration_s: number("duration_s").unwrap_or(0.0),
    });
    watcher.state.bound_nm = watcher.bound_of(reached);
    watcher.over(last_word::of_record(end));
}

fn text<'e>(event: &'e Event, key: &str) -> Option<&'e str> {
    event.data.get(key).and_then(serde_json::Value::as_str)
}

fn reason(event: &Event) -> String {
    text(event, "text")
        .unwrap_or("for a reason that the record does not name")
        .to_string()
}

/// An event of the log as a line of the page: its sentence, or its name and data.
fn line(event: &Event) -> EventLine {
    let level = match text(event, "level") {
        Some("fault") => "fault",
        Some("warning") => "warning",
        _ => "info",
    };
    let words = text(event, "text").map_or_else(
        || {
            let particulars: Vec<String> = (event.data.iter())
                .map(|(key, value)| format!("{key} {value}"))
                .collect();
            format!("{} {}", event.event, particulars.join(", "))
        },
        |words| match event.event.as_str() {
            "note" => format!("Note: {words}"),
            "mark" => format!("Mark: {words}"),
            _ => words.to_string(),
        },
    );
    EventLine {
        time_s: event.time_s,
        level,
        text: words,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_script::ArmKind;
    use std::io::Write;

    #[test]
    fn a_table_that_grows_is_read_on_from_where_it_was_left() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(CYCLES_CSV);
        let mut read = CyclesRead::default();
        assert!(read.more(&path).is_empty(), "there is none yet");
        let mut file = std::fs::File::create(&path).unwrap();
        let row = |cycle| CycleRow::empty(cycle, 1, ArmKind::Static).to_csv();
        let numbers = |rows: Vec<CycleRow>| -> Vec<u64> { rows.iter().map(|r| r.cycle).collect() };
        writeln!(file, "{}\n{}", CycleRow::csv_head(), row(0)).unwrap();
        assert_eq!(numbers(read.more(&path)), [0]);
        assert!(read.more(&path).is_empty(), "none twice");
        // An incomplete row is read once it is complete.
        let (second, third) = (row(1), row(2));
        let (half, rest) = third.split_at(third.len() / 2);
        write!(file, "{second}\n{half}").unwrap();
        assert_eq!(numbers(read.more(&path)), [1]);
        writeln!(file, "{rest}").unwrap();
        assert_eq!(numbers(read.more(&path)), [2]);
    }
}
