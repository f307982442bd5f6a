//! Records of PZT command and bead position as CSV, checked on the way in.
//!
//! Identification and reconciliation work on a [`Record`]: a sampling step, the commanded PZT displacement and the bead
//! position. Its file has the columns `time_s,pzt_um,bead_um` (more columns are allowed). Row k holds the displacement
//! commanded from `time_s` on, held until the next row, and the position just **before** that command takes effect. An
//! empty `bead_um` is a frame without a bead.
//!
//! Reading refuses data that would silently give a wrong result: columns in another unit, values that are not finite,
//! time that does not grow, irregular sampling. Every refusal names file, line and column, and what would be right. A
//! [`Mapping`] reads foreign data (no header, other names, volts).
//!
//! This crate holds no run folder and no Arrow or Parquet (see `cellpos-record`), so that crates that only read
//! numbers stay light.
//!
//! ```
//! use cellpos_table::{Mapping, Record};
//! let text = "time_s,pzt_um,bead_um\n0.000,4.0,0.01\n0.001,4.5,\n0.002,4.5,0.22\n";
//! let record = Record::parse("example.csv".as_ref(), text, &Mapping::default()).unwrap();
//! assert!((record.step_s - 0.001).abs() < 1e-12);
//! assert_eq!(record.pzt_um, [4.0, 4.5, 4.5]);
//! assert!(record.bead_um[1].is_nan(), "no bead in that frame");
//! ```
#![forbid(unsafe_code)]

mod error;
mod field;
mod file;
mod mapping;
mod record;
mod sampling;
mod table;

pub use error::{TableError, TableProblem};
pub use field::csv_field;
pub use file::{MOST_OF_A_RECORD, read_bytes, read_text, write_atomically, write_unsynced};
pub use mapping::{ColumnRef, Gaps, Mapping};
pub use record::Record;
pub use table::Table;
