//! A rig in use, from its file to the end of a run.
//!
//! A run goes through four types:
//!
//! 1. [`Rig`]: connected, nothing moves.
//! 2. [`Armed`]: the board waits for its first command.
//! 3. [`Running`]: the loop runs on its own threads.
//! 4. [`Finished`]: parked; it says how the run ended.
//!
//! The session arms the board last, when everything else is ready. The value that holds the board parks it on drop: at the end, on an
//! error and on a panic. Real-time rights and locked memory end with the run. A program calls [`signals::listen`] first; then Ctrl-C
//! freezes and parks.
//!
//! [`RigFile`] is rig.toml. [`setup`] joins model, controller and reference; [`recording`] makes the run folder; [`view`] serves the live
//! page. [`Ended`] and [`EndKind`] say how a run ended, [`Failure`] says why a call was refused.
//!
//! ```
//! use cellpos_runtime::{EndRule, NoSink};
//! use cellpos_session::setup::ReferenceSpec;
//! use cellpos_session::{Failure, Options, Rig, RigFile};
//!
//! # fn main() -> Result<(), Failure> {
//! // Another rig: RigFile::load(Some("rig.toml".as_ref()))? with Options::default().
//! let mut rig = Rig::open(RigFile::load(None)?, Options::rehearsal())?;
//! let prepared = rig.prepare("eq6", "pi")?;
//! let setup = rig.set_up(prepared, ReferenceSpec::Hold { position_um: 2.0 })?;
//! let end = EndRule { ticks: Some(3000), ..EndRule::default() };
//! let finished = rig.arm(&setup, setup.core()?, NoSink, end)?.start()?.wait()?;
//! assert!(finished.ended.as_asked(), "{}", finished.ended);
//! assert!(finished.summary.rms_true_nm.is_some_and(|nm| nm < 100.0));
//! # Ok(())
//! # }
//! ```
#![forbid(unsafe_code)]

pub mod adapt;
#[cfg(any(feature = "page", feature = "screen"))]
mod beside;
pub mod clips;
mod clues;
pub mod connect;
mod crop;
pub mod cyclic;
mod devices;
pub mod ended;
pub mod exciting;
mod failure;
mod fit;
mod frames_seen;
pub mod live_line;
mod prepared;
pub mod provenance;
pub mod quantities;
mod real_time;
pub mod recorded;
pub mod recording;
mod rig;
pub mod rig_file;
mod running;
pub mod say;
pub mod screen;
pub mod sessions;
pub mod setup;
pub mod signals;
pub mod toml_file;
pub mod view;
mod witness;
pub mod words;

pub use devices::Options;
pub use ended::{EndKind, Ended};
pub use failure::Failure;
pub use fit::OF_BOARD;
pub use frames_seen::{FrameAge, FramesSeen};
pub use rig::{Armed, Finished, NotArmed, Rig, Running};
pub use rig_file::RigFile;

/// The Rust examples of the book, compiled and run as tests.
#[cfg(doctest)]
#[doc = include_str!("../../../docs/embed.md")]
#[doc = include_str!("../../../docs/extend.md")]
struct Book;
