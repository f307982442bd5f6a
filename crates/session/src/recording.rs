//! The sink of the recorder thread: the run folder, and the live line on the terminal.

use crate::live_line::LiveLine;
use crate::view::{EventLine, Shown};
use crate::words::{Level, sentence};
use cellpos_record::{Event as LogEvent, RunWriter};
use cellpos_runtime::recorder::Unconfirmed;
use cellpos_runtime::{Event, RunSink, Statistics, TickRecord};
use std::collections::VecDeque;
use std::io::IsTerminal;

/// Writes a run folder (if there is one) and a live line (if standard error is a terminal).
pub struct Recording {
    writer: Option<RunWriter>,
    line: Option<LiveLine>,
    late: u64,
    /// Target of the last tick, um, if the operator may set it, and whether the page must still be informed.
    steered: Option<f64>,
    told: VecDeque<EventLine>,
}

impl Recording {
    /// A recording into a folder, with a live line unless it is switched off or there is no terminal.
    pub fn new(writer: Option<RunWriter>, line: Option<LiveLine>) -> Self {
        Self {
            writer,
            line: line.filter(|_| std::io::stderr().is_terminal()),
            late: 0,
            steered: None,
            told: VecDeque::new(),
        }
    }

    /// The same for a run whose operator may set the target: each new one is an event of the record.
    #[must_use]
    pub fn steered(mut self, steered: bool) -> Self {
        self.steered = steered.then_some(f64::NAN);
        self
    }

    fn watch_target(&mut self, record: &TickRecord) {
        let Some(before_um) = self.steered.replace(record.target_um) else {
            self.steered = None;
            return;
        };
        if before_um.is_nan() || before_um == record.target_um {
            return;
        }
        let (time_s, level) = (record.time_ns as f64 * 1e-9, Level::Info.name());
        let text = format!(
            "The operator set the target to {} um.",
            (record.target_um * 1e3).round() / 1e3
        );
        if let Some(writer) = &mut self.writer {
            let event = LogEvent::new(time_s, "target-set")
                .with("tick", record.seq)
                .with("level", level)
                .with("text", text.as_str())
                .with("target_um", record.target_um);
            writer.event(&event);
        }
        self.told.push_back(EventLine {
            time_s,
            level,
            text,
        });
        // Without a page they have no receiver.
        self.told.truncate(100);
    }

    /// The run folder, if there is one.
    pub fn folder(&self) -> Option<std::path::PathBuf> {
        self.writer
            .as_ref()
            .map(|writer| writer.folder().to_owned())
    }

    /// The run folder's writer, to be finished.
    pub fn into_writer(self) -> Option<RunWriter> {
        if self.line.is_some() {
            // The last line remains above the command's output.
            cellpos_live::terminal::stderr().leave();
        }
        self.writer
    }
}

/// An event as the log takes it.
pub fn log_event(event: &Event) -> LogEvent {
    let mut data = match serde_json::to_value(event.kind) {
        Ok(serde_json::Value::Object(data)) => data,
        _ => serde_json::Map::new(),
    };
    let name = match data.remove("event") {
        Some(serde_json::Value::String(name)) => name,
        _ => "event".to_string(),
    };
    let (level, text) = sentence(&event.kind);
    let mut logged = LogEvent::new(event.time_ns as f64 * 1e-9, &name)
        .with("tick", event.seq)
        .with("level", level.name())
        .with("text", text);
    logged.data.extend(data);
    logged
}

impl Shown for Recording {
    fn next_line(&mut self) -> Option<EventLine> {
        self.told.pop_front()
    }
}

impl RunSink for Recording {
    fn tick(&mut self, record: &TickRecord) {
        if record.flags.has(cellpos_runtime::TickFlags::LATE) {
            self.late += 1;
        }
        self.watch_target(record);
        if let Some(writer) = &mut self.writer {
            writer.tick(record);
        }
    }

    fn event(&mut self, event: &Event) {
        if let Some(writer) = &mut self.writer {
            writer.event(&log_event(event));
        }
    }

    fn repeated(&mut self, last: &Event, count: u64) {
        if let Some(writer) = &mut self.writer {
            writer.event(&log_event(last).with("times", count));
        }
    }

    fn is_refused(&self) -> bool {
        self.writer.as_ref().is_some_and(RunWriter::is_failing)
    }

    fn unconfirmed(&self) -> Unconfirmed {
        let writer = self.writer.as_ref();
        writer.map_or_else(Unconfirmed::default, RunWriter::unconfirmed)
    }

    fn note(&mut self, time_ns: i64, text: &str) {
        if let Some(writer) = &mut self.writer {
            writer.event(&LogEvent::new(time_ns as f64 * 1e-9, "note").with("text", text));
        }
    }

    fn progress(&mut self, statistics: &Statistics) {
        if let Some(writer) = &mut self.writer {
            writer.poll();
        }
        if let (Some(line), Some(record)) = (&self.line, statistics.last()) {
            let text = line.text(
                record,
                statistics,
                self.late,
                cellpos_live::terminal::columns(),
            );
            cellpos_live::terminal::stderr().show(&text);
        }
    }
}
