//! Work at the bench, before the loop is closed: what a rig file says and what is there, the board's line, moves by hand,
//! pictures, recordings, settings of vision, calibration.
//!
//! All of it opens the devices of a rig file without a tracker ([`Bench`]) and leaves the board parked. Not for closed loops:
//! those are `cellpos-session`'s.
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
pub mod prove;
pub mod sight;
pub mod snapshot;
pub mod template;
mod watch;

pub use bench::Bench;
