//! The 1 kHz loop: threads, rings, pacing, deadline account, safe states.
//!
//! [`Core`] is one tick as a pure function: it knows neither clock nor device. [`live`] runs it on threads, [`virtual_run`] on
//! a simulated clock, [`replay`] on a record; all three give the same bits for the same inputs. A tick never waits,
//! allocates, locks, formats or logs. A full ring refuses, and the refusal is counted.
//!
//! - [`Core`] steps once per tick, from [`TickInput`] to [`TickOutput`]; [`Timing`] has its limits.
//! - [`RunSink`] receives a [`TickRecord`] per tick, an [`Event`] per incident, and the [`Summary`] at the end.
//! - [`Life`], [`Request`] and [`SafeReason`]: states of a run, the operator's wishes, and why it went Safe.
//! - [`ReferenceGenerator`]: where the bead shall be. [`EndRule`]: when the run is over.
//! - [`realtime`] asks for priority and locked memory; [`latency`] measures wake-ups.
//!
//! Ticks follow the clock's grid, whatever the frames do:
//!
//! ```
//! use cellpos_runtime::Grid;
//! let grid = Grid::new(0, 1_000_000);
//! assert_eq!(grid.index(4_200_000), 4, "4.2 ms after the first tick at 1 kHz");
//! ```
//!
//! Not here: devices (`cellpos-rig` has their traits), files of a run (`cellpos-record`), set-up (`cellpos-session`).
#![forbid(unsafe_code)]

pub mod arming;
mod board_watch;
pub mod core;
mod frames;
mod grid;
mod keeping;
pub mod latency;
mod learners;
pub mod life;
pub mod live;
mod operator;
mod pacer;
pub mod realtime;
pub mod recorder;
mod recording;
pub mod reference;
mod reference_history;
pub mod replay;
pub mod run;
pub mod summary;
mod threads;
mod tick;
mod tick_record;
pub mod ticker;
mod timing;
pub mod virtual_run;

pub use crate::core::{Action, Core, CoreError, TickInput, TickOutput, Timing};
pub use arming::ArmingConfig;
pub use board_watch::BoardTrouble;
pub use cellpos_control::LAW_COLUMNS;
pub use frames::FrameTally;
pub use grid::Grid;
pub use keeping::{Hold, Kept, NotKept};
pub use learners::Learners;
pub use life::{Event, EventKind, Life, Request, SafeReason};
pub use recorder::{RecorderFault, RecorderReport};
pub use reference::{ReferenceGenerator, ReferenceInput, ReferenceOutput, Stage, Steered};
pub use reference_history::ReferenceHistory;
pub use run::{EndRule, Finished, NoSink, RunError, RunSink};
pub use summary::{End, EndState, Statistics, Summary};
pub use tick::Heard;
pub use tick_record::{TickCounts, TickFlags, TickRecord};
