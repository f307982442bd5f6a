//! Plant and camera around a board that runs elsewhere and sends its converter's codes over a terminal.
//!
//! A code is three bytes, `1000 0Lcc`, `0ccc cccc`, `0ccc cccc` (L: LED, c: code, highest bit first). Only the first byte has its
//! highest bit set, so a torn code is dropped and the next one read.

use super::ProgramError;
use super::args::Setup;
use super::frame_server::FrameServer;
use super::log::{Instant, Log};
use super::pace::{HOUSEKEEPING_NS, LONGEST_SLEEP_NS, monotonic_ns, send_frames, wait};
use cellpos_emulator::World;
use rustix::fs::{Mode, OFlags};
use rustix::io::Errno;
use rustix::termios::{OptionalActions, tcgetattr, tcsetattr};
use std::os::fd::{AsFd, OwnedFd};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

/// Gathers codes from bytes.
#[derive(Debug, Default)]
struct CodeDecoder {
    bits: u32,
    bytes: u8,
}

impl CodeDecoder {
    /// Takes a byte; gives code and LED when it completes them.
    fn push(&mut self, byte: u8) -> Option<(u16, bool)> {
        if byte & 0x80 != 0 {
            (self.bits, self.bytes) = (u32::from(byte), 1);
            return None;
        }
        if self.bytes == 0 {
            return None;
        }
        self.bits = self.bits << 7 | u32::from(byte);
        self.bytes += 1;
        if self.bytes < 3 {
            return None;
        }
        self.bytes = 0;
        // LED above the two highest bits of the code, those above two groups of seven.
        Some((self.bits as u16, self.bits & 1 << 16 != 0))
    }
}

/// World and converter's terminal.
#[derive(Debug)]
pub(super) struct Around {
    terminal: OwnedFd,
    world: World,
    decoder: CodeDecoder,
    low_um: f64,
    step_um: f64,
    applied_um: f64,
    heard: u64,
}

impl Around {
    /// Opens the terminal. Until the first code it assumes the power-up displacement.
    ///
    /// # Errors
    /// A terminal that cannot be opened; an invalid world or board.
    pub(super) fn open(path: &Path, setup: &Setup, start_ns: i64) -> Result<Self, ProgramError> {
        let fail = |error: Errno| ProgramError::File {
            path: path.to_owned(),
            doing: "opening the converter's terminal",
            source: error.into(),
        };
        let board = setup
            .board
            .board()
            .map_err(cellpos_emulator::BoxError::from)?;
        let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::CLOEXEC | OFlags::NONBLOCK;
        let terminal = rustix::fs::open(path, flags, Mode::empty()).map_err(fail)?;
        let mut settings = tcgetattr(&terminal).map_err(fail)?;
        settings.make_raw();
        tcsetattr(&terminal, OptionalActions::Now, &settings).map_err(fail)?;
        let config = setup.board;
        Ok(Self {
            terminal,
            world: World::new(&setup.world, &setup.model, start_ns)
                .map_err(cellpos_emulator::BoxError::from)?,
            decoder: CodeDecoder::default(),
            low_um: config.low_um,
            step_um: (config.high_um - config.low_um) / f64::from(board.config().highest_code()),
            applied_um: config.power_up_um,
            heard: 0,
        })
    }

    /// Displacement at the converter, um.
    pub(super) fn applied_um(&self) -> f64 {
        self.applied_um
    }

    /// Codes heard.
    pub(super) fn heard(&self) -> u64 {
        self.heard
    }

    /// Brings the world up to now and takes the codes that have arrived: they act from now on.
    fn follow(&mut self, now_ns: i64) -> Result<(), ProgramError> {
        let mut bytes = [0; 256];
        let count = match rustix::io::read(&self.terminal, &mut bytes) {
            Ok(count) => count,
            Err(Errno::AGAIN | Errno::INTR) => 0,
            Err(error) => {
                return Err(ProgramError::system("reading from the board")(error));
            }
        };
        self.world.advance_to(now_ns, self.applied_um);
        for byte in bytes.into_iter().take(count) {
            if let Some((code, led)) = self.decoder.push(byte) {
                self.heard += 1;
                self.applied_um = self.low_um + f64::from(code) * self.step_um;
                self.world.set_led(led);
            }
        }
        Ok(())
    }

    /// The loop; returns the number of frames handed to clients.
    ///
    /// # Errors
    /// The board's terminal is gone; the log cannot be written.
    pub(super) fn pace(
        &mut self,
        server: &mut FrameServer,
        mut log: Option<&mut Log>,
        end_ns: i64,
        stop: &AtomicBool,
    ) -> Result<u64, ProgramError> {
        let mut pixels = Vec::new();
        let (mut frames, mut watched, mut next_housekeeping_ns) = (0, false, 0);
        loop {
            let now_ns = monotonic_ns();
            self.follow(now_ns)?;
            if now_ns >= next_housekeeping_ns {
                next_housekeeping_ns = now_ns + HOUSEKEEPING_NS;
                watched = server.accept();
            }
            if watched {
                frames += send_frames(&mut self.world, server, &mut pixels);
            } else {
                while self.world.take_position().is_some() {}
            }
            if let Some(log) = log.as_deref_mut() {
                log.note(&Instant {
                    now_ns,
                    applied_um: self.applied_um,
                    pzt_um: self.world.pzt_um(),
                    bead_um: self.world.bead_um(),
                    state: "Elsewhere",
                    fault: "Elsewhere",
                })?;
            }
            if stop.load(Ordering::Relaxed) || now_ns >= end_ns {
                return Ok(frames);
            }
            let delivery_ns = self.world.next_delivery_ns().unwrap_or(i64::MAX);
            let row_ns = log.as_ref().map_or(i64::MAX, |log| log.next_ns());
            wait(
                Some(self.terminal.as_fd()),
                delivery_ns.min(row_ns).min(now_ns + LONGEST_SLEEP_NS),
            )?;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bytes(code: u16, led: bool) -> [u8; 3] {
        [
            0x80 | u8::from(led) << 2 | (code >> 14) as u8,
            (code >> 7) as u8 & 0x7f,
            code as u8 & 0x7f,
        ]
    }

    #[test]
    fn every_code_is_read_back_and_a_torn_one_costs_no_other() {
        let mut decoder = CodeDecoder::default();
        for code in 0..=u16::MAX {
            for led in [false, true] {
                let found = bytes(code, led).map(|byte| decoder.push(byte));
                assert_eq!(found, [None, None, Some((code, led))]);
            }
        }
        // Torn in front, and torn at the end.
        assert_eq!(
            bytes(77, true)[1..].iter().find_map(|b| decoder.push(*b)),
            None
        );
        assert_eq!(
            bytes(78, true)[..2].iter().find_map(|b| decoder.push(*b)),
            None
        );
        let found = bytes(79, false).map(|byte| decoder.push(byte));
        assert_eq!(found[2], Some((79, false)));
    }
}
