//! Work at the bench, before the loop is closed: check a rig file against its devices, test the board's line, move the PZT by
//! hand, take pictures and recordings, find the settings of vision, calibrate.
//!
//! Each task opens the devices of a rig file without a tracker ([`Bench`]) and leaves the board parked. Closed loops are in
//! `cellpos-session`.
#![forbid(unsafe_code)]

pub mod beads;
mod bench;
pub mod calibrate;
pub mod capture;
pub mod check;
mod connected;
mod finding;
pub mod line_test;
pub mod mover;
pub mod partner;
pub mod prove;
pub mod sight;
pub mod snapshot;
pub mod template;
mod watch;

pub use bench::Bench;
