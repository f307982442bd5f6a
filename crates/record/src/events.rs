//! The event log: one JSON object a line.

use crate::error::RecordError;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// One line of `events.jsonl`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Event {
    /// Time since the start of the run, s.
    pub time_s: f64,
    /// The event in one or two words joined by `-`: `bead-lost`, `safe`, `disk-error`.
    pub event: String,
    /// Particulars; names of numbers carry their unit.
    #[serde(default, skip_serializing_if = "serde_json::Map::is_empty")]
    pub data: serde_json::Map<String, serde_json::Value>,
}

impl Event {
    /// An event without particulars.
    pub fn new(time_s: f64, event: &str) -> Self {
        Self {
            time_s,
            event: event.to_owned(),
            data: serde_json::Map::new(),
        }
    }

    /// Adds a particular.
    #[must_use]
    pub fn with(mut self, key: &str, value: impl Into<serde_json::Value>) -> Self {
        self.data.insert(key.to_owned(), value.into());
        self
    }

    /// The event as one line, with the line end.
    pub(crate) fn line(&self) -> Result<String, serde_json::Error> {
        let mut line = serde_json::to_string(self)?;
        line.push('\n');
        Ok(line)
    }
}

/// What a log holds.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Events {
    /// The events, in the order written.
    pub events: Vec<Event>,
    /// Invalid lines: cut off or damaged.
    pub unreadable_lines: usize,
}

/// Reads an event log as far as it is readable. A missing log counts as empty.
///
/// # Errors
/// [`RecordError::Io`] when the file exists and cannot be read.
pub fn read_events(path: &Path) -> Result<Events, RecordError> {
    let bytes = match std::fs::read(path) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(Events::default()),
        other => other.map_err(RecordError::io("cannot read", path))?,
    };
    let mut events = Events::default();
    for line in bytes.split(|byte| *byte == b'\n') {
        if line.iter().all(u8::is_ascii_whitespace) {
            continue;
        }
        match serde_json::from_slice(line) {
            Ok(event) => events.events.push(event),
            Err(_) => events.unreadable_lines += 1,
        }
    }
    Ok(events)
}
