//! A test sheet of a rig for the lab book; each line has a number.
//!
//! [`board`] and [`socket`] are conformance tests of the two protocols (docs/board.md, docs/camera-socket.md). They test byte by byte, so
//! that a foreign board or camera server passes or fails each line separately. [`camera`] and [`vision`] go through the drivers of the
//! loop and hold for any camera.

pub mod board;
mod camera;
mod moves;
mod reset;
mod sheet;
mod silence;
pub mod socket;
mod talk;
mod trial;

pub use camera::{camera, vision};
pub use sheet::{Line, Sheet, Verdict};
pub use talk::Talk;
