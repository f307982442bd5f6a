//! Wire protocol between the host and the PZT board: the messages, and their framing on a byte stream.
//!
//! A frame on the wire is `0x00, COBS(direction, postcard(message), CRC-32), 0x00`. The zero in front costs one byte;
//! thanks to it, garbage before a frame never destroys the frame. The direction byte distinguishes an echo from an
//! answer. Lengths and displacements travel as whole picometres: a 16-bit converter over 40 um steps by 610 pm, so
//! nothing is lost between the host's number and the code.
//!
//! The same code runs in the host's driver and on the board: no standard library, no allocation, no clock. Not for the
//! transport itself; see [`frames`] for the camera's stream of the emulated rig.
//!
//! ```
//! use cellpos_link::{Decoder, MAX_FRAME, ToBoard, encode};
//! let mut wire = [0; MAX_FRAME];
//! let length = encode(&ToBoard::Ping { token: 7 }, &mut wire).unwrap();
//! let mut decoder = Decoder::<ToBoard>::new();
//! let mut bytes = &wire[..length];
//! assert_eq!(decoder.next_message(&mut bytes), Some(ToBoard::Ping { token: 7 }));
//! assert_eq!(decoder.next_message(&mut bytes), None);
//! ```
#![no_std]
#![forbid(unsafe_code)]

#[cfg(any(test, feature = "std"))]
extern crate std;

mod codec;
pub mod frames;
mod message;
mod sequence;

pub use codec::{
    Decoder, EncodeError, MAX_FRAME, MAX_PAYLOAD, Message, encode, picometres, um_from_picometres,
};
pub use message::{
    Arm, BoardState, Command, Fault, Identity, Limits, PROTOCOL_VERSION, Refusal, Request, Status,
    ToBoard, ToHost,
};
pub use sequence::{Order, order};
