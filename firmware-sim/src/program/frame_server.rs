//! The camera's end of a Unix socket; the framing is that of [`cellpos_link::frames`].

use super::ProgramError;
use cellpos_link::frames::FrameHeader;
use std::io::{ErrorKind, Write};
use std::os::unix::fs::FileTypeExt;
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};

/// A client, and the rest of a frame that it has not accepted yet.
#[derive(Debug)]
struct Client {
    stream: UnixStream,
    waiting: Vec<u8>,
    sent: usize,
}

/// Sends frames to all clients without ever waiting for one.
#[derive(Debug)]
pub(super) struct FrameServer {
    listener: UnixListener,
    path: PathBuf,
    clients: Vec<Client>,
    /// Frames that a client was too slow for.
    pub skipped: u64,
}

impl FrameServer {
    /// Listens at `path`; a socket left behind there is replaced.
    ///
    /// # Errors
    /// A refusal of the operating system; an existing `path` that is not a socket.
    pub(super) fn listen(path: &Path) -> Result<Self, ProgramError> {
        let fail = |source| ProgramError::File {
            path: path.to_owned(),
            doing: "opening the camera's socket",
            source,
        };
        let left_behind = std::fs::symlink_metadata(path).is_ok_and(|m| m.file_type().is_socket());
        if left_behind {
            std::fs::remove_file(path).map_err(fail)?;
        }
        let listener = UnixListener::bind(path).map_err(fail)?;
        listener.set_nonblocking(true).map_err(fail)?;
        Ok(Self {
            listener,
            path: path.to_owned(),
            clients: Vec::new(),
            skipped: 0,
        })
    }

    /// Where it listens.
    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Accepts new clients; returns whether there are any clients.
    pub(super) fn accept(&mut self) -> bool {
        while let Ok((stream, _)) = self.listener.accept() {
            if stream.set_nonblocking(true).is_ok() {
                self.clients.push(Client {
                    stream,
                    waiting: Vec::new(),
                    sent: 0,
                });
            }
        }
        !self.clients.is_empty()
    }

    /// Sends a frame to every client that has accepted the one before; drops clients that have gone.
    pub(super) fn send(&mut self, header: &FrameHeader, pixels: &[u8]) {
        let skipped = &mut self.skipped;
        self.clients.retain_mut(|client| {
            if !client.push() {
                return false;
            }
            if client.sent < client.waiting.len() {
                *skipped += 1;
                return true;
            }
            client.waiting.clear();
            client.sent = 0;
            client.waiting.extend_from_slice(&header.to_bytes());
            client.waiting.extend_from_slice(pixels);
            client.push()
        });
    }
}

impl Client {
    /// Sends the waiting bytes as far as the socket accepts them; `false` if the client is gone.
    fn push(&mut self) -> bool {
        while let Some(rest) = self
            .waiting
            .get(self.sent..)
            .filter(|rest| !rest.is_empty())
        {
            match self.stream.write(rest) {
                Ok(0) => return false,
                Ok(count) => self.sent += count,
                Err(error) if error.kind() == ErrorKind::WouldBlock => return true,
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(_) => return false,
            }
        }
        true
    }
}

impl Drop for FrameServer {
    fn drop(&mut self) {
        // Gone already: nothing left to do.
        let _ = std::fs::remove_file(&self.path);
    }
}
