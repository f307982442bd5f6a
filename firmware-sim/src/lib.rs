//! The PZT board's firmware as a library, and a whole rig in a box as a program.
#![forbid(unsafe_code)]

pub mod board;

pub use board::{Board, BoardConfig, BoardConfigError};
