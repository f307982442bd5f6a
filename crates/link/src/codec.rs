//! Framing: messages to bytes and back.

use core::marker::PhantomData;
use crc::{CRC_32_ISO_HDLC, Crc};
use serde::{Serialize, de::DeserializeOwned};

use crate::{ToBoard, ToHost};

/// Most bytes of a message between direction byte and check sum (the longest has 75).
pub const MAX_PAYLOAD: usize = 96;
const CRC_LEN: usize = 4;
const MAX_BODY: usize = 1 + MAX_PAYLOAD + CRC_LEN;
const MAX_ENCODED: usize = cobs::max_encoding_length(MAX_BODY);
/// Most bytes of a frame on the wire, both delimiters included.
pub const MAX_FRAME: usize = MAX_ENCODED + 2;

const DELIMITER: u8 = 0;
/// One table of 256 entries: a board can spare a kilobyte, and the look-up needs no bounds check.
static CRC: Crc<u32> = Crc::<u32>::new(&CRC_32_ISO_HDLC);

mod sealed {
    pub trait Sealed {}
    impl Sealed for crate::ToBoard {}
    impl Sealed for crate::ToHost {}
}

/// One direction of the wire: [`ToBoard`] or [`ToHost`].
pub trait Message: Serialize + DeserializeOwned + sealed::Sealed {
    /// First byte of every frame in this direction.
    const DIRECTION: u8;
}

impl Message for ToBoard {
    const DIRECTION: u8 = 0xb1;
}

impl Message for ToHost {
    const DIRECTION: u8 = 0x4e;
}

/// Why a message was not encoded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum EncodeError {
    /// The output is shorter than the frame; [`MAX_FRAME`] bytes always suffice.
    OutputTooShort,
    /// The message is longer than [`MAX_PAYLOAD`]. No message of this version is.
    MessageTooLong,
}

impl core::fmt::Display for EncodeError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::OutputTooShort => {
                write!(
                    f,
                    "the output is too short for the frame: give {MAX_FRAME} bytes"
                )
            }
            Self::MessageTooLong => write!(f, "the message is longer than {MAX_PAYLOAD} bytes"),
        }
    }
}

impl core::error::Error for EncodeError {}

/// Writes `message` as one frame to the start of `out`; returns its length in bytes, at most [`MAX_FRAME`].
///
/// # Errors
/// [`EncodeError::OutputTooShort`]; nothing of `out` may be sent then.
pub fn encode<M: Message>(message: &M, out: &mut [u8]) -> Result<usize, EncodeError> {
    // Avoid indexing that can fail: the firmware with this code must have no panic path.
    let mut body = [0_u8; MAX_BODY];
    let (direction, payload) = body.split_first_mut().ok_or(EncodeError::MessageTooLong)?;
    *direction = M::DIRECTION;
    let payload = payload
        .first_chunk_mut::<MAX_PAYLOAD>()
        .and_then(|room| postcard::to_slice(message, room).ok())
        .ok_or(EncodeError::MessageTooLong)?
        .len();
    let (checked, check) = body
        .split_at_mut_checked(1 + payload)
        .ok_or(EncodeError::MessageTooLong)?;
    *check
        .first_chunk_mut::<CRC_LEN>()
        .ok_or(EncodeError::MessageTooLong)? = CRC.checksum(checked).to_le_bytes();
    let body = body
        .get(..1 + payload + CRC_LEN)
        .ok_or(EncodeError::MessageTooLong)?;
    let (first, rest) = out.split_first_mut().ok_or(EncodeError::OutputTooShort)?;
    *first = DELIMITER;
    let encoded = cobs::try_encode(body, rest).map_err(|_| EncodeError::OutputTooShort)?;
    *rest.get_mut(encoded).ok_or(EncodeError::OutputTooShort)? = DELIMITER;
    Ok(encoded + 2)
}

/// Takes bytes in pieces of any size, and yields the messages of one direction.
///
/// Drops and counts a frame that is too long, not COBS, fails the CRC, has the other direction's byte or is not a message.
/// Decoding continues at the next delimiter. Never panics, never allocates, holds at most one frame.
#[derive(Debug, Clone)]
pub struct Decoder<M> {
    buffer: [u8; MAX_ENCODED],
    filled: usize,
    overlong: bool,
    bad_frames: u32,
    message: PhantomData<M>,
}

impl<M: Message> Default for Decoder<M> {
    fn default() -> Self {
        Self::new()
    }
}

impl<M: Message> Decoder<M> {
    /// An empty decoder.
    pub const fn new() -> Self {
        Self {
            buffer: [0; MAX_ENCODED],
            filled: 0,
            overlong: false,
            bad_frames: 0,
            message: PhantomData,
        }
    }

    /// Frames dropped since the decoder was made.
    pub fn bad_frames(&self) -> u32 {
        self.bad_frames
    }

    /// Takes bytes off the front of `bytes` until a message is complete; `None` when all are used up.
    pub fn next_message(&mut self, bytes: &mut &[u8]) -> Option<M> {
        while !bytes.is_empty() {
            // Up to the next delimiter in one go.
            let until = bytes.iter().position(|&byte| byte == DELIMITER);
            let (body, rest) = bytes.split_at_checked(until.unwrap_or(bytes.len()))?;
            self.keep(body);
            *bytes = rest;
            if let Some((_, rest)) = rest.split_first() {
                *bytes = rest;
                if let Some(message) = self.end_of_frame() {
                    return Some(message);
                }
            }
        }
        None
    }

    /// Takes bytes none of which is a delimiter.
    fn keep(&mut self, bytes: &[u8]) {
        let room = self.buffer.get_mut(self.filled..).unwrap_or_default();
        for (place, byte) in room.iter_mut().zip(bytes) {
            *place = *byte;
        }
        self.overlong |= bytes.len() > room.len();
        self.filled += bytes.len().min(room.len());
    }

    /// Takes one byte; yields a message if it completes one.
    pub fn push(&mut self, byte: u8) -> Option<M> {
        if byte != DELIMITER {
            self.keep(&[byte]);
            return None;
        }
        self.end_of_frame()
    }

    fn end_of_frame(&mut self) -> Option<M> {
        let length = core::mem::take(&mut self.filled);
        let overlong = core::mem::take(&mut self.overlong);
        if length == 0 {
            return None; // between the closing zero of one frame and the opening zero of the next
        }
        let message = if overlong {
            None
        } else {
            self.buffer.get(..length).and_then(open::<M>)
        };
        if message.is_none() {
            self.bad_frames = self.bad_frames.saturating_add(1);
        }
        message
    }
}

/// The message in the bytes between two delimiters, if every check passes.
fn open<M: Message>(encoded: &[u8]) -> Option<M> {
    let mut body = [0_u8; MAX_ENCODED];
    let length = cobs::decode(encoded, &mut body).ok()?.frame_size();
    let body = body.get(..length)?;
    let (checked, crc) = body.split_last_chunk::<CRC_LEN>()?;
    if CRC.checksum(checked) != u32::from_le_bytes(*crc) {
        return None;
    }
    let (&direction, payload) = checked.split_first()?;
    if direction != M::DIRECTION {
        return None;
    }
    match postcard::take_from_bytes(payload) {
        Ok((message, [])) => Some(message),
        _ => None,
    }
}

/// The displacement `um` as whole picometres, rounded to nearest; the ends of `i32` (2147 um) for values beyond them, and `None`
/// for NaN.
pub fn picometres(um: f64) -> Option<i32> {
    if um.is_nan() {
        return None;
    }
    let scaled = um * 1e6;
    // `as` rounds towards zero and clips to the ends; adding half away from zero makes it round to nearest.
    Some((scaled + if scaled < 0.0 { -0.5 } else { 0.5 }) as i32)
}

/// Picometres as micrometres.
pub fn um_from_picometres(pm: i32) -> f64 {
    f64::from(pm) / 1e6
}
