//! The PZT board on a serial port (a real one, a USB adapter, or a pseudo-terminal).

use crate::board::Port;
use serialport::{SerialPort, TTYPort};
use std::io::{Error, ErrorKind, Read, Write};
use std::path::Path;
use std::time::Duration;

/// An open serial port.
#[derive(Debug)]
pub struct SerialLine {
    port: TTYPort,
    name: String,
}

impl SerialLine {
    /// Opens a port for this process alone. A pseudo-terminal takes any baud rate.
    ///
    /// # Errors
    /// The port does not exist, is in use, or is no serial port.
    pub fn open(path: &str, baud: u32) -> std::io::Result<Self> {
        let port = serialport::new(path, baud)
            // Reads return at once; see `read_available`.
            .timeout(Duration::from_millis(1))
            .open_native()
            .map_err(Error::from)?;
        port.clear(serialport::ClearBuffer::All)
            .map_err(Error::from)?;
        Ok(Self {
            port,
            name: path.to_string(),
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
}

impl Port for SerialLine {
    fn name(&self) -> &str {
        &self.name
    }

    fn write_all(&mut self, bytes: &[u8]) -> std::io::Result<()> {
        self.port.write_all(bytes)
    }

    fn read_available(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        let waiting = self.port.bytes_to_read().map_err(Error::from)? as usize;
        if waiting == 0 {
            return Ok(0);
        }
        let most = waiting.min(buffer.len());
        match self.port.read(&mut buffer[..most]) {
            Ok(length) => Ok(length),
            Err(error) if matches!(error.kind(), ErrorKind::TimedOut | ErrorKind::Interrupted) => {
                Ok(0)
            }
            Err(error) => Err(error),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_cross_a_pseudo_terminal_and_an_empty_line_reads_nothing() {
        let (mut far, near) = TTYPort::pair().expect("this system has pseudo-terminals");
        let mut line = SerialLine {
            port: near,
            name: "pty".to_string(),
        };
        let mut buffer = [0; 16];
        assert_eq!(line.read_available(&mut buffer).expect("open"), 0);
        far.write_all(&[0, 1, 255]).expect("open");
        while line.port.bytes_to_read().expect("open") < 3 {
            std::thread::yield_now();
        }
        assert_eq!(line.read_available(&mut buffer).expect("open"), 3);
        assert_eq!(buffer[..3], [0, 1, 255]);
    }

    #[test]
    fn a_port_that_does_not_exist_is_an_error_and_no_panic() {
        assert!(SerialLine::open("/dev/does-not-exist", 1_000_000).is_err());
        assert_eq!(SerialLine::latency_timer_ms("/dev/does-not-exist"), None);
    }
}
