//! The board's end of a pseudo-terminal.

use super::ProgramError;
use rustix::fs::{OFlags, fcntl_getfl, fcntl_setfl};
use rustix::io::Errno;
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{
    Action, OptionalActions, QueueSelector, ioctl_tiocnxcl, tcflow, tcflush, tcgetattr, tcsetattr,
};
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::path::{Path, PathBuf};

/// A pseudo-terminal in raw mode. The host opens [`Line::path`] like a serial port, as often as it likes.
#[derive(Debug)]
pub(super) struct Line {
    board_end: OwnedFd,
    /// Held open, so that the line does not change when a host goes away.
    host_end: OwnedFd,
    path: PathBuf,
    link: Option<PathBuf>,
}

impl Line {
    /// Opens a new pseudo-terminal; with `link`, a symbolic link to it that goes away with the line.
    ///
    /// # Errors
    /// A refusal of the operating system; a `link` that exists and is not a symbolic link.
    pub(super) fn open(link: Option<&Path>) -> Result<Self, ProgramError> {
        let opening = "opening a pseudo-terminal";
        let flags = OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC;
        let board_end = openpt(flags).map_err(ProgramError::system(opening))?;
        grantpt(&board_end).map_err(ProgramError::system(opening))?;
        unlockpt(&board_end).map_err(ProgramError::system(opening))?;
        let name = ptsname(&board_end, Vec::new()).map_err(ProgramError::system(opening))?;
        let path = PathBuf::from(name.to_string_lossy().into_owned());
        let host_end = rustix::fs::open(
            &path,
            OFlags::RDWR | OFlags::NOCTTY | OFlags::CLOEXEC,
            rustix::fs::Mode::empty(),
        )
        .map_err(ProgramError::system(opening))?;
        let mut settings = tcgetattr(&host_end).map_err(ProgramError::system(opening))?;
        settings.make_raw();
        tcsetattr(&host_end, OptionalActions::Now, &settings)
            .map_err(ProgramError::system(opening))?;
        let flags = fcntl_getfl(&board_end).map_err(ProgramError::system(opening))?;
        fcntl_setfl(&board_end, flags | OFlags::NONBLOCK).map_err(ProgramError::system(opening))?;
        let mut line = Self {
            board_end,
            host_end,
            path,
            link: None,
        };
        if let Some(link) = link {
            let fail = |source| ProgramError::File {
                path: link.to_owned(),
                doing: "linking to the pseudo-terminal",
                source,
            };
            if link.is_symlink() {
                std::fs::remove_file(link).map_err(fail)?;
            }
            std::os::unix::fs::symlink(&line.path, link).map_err(fail)?;
            line.link = Some(link.to_owned());
        }
        Ok(line)
    }

    /// What the host opens.
    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Becomes readable when the host has written.
    pub(super) fn readiness(&self) -> BorrowedFd<'_> {
        self.board_end.as_fd()
    }

    /// Reads the host's bytes; 0 without any.
    ///
    /// # Errors
    /// A refusal of the operating system.
    pub(super) fn read(&self, buffer: &mut [u8]) -> Result<usize, ProgramError> {
        match rustix::io::read(&self.board_end, buffer) {
            Ok(count) => Ok(count),
            Err(Errno::AGAIN | Errno::INTR | Errno::IO) => Ok(0),
            Err(error) => Err(ProgramError::system("reading from the pseudo-terminal")(
                error,
            )),
        }
    }

    /// Writes to the host. If nobody reads, it discards the old bytes, so that the next host gets new ones.
    ///
    /// # Errors
    /// A refusal of the operating system.
    pub(super) fn write(&self, bytes: &[u8]) -> Result<(), ProgramError> {
        match rustix::io::write(&self.board_end, bytes) {
            Ok(count) if count == bytes.len() => Ok(()),
            Ok(_) | Err(Errno::AGAIN) => tcflush(&self.host_end, QueueSelector::IFlush)
                .map_err(ProgramError::system("clearing the pseudo-terminal")),
            Err(Errno::INTR | Errno::IO) => Ok(()),
            Err(error) => Err(ProgramError::system("writing to the pseudo-terminal")(
                error,
            )),
        }
    }

    /// Stops or resumes input from the host, like a USB line whose device does not answer.
    ///
    /// # Errors
    /// A refusal of the operating system.
    pub(super) fn stall(&self, stalled: bool) -> Result<(), ProgramError> {
        let action = if stalled { Action::OOff } else { Action::OOn };
        tcflow(&self.host_end, action).map_err(ProgramError::system("stopping the pseudo-terminal"))
    }

    /// Lifts the lock of exclusive use that a killed host leaves behind, so that the next one can open the line.
    pub(super) fn unlock(&self) {
        // Fails only when the terminal is gone, which reading reports.
        let _ = ioctl_tiocnxcl(&self.host_end);
    }
}

impl Drop for Line {
    fn drop(&mut self) {
        if let Some(link) = &self.link {
            // Gone already: nothing left to do.
            let _ = std::fs::remove_file(link);
        }
    }
}
