//! The sessions of a run that was resumed: the run's folder first, then those below `sessions/`, in their order.

use crate::SESSIONS;
use crate::error::RecordError;
use crate::export::{Part, Source};
use crate::reader::RunReader;
use std::path::Path;

/// The sessions of a run, and the folders that cannot be read as one.
#[derive(Debug)]
pub struct Sessions {
    /// In order; the first is the run's own folder.
    pub readers: Vec<(u64, RunReader)>,
    /// Folders below `sessions/` that are not sessions, with the reason.
    pub unreadable: Vec<String>,
}

/// The number of a session in its `run.toml`; 1 for a run without sessions.
fn number(reader: &RunReader) -> Option<u64> {
    let config = &reader.meta().ok()?.config;
    match config.get("session") {
        None => Some(1),
        Some(session) => session
            .get("number")
            .and_then(toml::Value::as_integer)
            .and_then(|number| u64::try_from(number).ok()),
    }
}

/// From the end of the session before to the start of this one, ns.
fn pause_ns(reader: &RunReader) -> i64 {
    let session = reader.meta().ok().and_then(|m| m.config.get("session"));
    let gap_s = session
        .and_then(|session| session.get("gap_s"))
        .and_then(toml::Value::as_float)
        .unwrap_or(0.0);
    // A clock that was set back must not give a negative pause.
    (gap_s.max(0.0) * 1e9) as i64
}

impl Sessions {
    /// Finds the sessions of a run.
    ///
    /// # Errors
    /// [`RecordError`] if the folder itself is not a run.
    pub fn of(folder: &Path) -> Result<Self, RecordError> {
        let first = RunReader::open(folder)?;
        let mut found = Vec::new();
        let mut unreadable = Vec::new();
        let below = folder.join(SESSIONS);
        let mut folders: Vec<_> = match std::fs::read_dir(&below) {
            Ok(entries) => entries.flatten().map(|entry| entry.path()).collect(),
            Err(_) => Vec::new(),
        };
        folders.sort();
        for path in folders.into_iter().filter(|path| path.is_dir()) {
            match RunReader::open(&path) {
                Ok(reader) => match number(&reader) {
                    Some(number) => found.push((number, reader)),
                    None => unreadable.push(format!(
                        "{}: its run.toml does not say which session it is",
                        path.display()
                    )),
                },
                Err(error) => unreadable.push(error.to_string()),
            }
        }
        found.sort_by_key(|(number, _)| *number);
        let mut readers = vec![(number(&first).unwrap_or(1), first)];
        readers.extend(found);
        Ok(Self {
            readers,
            unreadable,
        })
    }

    /// The sessions as one source of rows on one time axis: each begins a pause after the last row of the session before.
    ///
    /// # Errors
    /// [`RecordError`] when a session cannot be read.
    pub fn into_source(self) -> Result<Source, RecordError> {
        let mut parts: Vec<Part> = Vec::new();
        let mut end_ns = 0;
        for (number, reader) in self.readers {
            let offset_ns = if parts.is_empty() {
                0
            } else {
                pause_ns(&reader).saturating_add(end_ns)
            };
            let last = reader.last_where(|_| true)?;
            end_ns = last.map_or(offset_ns, |row| row.time_ns.saturating_add(offset_ns));
            parts.push(Part {
                reader,
                number,
                offset_ns,
            });
        }
        Ok(Source::new(parts))
    }
}
