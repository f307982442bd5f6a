//! The PZT board's state machine, used unchanged by the emulated rig, by `firmware-sim` and by real firmware.
//!
//! A [`Board`] takes bytes and times, and returns bytes and the converter's code. No standard library, no allocation, no clock,
//! no floating point: displacements are whole picometres, times microseconds since the board's start.
//!
//! ```
//! use cellpos_board::{Board, Config};
//! use cellpos_link::{Arm, BoardState, MAX_FRAME, PROTOCOL_VERSION, ToBoard, encode};
//! let mut board = Board::new(Config::DEFAULT).unwrap();
//! let mut wire = [0; MAX_FRAME];
//! for message in [ToBoard::Hello { protocol: PROTOCOL_VERSION }, ToBoard::Arm(Arm::session(7))] {
//!     let length = encode(&message, &mut wire).unwrap();
//!     board.receive(&wire[..length], 100);
//! }
//! assert_eq!((board.state(), board.tick(200)), (BoardState::Armed, 32768)); // half of 0..40 um
//! ```
#![no_std]
#![forbid(unsafe_code)]

mod config;
mod machine;
mod output;
mod session;
mod transmit;

pub use config::{Config, ConfigError};
pub use machine::{Board, FIRMWARE_VERSION};
