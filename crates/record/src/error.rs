//! What can go wrong with a run folder before or after the run.

use std::path::PathBuf;

/// A run folder that could not be made, finished, read or exported.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// A file or folder could not be made, read or written.
    #[error("{what} {}: {source}", path.display())]
    Io {
        /// What was attempted, such as `cannot create`.
        what: &'static str,
        /// The file or folder.
        path: PathBuf,
        /// Why it failed.
        source: std::io::Error,
    },
    /// The folder is no run.
    #[error(
        "{} is not a run folder (it has no {}); runs are folders such as runs/20261121T093000Z-track",
        path.display(),
        crate::TICKS_ARROW
    )]
    NotARun {
        /// The folder.
        path: PathBuf,
    },
    /// A name that cannot be part of a folder's name.
    #[error("run name `{0}`: use letters, digits, `-` and `_`, at most 64 of them")]
    Name(String),
    /// The metadata cannot be written as TOML.
    #[error("run.toml: {0}")]
    Meta(String),
    /// Arrow refused to encode.
    #[error("cannot encode {what}: {message}")]
    Encode {
        /// What was to be encoded.
        what: &'static str,
        /// Arrow's or Parquet's words.
        message: String,
    },
    /// A whole file could not be written.
    #[error(transparent)]
    Table(#[from] cellpos_table::TableError),
}

impl RecordError {
    pub(crate) fn io(
        what: &'static str,
        path: impl Into<PathBuf>,
    ) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.into();
        move |source| Self::Io { what, path, source }
    }
}
