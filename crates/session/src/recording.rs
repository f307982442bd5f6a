//! Where the recorder thread's rows go: the run folder, and the live line on the terminal.

use cellpos_record::{Event as LogEvent, RunWriter};
use cellpos_runtime::{Event, Life, RunSink, Statistics, TickRecord};
use std::io::IsTerminal;

/// Writes a run folder (if there is one) and a live line (if standard error is a terminal).
pub struct Recording {
    writer: Option<RunWriter>,
    line: Option<LiveLine>,
    late: u64,
}

/// What the live line needs to know.
pub struct LiveLine {
    /// Smallest displacement, um.
    pub low_um: f64,
    /// Largest displacement, um.
    pub high_um: f64,
}

impl Recording {
    /// A recording into a folder, with a live line unless it is unwanted or nobody would see it.
    pub fn new(writer: Option<RunWriter>, line: Option<LiveLine>) -> Self {
        Self {
            writer,
            line: line.filter(|_| std::io::stderr().is_terminal()),
            late: 0,
        }
    }

    /// The run folder's writer, to be finished.
    pub fn into_writer(self) -> Option<RunWriter> {
        if self.line.is_some() {
            // The last line stays above what the command says.
            cellpos_terminal::stderr().leave();
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
    let mut logged = LogEvent::new(event.time_ns as f64 * 1e-9, &name).with("tick", event.seq);
    logged.data.extend(data);
    logged
}

impl RunSink for Recording {
    fn tick(&mut self, record: &TickRecord) {
        if record.flags.has(cellpos_runtime::TickFlags::LATE) {
            self.late += 1;
        }
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

    fn note(&mut self, time_ns: i64, text: &str) {
        if let Some(writer) = &mut self.writer {
            writer.event(&LogEvent::new(time_ns as f64 * 1e-9, "note").with("text", text));
        }
    }

    fn progress(&mut self, statistics: &Statistics) {
        if let Some(writer) = &mut self.writer {
            writer.poll();
        }
        let (Some(line), Some(r)) = (&self.line, statistics.last()) else {
            return;
        };
        let state = Life::from_number(r.life).map_or("?", Life::name);
        let rms = statistics
            .rms_measured_nm()
            .map_or_else(|| "-".to_string(), |rms| format!("{rms:.1}nm"));
        cellpos_terminal::stderr().show(&format!(
            "{:8.2}s  target {:+.3}um  bead {:+.3}um  error {:+6.0}nm  rms {rms}  PZT {:.3}um ({:.1}um to limit)  {state}  late {}",
            r.time_ns as f64 * 1e-9,
            r.target_um,
            r.measured_um,
            (r.measured_um - r.target_um) * 1e3,
            r.command_um,
            (r.command_um - line.low_um).min(line.high_um - r.command_um),
            self.late,
        ));
    }
}
