//! Setpoint scripts: what the bead or cell shall do, as a TOML file with units.
//!
//! [`Script`] is the file, read with errors that name line and column. [`Plan`] is the script laid out in time: the
//! reference at any instant without allocation (a [`Plan`] is a [`cellpos_control::Reference`]), the cycles, and a [`Cursor`] that walks through it,
//! waits for conditions and ends on stop conditions. [`check()`] compares a plan with a model and limits before
//! anything moves: peak position, speed and PZT demand, and the largest amplitude that the rig could do.
//!
//! The format is described in `docs/scripts.md`. [`Follower`] makes it the guide of a loop, [`CycleTable`]
//! makes a row for each of its cycles from the loop's records. Not here: the loop, devices, files of a run.
#![forbid(unsafe_code)]

mod check;
mod cursor;
mod cycles;
mod error;
mod follow;
mod node;
mod plan;
mod read;
mod script;

pub use check::{Check, CheckError, CheckLimits, Violation, WaveCheck, check};
pub use cursor::{Cursor, Output, Seen, Status, StopReason};
pub use cycles::{
    Alarm, AmplitudeWatch, CycleColumns, CycleFlags, CycleRow, CycleTable, HeadError, ReadCycles,
    Trend, read_cycles, trend,
};
pub use error::ScriptError;
pub use follow::Follower;
pub use plan::{ArmKind, Cycle, Mark, Motion, Periodic, PeriodicReference, Plan, Segment};
pub use script::{
    Condition, Load, MoveShape, OnTimeout, Order, Script, Step, StepKind, Stop, WaveShape,
};
