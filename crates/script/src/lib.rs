//! Setpoint scripts: the motion of the bead or cell, as a TOML file with units.
//!
//! A [`Script`] is the file; errors of reading name line and column. A [`Plan`] is the script laid out in time. It gives the cycles, and
//! the reference at any instant without allocation (it is a [`cellpos_control::Reference`]). A [`Cursor`] steps through the plan, waits
//! for conditions and ends on stop conditions. Before anything moves, [`check()`] compares a plan with a model and limits: peak position,
//! speed and PZT demand, and the largest possible amplitude.
//!
//! The format is described in `docs/scripts.md`. A [`Follower`] makes it the reference generator of a loop. A [`CycleTable`] makes a row
//! for each cycle from the loop's records. Not here: the loop, devices, files of a run.
//!
//! ```
//! use cellpos_script::{Plan, Script};
//! let text = "name = \"step\"\nstart = \"0um\"\n\n[[step]]\ndo = \"hold\"\nduration = \"1s\"\n";
//! let script = Script::parse(text, "step.toml")?;
//! let plan = Plan::new(&script)?;
//! assert_eq!(plan.total_s(), 1.0);
//! let wrong = Script::parse(&text.replace("1s", "1"), "step.toml").unwrap_err().to_string();
//! assert!(wrong.contains("step.toml:6"), "file and line: {wrong}");
//! # Ok::<(), cellpos_script::ScriptError>(())
//! ```
#![forbid(unsafe_code)]

mod check;
mod cursor;
mod cycles;
mod error;
mod follow;
mod node;
mod plan;
mod read;
mod sample;
mod script;
mod shuffle;
mod table;

pub use check::{Check, CheckError, CheckLimits, LimitUse, Violation, WaveCheck, check};
pub use cursor::{Cursor, Output, Progress, Seen, StopReason};
pub use cycles::{
    Alarm, AmplitudeWatch, AtRest, CycleColumns, CycleFlags, CycleRow, CycleTable, FatigueStop,
    FatigueWatch, HeadError, Mean, ReadCycles, Saturating, Trend, half95, read_cycles, trend,
};
pub use error::ScriptError;
pub use follow::Follower;
pub use plan::{ArmKind, Cycle, Mark, Motion, Periodic, PeriodicReference, Plan, Segment};
pub use read::MOST_BYTES;
pub use sample::Sample;
pub use script::{
    ClipWishes, Condition, Load, MoveShape, OnTimeout, Order, Script, Step, StepKind, Stop,
    WaveShape,
};
