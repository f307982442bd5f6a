//! The sessions of a script's run: the first one, and one more in the run's folder each time that it was resumed.

use cellpos_record::{RunReader, SESSIONS};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Settings of a session besides the loop's: the table `config.session` of run.toml.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SessionConfig {
    /// 1 for the first, one more each time that the run was resumed.
    pub number: u64,
    /// The cycle that it begins with.
    pub first_cycle: u64,
    /// Whether frames are rendered.
    pub frames: bool,
    /// Whether the operating system was not asked for real time.
    pub best_effort: bool,
    /// Amplitude error that raises an alarm, percent.
    pub alarm_percent: f64,
    /// Whether periodic motions are learned.
    #[serde(default)]
    pub learn: bool,
    /// Seconds from the end of the last record of the session before to the start of this one, s.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub gap_s: Option<f64>,
    /// Folder of the session before, from the run's folder.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub after: Option<String>,
}

/// The folders of a run's sessions, in order.
pub fn of(folder: &Path) -> Vec<PathBuf> {
    let mut found: Vec<(u64, PathBuf)> = vec![(1, folder.to_owned())];
    let further = std::fs::read_dir(folder.join(SESSIONS))
        .into_iter()
        .flatten()
        .flatten()
        .map(|entry| entry.path());
    for path in further {
        if let Ok(reader) = RunReader::open(&path)
            && let Some(config) = session_config(&reader)
        {
            found.push((config.number, path));
        }
    }
    found.sort();
    found.into_iter().map(|(_, path)| path).collect()
}

/// A session as described by its run.toml; `None` in a run that is not one of a script.
pub fn session_config(reader: &RunReader) -> Option<SessionConfig> {
    let config = reader.meta().ok()?.config.get("session")?.clone();
    config.try_into().ok()
}
