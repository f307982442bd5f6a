//! Bytes waiting to be collected for the host.

use cellpos_link::{MAX_FRAME, ToHost, encode};

const CAPACITY: usize = 2048;

/// Holds whole frames; a frame that finds no room is dropped and counted, so that a host that does not read never
/// stops the board.
#[derive(Debug, Clone)]
pub(super) struct TransmitBuffer {
    bytes: [u8; CAPACITY],
    filled: usize,
    unsent: u32,
}

impl TransmitBuffer {
    pub(super) fn new() -> Self {
        Self {
            bytes: [0; CAPACITY],
            filled: 0,
            unsent: 0,
        }
    }

    pub(super) fn unsent(&self) -> u32 {
        self.unsent
    }

    pub(super) fn send(&mut self, message: &ToHost) {
        let mut frame = [0; MAX_FRAME];
        let sent = encode(message, &mut frame)
            .ok()
            .and_then(|length| frame.get(..length))
            .and_then(|frame| {
                let place = self.bytes.get_mut(self.filled..self.filled + frame.len())?;
                place.copy_from_slice(frame);
                Some(frame.len())
            });
        match sent {
            Some(length) => self.filled += length,
            None => self.unsent = self.unsent.saturating_add(1),
        }
    }

    pub(super) fn take(&mut self, out: &mut [u8]) -> usize {
        let count = self.filled.min(out.len());
        if let (Some(to), Some(from)) = (out.get_mut(..count), self.bytes.get(..count)) {
            to.copy_from_slice(from);
        }
        self.bytes.copy_within(count..self.filled, 0);
        self.filled -= count;
        count
    }
}
