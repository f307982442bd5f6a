//! Frames on their way to the board, over a line that may accept nothing or only a part of a frame.

use crate::port::Port;
use cellpos_link::MAX_FRAME;

/// Kind of a frame: a newer command replaces a command, but nothing replaces an order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Kind {
    /// A set point: only the newest is of use.
    Command,
    /// Anything else: to arm, freeze, park, answer.
    Order,
}

#[derive(Debug, Clone, Copy)]
struct Frame {
    bytes: [u8; MAX_FRAME],
    length: usize,
    written: usize,
    kind: Kind,
}

/// The frame that is being written, and the one that follows it.
///
/// A frame that was begun is always completed before the next, so that the board never reads two halves as one frame. A
/// command of which nothing was written is replaced by a newer one.
#[derive(Debug, Default)]
pub(crate) struct Outbox {
    begun: Option<Frame>,
    next: Option<Frame>,
    /// Commands that were never written as a whole.
    not_taken: u64,
}

impl Outbox {
    pub(crate) fn not_taken(&self) -> u64 {
        self.not_taken
    }

    /// Whether nothing waits.
    pub(crate) fn is_empty(&self) -> bool {
        self.begun.is_none() && self.next.is_none()
    }

    /// Queues a frame after the one that was begun, and replaces one that was not begun. A command does not replace an order.
    pub(crate) fn put(&mut self, bytes: &[u8; MAX_FRAME], length: usize, kind: Kind) {
        let frame = Frame {
            bytes: *bytes,
            length,
            written: 0,
            kind,
        };
        // No byte is on the line yet: it may still be replaced.
        if self.next.is_none() {
            self.next = self.begun.take_if(|begun| begun.written == 0);
        }
        match &self.next {
            Some(waits) if waits.kind == Kind::Order && kind == Kind::Command => {
                self.not_taken += 1;
            }
            waits => {
                self.not_taken += u64::from(waits.is_some_and(|w| w.kind == Kind::Command));
                self.next = Some(frame);
            }
        }
    }

    /// Writes as much as the line accepts now; returns whether nothing is left.
    ///
    /// # Errors
    /// The line is gone. A truncated frame is lost if it is a command, and written again from its beginning if it is an order.
    /// Every frame begins with a delimiter, which ends the part that the board may have.
    pub(crate) fn push(&mut self, port: &mut (impl Port + ?Sized)) -> std::io::Result<bool> {
        loop {
            let Some(frame) = &mut self.begun else {
                match self.next.take() {
                    Some(next) => self.begun = Some(next),
                    None => return Ok(true),
                }
                continue;
            };
            let rest = frame.bytes.get(frame.written..frame.length).unwrap_or(&[]);
            match port.write_some(rest) {
                Ok(taken) => frame.written += taken.min(rest.len()),
                Err(error) => {
                    frame.written = 0;
                    if frame.kind == Kind::Command {
                        self.begun = None;
                        self.not_taken += 1;
                    }
                    return Err(error);
                }
            }
            if frame.written < frame.length {
                return Ok(false);
            }
            self.begun = None;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::{Error, ErrorKind, Result};

    /// Takes these numbers of bytes, one per call; `None` is a line that is gone.
    struct Stingy {
        takes: Vec<Option<usize>>,
        got: Vec<u8>,
    }

    impl Port for Stingy {
        fn name(&self) -> &str {
            "stingy"
        }
        fn write_some(&mut self, bytes: &[u8]) -> Result<usize> {
            let takes = if self.takes.is_empty() {
                Some(usize::MAX)
            } else {
                self.takes.remove(0)
            };
            let takes = takes.ok_or(Error::from(ErrorKind::BrokenPipe))?;
            let taken = takes.min(bytes.len());
            self.got.extend_from_slice(&bytes[..taken]);
            Ok(taken)
        }
        fn read_available(&mut self, _: &mut [u8]) -> Result<usize> {
            Ok(0)
        }
    }

    fn stingy(takes: &[Option<usize>]) -> Stingy {
        Stingy {
            takes: takes.to_vec(),
            got: Vec::new(),
        }
    }

    fn put(outbox: &mut Outbox, text: &str, kind: Kind) {
        let mut bytes = [0; MAX_FRAME];
        bytes[..text.len()].copy_from_slice(text.as_bytes());
        outbox.put(&bytes, text.len(), kind);
    }

    #[test]
    fn a_frame_that_was_begun_is_completed_and_only_the_newest_command_follows_it() {
        let mut line = stingy(&[Some(2), Some(0), Some(1), Some(0)]);
        let mut outbox = Outbox::default();
        for command in ["|aaa|", "|bbb|", "|ccc|", "|ddd|"] {
            put(&mut outbox, command, Kind::Command);
            let _ = outbox.push(&mut line).expect("open");
        }
        while !outbox.push(&mut line).expect("open") {}
        assert_eq!(String::from_utf8_lossy(&line.got), "|aaa||ddd|");
        assert_eq!(outbox.not_taken(), 2);
    }

    #[test]
    fn an_order_takes_the_place_of_a_command_and_keeps_it() {
        let mut line = stingy(&[Some(0)]);
        let mut outbox = Outbox::default();
        put(&mut outbox, "|aaa|", Kind::Command);
        assert!(!outbox.push(&mut line).expect("open"));
        put(&mut outbox, "|park|", Kind::Order);
        put(&mut outbox, "|bbb|", Kind::Command);
        assert!(outbox.push(&mut line).expect("open"));
        assert_eq!(String::from_utf8_lossy(&line.got), "|park|");
        assert_eq!(outbox.not_taken(), 2);
    }

    #[test]
    fn after_a_line_that_was_gone_an_order_is_written_as_a_whole_and_a_command_is_lost() {
        let mut line = stingy(&[Some(3), None, Some(3), None]);
        let mut outbox = Outbox::default();
        put(&mut outbox, "|aaa|", Kind::Command);
        assert!(!outbox.push(&mut line).expect("open"));
        assert!(outbox.push(&mut line).is_err());
        assert_eq!((outbox.not_taken(), outbox.is_empty()), (1, true));
        put(&mut outbox, "|park|", Kind::Order);
        assert!(!outbox.push(&mut line).expect("open"));
        assert!(outbox.push(&mut line).is_err());
        assert!(outbox.push(&mut line).expect("open"));
        assert_eq!(String::from_utf8_lossy(&line.got), "|aa|pa|park|");
    }
}
