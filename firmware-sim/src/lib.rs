//! The PZT board's firmware as a library, and a whole rig in a box as a program.
//!
//! [`Board`] is the firmware: bytes and times in, bytes and a displacement out. [`RigInABox`] joins it to the emulated
//! world of `cellpos-emulator`. The program `firmware-sim` runs such a box in real time behind a pseudo-terminal (the board)
//! and a Unix socket (the camera).
#![forbid(unsafe_code)]

pub mod board;
mod rig_in_a_box;

pub use board::{Board, BoardConfig, BoardConfigError};
pub use rig_in_a_box::{BoxError, RigInABox};
