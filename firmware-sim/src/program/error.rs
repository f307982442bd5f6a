//! What stops the program.

use cellpos_emulator::BoxError;
use std::io;
use std::path::PathBuf;

/// The reason why the box does not run.
#[derive(Debug, thiserror::Error)]
pub(crate) enum ProgramError {
    /// A file that cannot be used.
    #[error("{path}: {doing}: {source}")]
    File {
        /// Which.
        path: PathBuf,
        /// What was being done.
        doing: &'static str,
        /// Error of the operating system.
        source: io::Error,
    },
    /// A rig file that cannot be parsed.
    #[error("{path}: {problem}")]
    RigFile {
        /// Which.
        path: PathBuf,
        /// What is wrong, with line and column.
        problem: String,
    },
    /// A model that cannot be parsed.
    #[error("{0}")]
    Model(String),
    /// Values that cannot be.
    #[error(transparent)]
    Box(#[from] BoxError),
    /// The operating system refused something.
    #[error("{doing}: {source}")]
    System {
        /// What was being done.
        doing: &'static str,
        /// Error of the operating system.
        source: io::Error,
    },
}

impl ProgramError {
    /// 2 for wrong input, 1 for everything else.
    pub(crate) fn exit_code(&self) -> u8 {
        match self {
            Self::RigFile { .. } | Self::Model(_) | Self::Box(_) => 2,
            Self::File { .. } | Self::System { .. } => 1,
        }
    }

    /// For [`Result::map_err`] on a call to the operating system.
    pub(crate) fn system<E: Into<io::Error>>(doing: &'static str) -> impl FnOnce(E) -> Self {
        move |source| Self::System {
            doing,
            source: source.into(),
        }
    }
}
