//! What the run folder keeps of a session of a script.

use serde::{Deserialize, Serialize};

/// Settings of a session besides the loop's: the table `config.session` of run.toml.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct SessionConfig {
    /// 1 for the first, one more each time that the run was resumed.
    pub(super) number: u64,
    /// The cycle that it begins with.
    pub(super) first_cycle: u64,
    /// Whether frames are rendered.
    pub(super) frames: bool,
    /// Whether the operating system was not asked for real time.
    pub(super) best_effort: bool,
    /// Amplitude error that raises an alarm, percent.
    pub(super) alarm_percent: f64,
    /// Whether periodic motions are learned.
    #[serde(default)]
    pub(super) learn: bool,
    /// Seconds from the end of the last record of the session before to the start of this one, s.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) gap_s: Option<f64>,
    /// Folder of the session before, from the run's folder.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) after: Option<String>,
}

impl SessionConfig {
    /// From the last write of the session before to the start of this one, s.
    pub(crate) fn gap_s(&self) -> Option<f64> {
        self.gap_s
    }
}
