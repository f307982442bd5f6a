//! The PZT board on a serial port (a real one, a USB adapter, or a pseudo-terminal).

use crate::port::{Port, Search};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{FlockOperation, Mode, OFlags, flock};
use rustix::io::Errno;
use rustix::termios::{
    ControlModes, InputModes, OptionalActions, QueueSelector, ioctl_tiocexcl, tcflush, tcgetattr,
    tcsetattr,
};
use std::io::{Error, ErrorKind};
use std::os::fd::OwnedFd;
use std::path::Path;

/// Longest wait for a line that accepts nothing, ns: half a period of the loop. So answers that arrive meanwhile are still read
/// in the period of their command.
const WAIT_NS: i64 = 500_000;

/// An open serial port. If it is unplugged and comes back, it opens again.
#[derive(Debug)]
pub struct SerialLine {
    port: Option<OwnedFd>,
    name: String,
    baud: u32,
    search: Search,
}

impl SerialLine {
    /// Opens a port for this process alone. A pseudo-terminal takes any baud rate.
    ///
    /// # Errors
    /// The port does not exist, is in use, or is not a serial port.
    pub fn open(path: &str, baud: u32) -> std::io::Result<Self> {
        Ok(Self {
            port: Some(open(path, baud)?),
            name: path.to_string(),
            baud,
            search: Search::begun(),
        })
    }

    /// Latency timer of an FTDI adapter, ms: it may hold an answer back for that long. `None` for any other port.
    pub fn latency_timer_ms(path: &str) -> Option<u32> {
        let tty = std::fs::canonicalize(path).ok()?;
        let name = tty.file_name()?.to_str()?;
        let timer = Path::new("/sys/bus/usb-serial/devices")
            .join(name)
            .join("latency_timer");
        std::fs::read_to_string(timer).ok()?.trim().parse().ok()
    }

    /// The port, opened again if it was gone.
    fn port(&mut self) -> std::io::Result<&OwnedFd> {
        if self.port.is_none() && self.search.is_due() {
            self.port = open(&self.name, self.baud).ok();
        }
        self.port
            .as_ref()
            .ok_or_else(|| Error::new(ErrorKind::NotConnected, "the port is gone"))
    }

    fn gone(&mut self, error: impl Into<Error>) -> Error {
        self.port = None;
        self.search = Search::begun();
        error.into()
    }
}

/// Raw mode: 8 data bits, no parity, one stop bit, no flow control; nothing blocks.
fn open(path: &str, baud: u32) -> std::io::Result<OwnedFd> {
    let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::NONBLOCK | OFlags::CLOEXEC;
    let port = rustix::fs::open(path, flags, Mode::empty())?;
    let mut settings = tcgetattr(&port)?;
    // The first keeps other programs out, the second those of the superuser.
    ioctl_tiocexcl(&port)?;
    flock(&port, FlockOperation::NonBlockingLockExclusive)?;
    settings.make_raw();
    settings.input_modes -= InputModes::IXON | InputModes::IXOFF | InputModes::IXANY;
    settings.control_modes -= ControlModes::CSTOPB | ControlModes::CRTSCTS;
    settings.control_modes |= ControlModes::CREAD | ControlModes::CLOCAL;
    settings.set_speed(baud)?;
    tcsetattr(&port, OptionalActions::Now, &settings)?;
    tcflush(&port, QueueSelector::IOFlush)?;
    Ok(port)
}

impl Port for SerialLine {
    fn name(&self) -> &str {
        &self.name
    }

    fn write_some(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        let port = self.port()?;
        // Write first and wait afterwards: during a transfer a USB line reports that it is not writable, but accepts the next
        // one.
        let taken = match rustix::io::write(port, bytes) {
            Err(Errno::AGAIN) => {
                let span = Timespec {
                    tv_sec: 0,
                    tv_nsec: WAIT_NS,
                };
                let _ = poll(&mut [PollFd::new(port, PollFlags::OUT)], Some(&span));
                rustix::io::write(port, bytes)
            }
            taken => taken,
        };
        match taken {
            Ok(taken) => Ok(taken),
            Err(Errno::AGAIN | Errno::INTR) => Ok(0),
            Err(error) => Err(self.gone(error)),
        }
    }

    fn read_available(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        match rustix::io::read(self.port()?, buffer) {
            // A terminal without data returns AGAIN; an end of file means that the line is gone.
            Ok(0) => Err(self.gone(ErrorKind::UnexpectedEof)),
            Ok(length) => Ok(length),
            Err(Errno::AGAIN | Errno::INTR) => Ok(0),
            Err(error) => Err(self.gone(error)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
    use rustix::termios::{Action, tcflow};
    use std::os::unix::fs::symlink;
    use std::path::PathBuf;
    use std::time::{Duration, Instant};

    /// The board's end of a pseudo-terminal, in raw mode once the line is open, and the path of the host's.
    fn pair() -> (OwnedFd, String) {
        let flags = OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC;
        let far = openpt(flags).expect("this system has pseudo-terminals");
        grantpt(&far).expect("granted");
        unlockpt(&far).expect("unlocked");
        let name = ptsname(&far, Vec::new()).expect("a name");
        (far, name.to_string_lossy().into_owned())
    }

    fn read_all(line: &mut SerialLine, count: usize) -> Vec<u8> {
        let until = Instant::now() + Duration::from_secs(5);
        let (mut all, mut buffer) = (Vec::new(), [0; 16]);
        while all.len() < count && Instant::now() < until {
            let length = line.read_available(&mut buffer).expect("open");
            all.extend_from_slice(&buffer[..length]);
        }
        all
    }

    #[test]
    fn bytes_cross_a_pseudo_terminal_and_an_empty_line_reads_nothing() {
        let (far, path) = pair();
        let mut line = SerialLine::open(&path, 921_600).expect("a terminal");
        assert_eq!(line.read_available(&mut [0; 16]).expect("open"), 0);
        rustix::io::write(&far, &[0, 1, 17, 19, 255]).expect("open");
        assert_eq!(read_all(&mut line, 5), [0, 1, 17, 19, 255]);
    }

    #[test]
    fn a_line_that_takes_nothing_is_waited_for_half_a_period_and_is_no_error() {
        let (far, path) = pair();
        let mut line = SerialLine::open(&path, 921_600).expect("a terminal");
        tcflow(line.port().expect("open"), Action::OOff).expect("stopped");
        let from = Instant::now();
        assert_eq!(line.write_some(&[1, 2, 3]).expect("no error"), 0);
        assert!(from.elapsed() >= Duration::from_micros(500));
        tcflow(line.port().expect("open"), Action::OOn).expect("goes on");
        assert_eq!(line.write_some(&[1, 2, 3]).expect("open"), 3);
        let mut buffer = [0; 16];
        assert_eq!(rustix::io::read(&far, &mut buffer).expect("open"), 3);
    }

    #[test]
    fn a_line_that_was_unplugged_is_opened_again_when_it_is_back() {
        let folder = tempfile::tempdir().expect("a folder");
        let link: PathBuf = folder.path().join("pzt");
        let (far, path) = pair();
        symlink(&path, &link).expect("linked");
        let name = link.to_string_lossy().into_owned();
        let mut line = SerialLine::open(&name, 921_600).expect("a terminal");
        drop(far);
        std::fs::remove_file(&link).expect("unlinked");
        assert!(line.read_available(&mut [0; 16]).is_err());
        assert!(line.write_some(&[1]).is_err());
        let (far, path) = pair();
        symlink(&path, &link).expect("linked");
        let until = Instant::now() + Duration::from_secs(5);
        while line.write_some(&[7]).is_err() {
            assert!(Instant::now() < until, "not opened again");
        }
        let mut buffer = [0; 16];
        assert_eq!(rustix::io::read(&far, &mut buffer).expect("open"), 1);
    }

    #[test]
    fn a_port_that_does_not_exist_or_is_in_use_is_an_error_and_no_panic() {
        assert!(SerialLine::open("/dev/does-not-exist", 1_000_000).is_err());
        assert!(SerialLine::open("/dev/null", 1_000_000).is_err());
        assert_eq!(SerialLine::latency_timer_ms("/dev/does-not-exist"), None);
        let (_far, path) = pair();
        let _line = SerialLine::open(&path, 921_600).expect("a terminal");
        assert!(SerialLine::open(&path, 921_600).is_err());
    }
}
