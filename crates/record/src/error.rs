//! Errors of a run folder before or after the run.

use std::path::PathBuf;

/// A run folder that could not be made, finished, read or exported.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// A file or folder could not be made, read or written.
    #[error("{what} {}: {source}", path.display())]
    Io {
        /// The failed operation, such as `cannot create`.
        what: &'static str,
        /// The file or folder.
        path: PathBuf,
        /// Why it failed.
        source: std::io::Error,
    },
    /// The folder is not a run.
    #[error(
        "{} is not a run folder (it has no {}); runs are folders such as runs/20261121T093000Z-track",
        path.display(),
        crate::TICKS_ARROW
    )]
    NotARun {
        /// The folder.
        path: PathBuf,
    },
    /// Not enough room for the run.
    #[error(
        "{}: the run needs up to {} and the disk has {} left: make room, or write elsewhere with --runs",
        path.display(),
        size(*needed),
        size(*free)
    )]
    NoSpace {
        /// The folder of the run.
        path: PathBuf,
        /// Bytes that the run may need.
        needed: u64,
        /// Bytes that are left.
        free: u64,
    },
    /// A column that an export does not have.
    #[error("there is no column `{name}`; the columns are {}", known.join(", "))]
    Column {
        /// The name asked for.
        name: String,
        /// The columns that there are.
        known: Vec<String>,
    },
    /// A column that is requested twice.
    #[error("the column `{0}` is asked for twice")]
    Twice(String),
    /// An export without a row.
    #[error(
        "nothing of the run is in that time: its first row is at {first_s} s, its last at {last_s} s"
    )]
    Nothing {
        /// Time of the run's first row.
        first_s: f64,
        /// Time of its last.
        last_s: f64,
    },
    /// A run of a later version.
    #[error(
        "{} is of format {found}; this version of cellpos reads formats up to {}: use the version that wrote it, or a later one",
        path.display(),
        crate::FORMAT
    )]
    Newer {
        /// The metadata file.
        path: PathBuf,
        /// Its format.
        found: u32,
    },
    /// A name that cannot be part of a folder's name.
    #[error("run name `{0}`: use letters, digits, `-` and `_`, at most 64 of them")]
    Name(String),
    /// A column of a control law that a run cannot have.
    #[error(
        "the control law's column `{0}`: its name is one that every run has, or it is one more than a row holds"
    )]
    LawColumn(String),
    /// The metadata cannot be written as TOML.
    #[error("run.toml: {0}")]
    Meta(String),
    /// Arrow refused to encode.
    #[error("cannot encode {what}: {message}")]
    Encode {
        /// The data to encode.
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

/// A number of bytes as people read it.
fn size(bytes: u64) -> String {
    let (number, unit) = match bytes {
        0..1_000_000 => (bytes as f64 / 1e3, "kB"),
        1_000_000..1_000_000_000 => (bytes as f64 / 1e6, "MB"),
        _ => (bytes as f64 / 1e9, "GB"),
    };
    format!("{number:.1} {unit}")
}
