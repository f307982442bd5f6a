//! Camera frames on a stream socket: the format in which the emulated rig sends frames to a host.
//!
//! Each frame is a header of [`HEADER_LEN`] bytes and `payload_len` bytes of pixels. Rows are contiguous. A pixel is one byte up
//! to 8 bits, else two in little-endian order. All numbers of the header are little-endian:
//!
//! | offset | bytes | content |
//! |---|---|---|
//! | 0 | 4 | magic `CPFR` |
//! | 4 | 2 | version, 1 |
//! | 6 | 2 | length of the header, 64 |
//! | 8 | 8 | frame id, rising by one per exposed frame; a gap means lost frames |
//! | 16 | 8 | middle of the exposure, ns on `CLOCK_MONOTONIC` |
//! | 24 | 8 | hand-over to the socket, ns on `CLOCK_MONOTONIC` |
//! | 32 | 4 | exposure time, ns |
//! | 36 | 2 | width, px |
//! | 38 | 2 | height, px |
//! | 40 | 2 | bits per pixel, 8..=16 |
//! | 42 | 2 | 0 |
//! | 44 | 4 | length of the pixels in bytes |
//! | 48 | 12 | 0 |
//! | 60 | 4 | CRC-32 (ISO HDLC) of bytes 0..60 |
//!
//! A client may connect, disconnect and connect again; it starts with the next whole frame. A client that reads too slowly loses
//! whole frames, never parts of one. Not a camera protocol: real cameras have their own.

use crc::{CRC_32_ISO_HDLC, Crc, Table};

/// Length of the header in bytes.
pub const HEADER_LEN: usize = 64;
/// Most bytes of pixels accepted (a 4096 x 4096 frame of 16 bits).
pub const MAX_PIXEL_BYTES: usize = 32 << 20;
const MAGIC: [u8; 4] = *b"CPFR";
const VERSION: u16 = 1;
static CRC: Crc<u32, Table<16>> = Crc::<u32, Table<16>>::new(&CRC_32_ISO_HDLC);

/// Data of a frame besides its pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FrameHeader {
    /// Rises by one per exposed frame.
    pub frame_id: u64,
    /// Middle of the exposure, ns on `CLOCK_MONOTONIC`.
    pub mid_exposure_ns: u64,
    /// Hand-over to the socket, ns on `CLOCK_MONOTONIC`.
    pub sent_ns: u64,
    /// Exposure time, ns.
    pub exposure_ns: u32,
    /// Pixels per row.
    pub width: u16,
    /// Rows.
    pub height: u16,
    /// Bits per pixel, 8..=16.
    pub bits: u16,
}

/// The reason why a header was refused. The stream is out of step: connect again.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum HeaderError {
    /// The first bytes are not the magic.
    Magic {
        /// What came instead.
        received: [u8; 4],
    },
    /// Another version of the framing.
    Version {
        /// The sender's.
        received: u16,
    },
    /// The check sum does not fit.
    BadChecksum {
        /// Computed over the header.
        expected: u32,
        /// As sent.
        received: u32,
    },
    /// Size, depth and payload length contradict each other or are too large.
    Geometry,
}

impl core::fmt::Display for HeaderError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Magic { received } => write!(
                f,
                "the stream does not start with a frame (CPFR) but with {received:02x?}"
            ),
            Self::Version { received } => {
                write!(
                    f,
                    "frames of version {received}, this program reads {VERSION}"
                )
            }
            Self::BadChecksum { expected, received } => write!(
                f,
                "frame header with check sum {received:08x}, its content gives {expected:08x}"
            ),
            Self::Geometry => write!(
                f,
                "frame header whose width, height, bits and length of pixels contradict each other"
            ),
        }
    }
}

impl core::error::Error for HeaderError {}

impl FrameHeader {
    /// Length of the pixels in bytes.
    pub fn pixel_bytes(&self) -> usize {
        let per_pixel = if self.bits > 8 { 2 } else { 1 };
        usize::from(self.width) * usize::from(self.height) * per_pixel
    }

    /// The header in its form on the socket.
    pub fn to_bytes(&self) -> [u8; HEADER_LEN] {
        let mut bytes = [0; HEADER_LEN];
        bytes[0..4].copy_from_slice(&MAGIC);
        bytes[4..6].copy_from_slice(&VERSION.to_le_bytes());
        bytes[6..8].copy_from_slice(&(HEADER_LEN as u16).to_le_bytes());
        bytes[8..16].copy_from_slice(&self.frame_id.to_le_bytes());
        bytes[16..24].copy_from_slice(&self.mid_exposure_ns.to_le_bytes());
        bytes[24..32].copy_from_slice(&self.sent_ns.to_le_bytes());
        bytes[32..36].copy_from_slice(&self.exposure_ns.to_le_bytes());
        bytes[36..38].copy_from_slice(&self.width.to_le_bytes());
        bytes[38..40].copy_from_slice(&self.height.to_le_bytes());
        bytes[40..42].copy_from_slice(&self.bits.to_le_bytes());
        bytes[44..48].copy_from_slice(&(self.pixel_bytes() as u32).to_le_bytes());
        let crc = CRC.checksum(&bytes[..60]);
        bytes[60..64].copy_from_slice(&crc.to_le_bytes());
        bytes
    }

    /// Reads and checks a header.
    ///
    /// # Errors
    /// [`HeaderError`], when the bytes are not a header of this version.
    pub fn from_bytes(bytes: &[u8; HEADER_LEN]) -> Result<Self, HeaderError> {
        let received: [u8; 4] = take(bytes, 0);
        if received != MAGIC {
            return Err(HeaderError::Magic { received });
        }
        let received = u16::from_le_bytes(take(bytes, 4));
        if received != VERSION {
            return Err(HeaderError::Version { received });
        }
        let (expected, received) = (
            CRC.checksum(&bytes[..60]),
            u32::from_le_bytes(take(bytes, 60)),
        );
        if expected != received {
            return Err(HeaderError::BadChecksum { expected, received });
        }
        let header = Self {
            frame_id: u64::from_le_bytes(take(bytes, 8)),
            mid_exposure_ns: u64::from_le_bytes(take(bytes, 16)),
            sent_ns: u64::from_le_bytes(take(bytes, 24)),
            exposure_ns: u32::from_le_bytes(take(bytes, 32)),
            width: u16::from_le_bytes(take(bytes, 36)),
            height: u16::from_le_bytes(take(bytes, 38)),
            bits: u16::from_le_bytes(take(bytes, 40)),
        };
        let length = u32::from_le_bytes(take(bytes, 44)) as usize;
        if !(8..=16).contains(&header.bits)
            || length != header.pixel_bytes()
            || length == 0
            || length > MAX_PIXEL_BYTES
        {
            return Err(HeaderError::Geometry);
        }
        Ok(header)
    }
}

fn take<const N: usize>(bytes: &[u8; HEADER_LEN], offset: usize) -> [u8; N] {
    core::array::from_fn(|i| bytes.get(offset + i).copied().unwrap_or(0))
}

/// Gathers frames from the pieces in which a stream delivers them.
///
/// The buffer for the pixels grows to the first frame's size and is then reused.
#[cfg(feature = "std")]
#[derive(Debug)]
pub struct FrameGatherer {
    head: [u8; HEADER_LEN],
    head_filled: usize,
    header: Option<FrameHeader>,
    pixels: std::vec::Vec<u8>,
}

#[cfg(feature = "std")]
impl Default for FrameGatherer {
    fn default() -> Self {
        Self::new()
    }
}

#[cfg(feature = "std")]
impl FrameGatherer {
    /// A gatherer for a stream that starts with a header.
    pub fn new() -> Self {
        Self {
            head: [0; HEADER_LEN],
            head_filled: 0,
            header: None,
            pixels: std::vec::Vec::new(),
        }
    }

    /// Takes bytes off the front of `bytes` until a frame is complete; its pixels stay valid until the next call.
    ///
    /// # Errors
    /// [`HeaderError`]; the stream is out of step: connect again with a new gatherer.
    pub fn next_frame(
        &mut self,
        bytes: &mut &[u8],
    ) -> Result<Option<(FrameHeader, &[u8])>, HeaderError> {
        if self.header.is_none() {
            let wanted = HEADER_LEN - self.head_filled;
            let (piece, rest) = bytes.split_at(wanted.min(bytes.len()));
            self.head[self.head_filled..self.head_filled + piece.len()].copy_from_slice(piece);
            self.head_filled += piece.len();
            *bytes = rest;
            if self.head_filled < HEADER_LEN {
                return Ok(None);
            }
            self.header = Some(FrameHeader::from_bytes(&self.head)?);
            self.pixels.clear();
        }
        let Some(header) = self.header else {
            return Ok(None);
        };
        let wanted = header.pixel_bytes() - self.pixels.len();
        let (piece, rest) = bytes.split_at(wanted.min(bytes.len()));
        self.pixels.extend_from_slice(piece);
        *bytes = rest;
        if piece.len() < wanted {
            return Ok(None);
        }
        self.header = None;
        self.head_filled = 0;
        Ok(Some((header, &self.pixels)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEADER: FrameHeader = FrameHeader {
        frame_id: 77,
        mid_exposure_ns: 123_456_789_012,
        sent_ns: 123_458_789_012,
        exposure_ns: 500_000,
        width: 6,
        height: 2,
        bits: 8,
    };

    #[test]
    fn a_header_reads_back_as_it_was_written() {
        assert_eq!(FrameHeader::from_bytes(&HEADER.to_bytes()), Ok(HEADER));
    }

    #[test]
    fn the_header_on_the_page_is_this_one() {
        let page = include_str!("../../../docs/camera-socket.md");
        let (_, after) = page.split_once("has the header\n\n```text\n").unwrap();
        let (hex, _) = after.split_once("```").unwrap();
        let mut digits = hex.chars().filter_map(|digit| digit.to_digit(16));
        for byte in HEADER.to_bytes() {
            let [high, low] = [digits.next(), digits.next()].map(|digit| digit.expect("a digit"));
            assert_eq!(u32::from(byte), 16 * high + low);
        }
        assert_eq!(digits.next(), None);
    }

    #[test]
    fn every_flipped_bit_of_a_header_is_noticed() {
        for bit in 0..HEADER_LEN * 8 {
            let mut bytes = HEADER.to_bytes();
            bytes[bit / 8] ^= 1 << (bit % 8);
            assert!(FrameHeader::from_bytes(&bytes).is_err(), "bit {bit}");
        }
    }

    #[test]
    fn a_header_whose_pixels_do_not_fit_its_size_is_refused() {
        let mut bytes = HEADER.to_bytes();
        bytes[44] += 1;
        let crc = CRC.checksum(&bytes[..60]);
        bytes[60..64].copy_from_slice(&crc.to_le_bytes());
        assert_eq!(FrameHeader::from_bytes(&bytes), Err(HeaderError::Geometry));
    }

    #[cfg(feature = "std")]
    #[test]
    fn frames_are_gathered_from_pieces_of_any_size() {
        let mut stream = std::vec::Vec::new();
        for id in 0..5_u64 {
            stream.extend_from_slice(
                &FrameHeader {
                    frame_id: id,
                    ..HEADER
                }
                .to_bytes(),
            );
            stream.extend((0..12).map(|i| (id * 12 + i) as u8));
        }
        for size in 1..stream.len() {
            let mut gatherer = FrameGatherer::new();
            let mut seen = 0;
            for piece in stream.chunks(size) {
                let mut bytes = piece;
                while let Some((header, pixels)) = gatherer.next_frame(&mut bytes).unwrap() {
                    assert_eq!(header.frame_id, seen);
                    assert_eq!(pixels.len(), 12);
                    assert_eq!(u64::from(pixels[0]), seen * 12);
                    seen += 1;
                }
            }
            assert_eq!(seen, 5, "pieces of {size}");
        }
    }

    #[cfg(feature = "std")]
    #[test]
    fn a_stream_out_of_step_is_an_error_that_names_what_came() {
        let mut gatherer = FrameGatherer::new();
        let garbage = [b'x'; HEADER_LEN];
        assert_eq!(
            gatherer.next_frame(&mut &garbage[..]).unwrap_err(),
            HeaderError::Magic { received: *b"xxxx" }
        );
    }
}
