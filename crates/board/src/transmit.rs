//! Bytes that wait for the host.

use cellpos_link::{MAX_FRAME, ToHost, encode};

const CAPACITY: usize = 2048;

/// A ring of whole frames; a frame that finds no room is dropped and counted, so that a host that does not read never
/// stops the board.
#[derive(Debug, Clone)]
pub(crate) struct TransmitBuffer {
    bytes: [u8; CAPACITY],
    first: usize,
    filled: usize,
    unsent: u32,
}

impl TransmitBuffer {
    pub(crate) const fn new() -> Self {
        Self {
            bytes: [0; CAPACITY],
            first: 0,
            filled: 0,
            unsent: 0,
        }
    }

    pub(crate) const fn unsent(&self) -> u32 {
        self.unsent
    }

    pub(crate) fn send(&mut self, message: &ToHost) {
        let mut frame = [0; MAX_FRAME];
        let frame = encode(message, &mut frame)
            .ok()
            .and_then(|length| frame.get(..length))
            .filter(|frame| frame.len() <= CAPACITY - self.filled.min(CAPACITY));
        let Some(frame) = frame else {
            self.unsent = self.unsent.saturating_add(1);
            return;
        };
        // To the end of the ring, then the rest from its beginning.
        let end = (self.first + self.filled) % CAPACITY;
        let before = CAPACITY - end;
        for (place, byte) in self.bytes.iter_mut().skip(end).zip(frame) {
            *place = *byte;
        }
        for (place, byte) in self.bytes.iter_mut().zip(frame.iter().skip(before)) {
            *place = *byte;
        }
        self.filled += frame.len();
    }

    pub(crate) fn take(&mut self, out: &mut [u8]) -> usize {
        let count = self.filled.min(out.len());
        let ring = self.bytes.iter().skip(self.first).chain(&self.bytes);
        for (to, byte) in out.iter_mut().take(count).zip(ring) {
            *to = *byte;
        }
        self.first = (self.first + count) % CAPACITY;
        self.filled -= count;
        count
    }
}
