//! A sheet for the lab book: what was proved of a rig, line by line, each with a number.
//!
//! [`board`] and [`socket`] are conformance tests of the two protocols (docs/board.md, docs/camera-socket.md): they test them byte by
//! byte, so that a foreign board or camera server passes or fails each line separately. [`camera`]
//! and [`vision`] go through the drivers of the loop and hold for any camera.

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
