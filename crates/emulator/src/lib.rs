//! The physical world behind the emulated rig: PZT, chip, bead and rendered camera frames.
//!
//! [`World`] is driven by the displacement that stands at the board's output and by time, and yields what a camera
//! would deliver, when it would deliver it: frames of 8 bits with a ring-profile bead, or a cell in its channel, blurred
//! along the true path during the exposure, with shot and read noise; or positions with the equivalent noise, for runs that need no pictures. Beside
//! them it knows the truth. Faults are injected from a schedule ([`Faults`]).
//!
//! A seed fixes every bit of what comes out. Not for the PZT board, which is firmware of its own, and not for real time:
//! the world has no clock but the times it is given.
#![forbid(unsafe_code)]

mod camera;
mod cell;
mod cell_picture;
mod config;
mod faults;
mod random;
mod render;
mod world;

pub use camera::{FrameInfo, PositionFix};
pub use cell::CellConfig;
pub use config::{WorldConfig, WorldError};
pub use faults::{FaultEvent, FaultKind, Faults};
pub use random::Gaussian;
pub use world::World;
