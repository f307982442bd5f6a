//! Tasks at the bench before the loop is closed, and the [`experiment`]s on a rig. A task at the bench opens the devices of a rig file
//! without a tracker ([`Bench`]), and parks the board at its end.
//!
//! - [`template`] writes a commented rig file, [`check`] compares one with itself and with its devices.
//! - [`line_test`] measures the line to the board; [`mover`] moves the PZT by hand.
//! - [`snapshot`] takes a picture, [`capture`] records frames, [`sight`] measures the noise of a position.
//! - [`beads`] finds the settings of vision for the beads, [`calibrate`] axis, sign and scale; [`partner`] writes the slow actuator.
//! - [`foreign`] makes a base model of records of other rigs.
//! - [`run_report`] writes the pages of recorded runs.
//! - [`prove`] tests board, camera and vision line by line, [`doctor`] the machine.
//!
//! Closed loops are in `cellpos-session`.
//!
//! ```
//! use cellpos_session::RigFile;
//! use cellpos_workbench::check::findings;
//! // The emulated rig fits together. A camera that delivers after a frame is too old does not.
//! let mut file = RigFile::default();
//! assert!(findings(&file, "rig.toml".as_ref()).is_empty());
//! file.timing.oldest_ms = 0.5;
//! assert!(findings(&file, "rig.toml".as_ref()).iter().any(|finding| finding.key == "timing.oldest_ms"));
//! ```
#![forbid(unsafe_code)]

pub mod beads;
mod bench;
pub mod calibrate;
pub mod capture;
pub mod check;
mod connected;
pub mod doctor;
pub mod experiment;
mod finding;
pub mod foreign;
pub mod line_test;
pub mod mover;
pub mod partner;
pub mod prove;
mod rig_text;
pub mod run_report;
pub mod sight;
pub mod snapshot;
pub mod template;
mod watch;

pub use bench::Bench;
