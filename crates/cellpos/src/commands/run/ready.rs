//! Preparation of a script's run, before arming.

use cellpos_record::InputFile;
use cellpos_session::rig_file::{ClockKind, RigFile};
use cellpos_session::sessions::SessionConfig;
use cellpos_session::setup::{Prepared, ReferenceSpec};
use std::path::PathBuf;

/// A session before the board is armed.
pub(crate) struct Ready {
    pub file: RigFile,
    pub prepared: Prepared,
    pub reference: ReferenceSpec,
    pub clock: ClockKind,
    pub name: String,
    pub session: SessionConfig,
    pub inputs: Vec<InputFile>,
    /// Where the folder of a new run goes.
    pub runs: PathBuf,
    /// The run's folder, and where the session's goes; None: a new run below `runs`.
    pub home: Option<(PathBuf, PathBuf)>,
}
