//! Run folders: append-only columns during a run, readable after any failure, exported to other formats.
//!
//! A run is a folder `runs/<UTC time>-<name>/` that is never overwritten:
//!
//! | file | what | when |
//! |---|---|---|
//! | `run.toml` | command line, configuration, model, controller, versions, conditions, seed, SHA-256 of inputs; the outcome | at the start, replaced in one step at the end |
//! | `ticks.arrow` | one row a tick ([`cellpos_runtime::TickRecord`]), an Arrow IPC stream | appended, synced at least each second |
//! | `events.jsonl` | one JSON object a line | with the ticks, after them |
//! | `ticks.parquet` | the same rows for other programs | at the end, with the feature `parquet` |
//! | `cycles.csv` | of a script: one row a cycle ([`LineFile`]) | appended, synced at least each second |
//! | `cycles.parquet` | the same | at the end |
//! | `learned.toml` | of a script: the feed-forward learned over its cycles | replaced in one step each second |
//! | `sessions/` | of a run that was resumed: a run folder for each further session | |
//!
//! **While running** a [`RunWriter`] belongs to the recorder thread. It may allocate and block on the disk, so a tick never calls it. If
//! the disk refuses rows, they wait in memory for another try. Rows that never reach the disk are counted ([`Faults`]). A truncated batch
//! is removed, so the run remains readable.
//!
//! **Afterwards** a [`RunReader`] reads a truncated run up to its last complete batch, and a damaged one around the damage. It
//! never panics on a damaged file, and it reports the missing rows ([`Lost`]).
//!
//! Plain CSV records (`time_s,pzt_um,bead_um`) are read and written by `cellpos-table`, which needs neither Arrow nor
//! Parquet; [`RunReader::to_record`] makes one from a run.
//!
//! Not for data that a tick waits for. There is no locking: one writer per folder.
//!
//! ```
//! use cellpos_record::{Event, RunEnd, RunMeta, RunReader, RunWriter};
//! # let root = tempfile::tempdir()?;
//! # let root = root.path();
//! let mut run = RunWriter::create(root, RunMeta::new("hold", "virtual"))?;
//! run.event(&Event::new(0.5, "bead-lost"));
//! let finished = run.finish(RunEnd::new("done")); // `run.tick` takes the ticks
//! let reader = RunReader::open(&finished.folder)?;
//! assert_eq!(reader.meta().map(|meta| meta.name.as_str()), Ok("hold"));
//! assert_eq!(reader.events()?.events[0].event, "bead-lost");
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
#![forbid(unsafe_code)]

mod blocks;
mod columns;
mod ending;
mod error;
mod events;
pub mod export;
mod faults;
mod follow;
mod lines;
mod meta;
mod reader;
mod sessions;
pub mod space;
mod stream;
mod synced;
mod writer;

pub use columns::Group;
pub use error::RecordError;
pub use events::{Event, Events, read_events};
pub use export::{Exported, Format, Part, Selection, Source, csv_head, export, write_csv};
#[cfg(feature = "parquet")]
pub use export::{TableColumn, write_parquet, write_table_parquet};
pub use faults::Faults;
pub use follow::Follow;
pub use lines::{LineFile, whole_text};
pub use meta::{InputFile, RunEnd, RunMeta, number_at};
pub use reader::{Batches, Gap, Lost, RunReader};
pub use sessions::Sessions;
pub use writer::{Finished, FlushPolicy, RunWriter, check_name};

/// Version of the layout of a run folder. 1: rows without a check. 2: rows with a check, only the columns that the run
/// needs, no state of the controller.
pub const FORMAT: u32 = 2;

/// Name of the metadata file in a run folder.
pub const RUN_TOML: &str = "run.toml";
/// Name of the append-only columns in a run folder.
pub const TICKS_ARROW: &str = "ticks.arrow";
/// Name of the file of columns of a finished run.
pub const TICKS_PARQUET: &str = "ticks.parquet";
/// Name of the per-cycle table in a run folder.
pub const CYCLES_CSV: &str = "cycles.csv";
/// Name of the per-cycle table of a finished run.
pub const CYCLES_PARQUET: &str = "cycles.parquet";
/// Name of the folder of further sessions in the folder of a run that was resumed.
pub const SESSIONS: &str = "sessions";
/// Name of the event log in a run folder.
pub const EVENTS_JSONL: &str = "events.jsonl";
