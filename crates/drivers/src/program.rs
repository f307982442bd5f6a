//! An actuator that another program serves on a Unix socket: the board's protocol (docs/board.md) on a stream.

use crate::port::{Port, Search, connected};
use std::io::{Error, ErrorKind, Read, Write};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};

/// A connection to a program that serves an actuator. If the program goes and comes back, it connects again.
#[derive(Debug)]
pub struct ProgramLine {
    path: PathBuf,
    name: String,
    stream: Option<UnixStream>,
    search: Search,
}

impl ProgramLine {
    /// Connects to the program at a socket.
    ///
    /// # Errors
    /// Nobody serves the socket.
    pub fn open(path: &Path) -> std::io::Result<Self> {
        Ok(Self {
            stream: Some(connected(path)?),
            path: path.to_path_buf(),
            name: path.display().to_string(),
            search: Search::begun(),
        })
    }

    /// The stream; if the program was gone and is back, a new one.
    fn stream(&mut self) -> std::io::Result<&mut UnixStream> {
        if self.stream.is_none() && self.search.is_due() {
            self.stream = connected(&self.path).ok();
        }
        self.stream.as_mut().ok_or_else(|| {
            Error::new(
                ErrorKind::NotConnected,
                "the program that serves the actuator has gone",
            )
        })
    }

    /// Result of a call: 0 if it would have to wait; the stream is dropped if the program is gone.
    fn judged(&mut self, result: std::io::Result<usize>) -> std::io::Result<usize> {
        match result {
            Err(error)
                if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) =>
            {
                Ok(0)
            }
            Err(error) => {
                self.stream = None;
                Err(error)
            }
            Ok(length) => Ok(length),
        }
    }
}

impl Port for ProgramLine {
    fn name(&self) -> &str {
        &self.name
    }

    fn write_some(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        let written = self.stream()?.write(bytes);
        self.judged(written)
    }

    fn read_available(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        let read = match self.stream()?.read(buffer) {
            Ok(0) if !buffer.is_empty() => Err(Error::new(
                ErrorKind::UnexpectedEof,
                "the program that serves the actuator has gone",
            )),
            other => other,
        };
        self.judged(read)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::net::UnixListener;
    use std::time::{Duration, Instant};

    #[test]
    fn bytes_cross_an_empty_line_reads_nothing_and_a_full_one_takes_nothing() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("actuator.sock");
        let listener = UnixListener::bind(&path).expect("a socket");
        let mut line = ProgramLine::open(&path).expect("served");
        let (mut far, _) = listener.accept().expect("a host");
        let mut buffer = [0; 16];
        assert_eq!(line.read_available(&mut buffer).expect("open"), 0);
        far.write_all(&[0, 1, 255]).expect("open");
        assert_eq!(line.read_available(&mut buffer).expect("open"), 3);
        assert_eq!(line.write_some(&[7, 8]).expect("open"), 2);
        far.read_exact(&mut buffer[..2]).expect("open");
        assert_eq!(buffer[..3], [7, 8, 255]);
        let begun = Instant::now();
        while line.write_some(&[1; 1024]).expect("open") > 0 {}
        assert!(begun.elapsed() < Duration::from_secs(5));
    }

    #[test]
    fn a_program_that_goes_is_an_error_until_it_is_back() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("actuator.sock");
        let listener = UnixListener::bind(&path).expect("a socket");
        let mut line = ProgramLine::open(&path).expect("served");
        drop(listener.accept().expect("a host"));
        drop(listener);
        std::fs::remove_file(&path).expect("the socket");
        let mut buffer = [0; 16];
        for _ in 0..2 {
            line.read_available(&mut buffer).expect_err("gone");
            line.write_some(&[1]).expect_err("gone");
            std::thread::sleep(Search::EVERY);
        }
        let listener = UnixListener::bind(&path).expect("a socket");
        std::thread::sleep(Search::EVERY);
        assert_eq!(line.read_available(&mut buffer).expect("back"), 0);
        let (mut far, _) = listener.accept().expect("a host");
        far.write_all(&[5]).expect("open");
        assert_eq!(line.read_available(&mut buffer).expect("open"), 1);
    }
}
