//! The page of a run that is read in its folder: one that goes on in another process, or one that is over.

use super::watcher::Watcher;
use super::{CycleRow, EventLine, Page, ViewAddress, hello_of};
use crate::failure::Failure;
use crate::recorded;
use cellpos_live::{Banner, Feed, Server, ServerConfig};
use cellpos_record::{CYCLES_CSV, Event, Follow, RunEnd, Sessions};
use cellpos_runtime::{Statistics, TickRecord};
use cellpos_script::read_cycles;
use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Rows handed to the page at once: half of what its ring holds.
const ROWS_AT_ONCE: usize = 4096;
/// Time of a run that the page holds, s.
const HELD_S: f64 = 600.0;
/// A run without an end to which nothing was added for this long has lost its program, or its disk.
const SILENT_AFTER: Duration = Duration::from_secs(5);
/// Longest table of cycles that is read.
const MOST_TABLE: u64 = 1 << 30;

/// A page that shows a run folder. Nothing is asked of the program that writes it, and nothing can be asked through the page.
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
    cycles: (u64, usize),
    over: bool,
}

impl Watch {
    /// Serves the page of the newest session of a run.
    ///
    /// # Errors
    /// No run, one whose `run.toml` cannot be used, or an address that cannot be listened on.
    pub fn open(folder: &Path, at: ViewAddress) -> Result<Self, Failure> {
        let sessions = Sessions::of(folder).map_err(Failure::input)?;
        let newest = sessions.readers.last().map_or(folder, |(_, r)| r.folder());
        let follow = Follow::open(newest).map_err(Failure::input)?;
        let setup = recorded::setup(follow.reader())?;
        let meta = follow.reader().meta().ok();
        let diffusion = meta
            .and_then(recorded::diffusion_um2_per_s)
            .unwrap_or(f64::NAN);
        let folder_name = folder.file_name().unwrap_or(folder.as_os_str());
        let page = Page {
            name: folder_name.to_string_lossy().into_owned(),
            subtitle: meta.map_or_else(String::new, |meta| meta.command_line.join(" ")),
            steered: false,
            script: folder.join(CYCLES_CSV).is_file(),
        };
        let mut hello = hello_of(&setup, diffusion, &page);
        hello.recorded = true;
        let most_waiting = (HELD_S * 1e6 / hello.period_us) as usize;
        let (feed, hub) = Feed::new(hello);
        let config = ServerConfig {
            address: at.address,
            beyond_this_machine: at.beyond_this_machine,
            on_thread: None,
        };
        let server = Server::start(&config, hub, |_| ())
            .map_err(|error| Failure::bad_input(error, "127.0.0.1:0 takes any free port"))?;
        Ok(Self {
            server,
            watcher: Watcher::new(feed),
            follow,
            folder: folder.to_owned(),
            statistics: Statistics::default(),
            waiting: VecDeque::new(),
            most_waiting,
            last: None,
            changed: Instant::now(),
            cycles: (0, 0),
            over: false,
        })
    }

    /// The link, to be printed: it may look.
    pub fn link(&self) -> String {
        self.server.viewer_url()
    }

    /// Shows what was written since the last look; a few times a second is enough. Says whether there is more to show at once.
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
            self.watcher.feed.event(line(&event));
        }
        self.read_cycles();
        self.tell();
        Ok(!self.waiting.is_empty())
    }

    /// Takes the new rows; of a long run those that the page can hold are kept, and all are counted.
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

    /// Rows of the per-cycle table that are new. A row never changes once it is written.
    fn read_cycles(&mut self) {
        let path = self.folder.join(CYCLES_CSV);
        let Ok(bytes) = std::fs::metadata(&path).map(|meta| meta.len()) else {
            return;
        };
        if bytes == self.cycles.0 {
            return;
        }
        let Ok(text) = cellpos_table::read_text(&path, MOST_TABLE) else {
            return;
        };
        let known = |value: f64| value.is_finite().then_some(value);
        let rows = read_cycles(cellpos_record::whole_text(&text)).rows;
        for row in rows.iter().skip(self.cycles.1) {
            self.watcher.feed.cycle(CycleRow {
                cycle: row.cycle + 1,
                amplitude_um: known(row.reached_um),
                stretch: known(row.length_peak_um / row.length_start_um),
                recovery_s: known(row.recovery_s),
            });
        }
        self.cycles = (bytes, rows.len());
    }

    fn tell(&mut self) {
        if self.over {
            return;
        }
        let state = &mut self.watcher.state;
        state.rms_nm = self.statistics.rms_measured_nm();
        let silent = self.changed.elapsed() > SILENT_AFTER;
        // The end is written behind the last row: it is looked for when none comes any more.
        let end = (self.changed.elapsed() > SILENT_AFTER / 5)
            .then(|| self.follow.end())
            .flatten();
        if let Some(end) = end.filter(|_| self.waiting.is_empty()) {
            self.over = true;
            conclude(&mut self.watcher, &end);
        } else if silent {
            state.banner = Banner {
                state: "disconnected",
                reason: format!(
                    "Nothing was written for {} s, and the run has no end: the program is gone, or its disk is. What is shown is \
                     old.",
                    self.changed.elapsed().as_secs()
                ),
            };
        } else if let Some(last) = &self.last {
            self.watcher.state.banner = self.watcher.banner(last);
        }
        let state = self.watcher.state.clone();
        self.watcher.feed.state(state);
    }
}

fn conclude(watcher: &mut Watcher, end: &RunEnd) {
    let number = |key: &str| {
        let value = end.summary.get(key)?;
        value.as_float().or(value.as_integer().map(|n| n as f64))
    };
    let count = |key: &str, counted: u64| number(key).map_or(counted, |n| n as u64);
    let state = &mut watcher.state;
    state.banner = Banner {
        state: if end.outcome == "safe" {
            "safe"
        } else {
            "over"
        },
        reason: format!("The run is over: {}.", end.outcome),
    };
    state.rms_nm = number("rms_measured_nm").or(state.rms_nm);
    state.late = count("late", state.late);
    state.skipped = count("skipped", state.skipped);
    state.frames_lost = count("frames_lost", state.frames_lost);
    state.stale = count("stale", state.stale);
    state.coasted = count("coasted", state.coasted);
    state.records_lost = end.rows_lost;
}

fn text<'e>(event: &'e Event, key: &str) -> Option<&'e str> {
    event.data.get(key).and_then(serde_json::Value::as_str)
}

fn reason(event: &Event) -> String {
    text(event, "text")
        .unwrap_or("for a reason that the record does not name")
        .to_string()
}

/// An event of the log as a line of the page: its sentence, or its name and what it says of itself.
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
