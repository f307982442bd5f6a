//! The line to the board.

use rustix::net::{AddressFamily, SocketAddrUnix, SocketFlags, SocketType, connect, socket_with};
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::time::{Duration, Instant};

/// A byte port that never blocks for long.
pub trait Port: Send {
    /// Name, for messages.
    fn name(&self) -> &str;
    /// Writes as many bytes as the line accepts now, and returns their number, which may be 0.
    ///
    /// # Errors
    /// The line is gone; a later call may find it again.
    fn write_some(&mut self, bytes: &[u8]) -> std::io::Result<usize>;
    /// Reads the bytes that have arrived, at most `buffer.len()`; 0 if there are none.
    ///
    /// # Errors
    /// The line is gone; a later call may find it again.
    fn read_available(&mut self, buffer: &mut [u8]) -> std::io::Result<usize>;
}

impl<P: Port + ?Sized> Port for Box<P> {
    fn name(&self) -> &str {
        (**self).name()
    }

    fn write_some(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        (**self).write_some(bytes)
    }

    fn read_available(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        (**self).read_available(buffer)
    }
}

/// When a lost peer is looked for again: at a pace. A peer that ends each connection then keeps no processor busy, and opening a USB
/// port, which takes milliseconds, is rare.
#[derive(Debug)]
pub(crate) struct Search {
    last: Instant,
}

impl Search {
    pub(crate) const EVERY: Duration = Duration::from_millis(20);

    /// The peer was there just now, or was just looked for.
    pub(crate) fn begun() -> Self {
        Self {
            last: Instant::now(),
        }
    }

    /// Time until the peer may be looked for again.
    pub(crate) fn left(&self) -> Duration {
        Self::EVERY.saturating_sub(self.last.elapsed())
    }

    /// Whether it is time to look for the peer, which the caller then does.
    pub(crate) fn is_due(&mut self) -> bool {
        let is_due = self.left().is_zero();
        if is_due {
            *self = Self::begun();
        }
        is_due
    }
}

/// A connection to a program's socket, made at once or not at all: a program that takes no connection, and has others waiting, must not
/// keep the loop. Nothing that is done with the stream blocks.
///
/// # Errors
/// Nobody serves the socket, or its program takes no connection now.
pub(crate) fn connected(path: &Path) -> std::io::Result<UnixStream> {
    let flags = SocketFlags::NONBLOCK | SocketFlags::CLOEXEC;
    let socket = socket_with(AddressFamily::UNIX, SocketType::STREAM, flags, None)?;
    connect(&socket, &SocketAddrUnix::new(path)?)?;
    Ok(UnixStream::from(socket))
}

#[cfg(test)]
mod tests {
    use super::*;
    use rustix::net::{bind, listen};
    use std::io::ErrorKind;

    #[test]
    fn a_program_that_takes_no_connection_is_not_waited_for() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("busy.sock");
        let flags = SocketFlags::CLOEXEC;
        let busy = socket_with(AddressFamily::UNIX, SocketType::STREAM, flags, None);
        let busy = busy.expect("a socket");
        bind(&busy, &SocketAddrUnix::new(&path).expect("short")).expect("bound");
        listen(&busy, 1).expect("listening");
        let (waiting, refused): (Vec<_>, Vec<_>) =
            (0..5).map(|_| connected(&path)).partition(Result::is_ok);
        assert!(!waiting.is_empty() && !refused.is_empty());
        for error in refused.into_iter().filter_map(Result::err) {
            assert_eq!(error.kind(), ErrorKind::WouldBlock, "{error}");
        }
    }
}
