//! A line to the board with the faults of USB and serial lines: it stalls, accepts a part of the bytes, loses bytes, is unplugged
//! and returns. It never repeats or reorders bytes.

use cellpos_drivers::Port;
use cellpos_numeric::Random;
use cellpos_rig::Clock;
use std::io::{Error, ErrorKind, Result};

/// The faults of a line and their rates. The default is no fault.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct LineFaults {
    /// Stalls a second; the first frame after the start of a stall is cut in two.
    pub(super) stalls_per_s: f64,
    /// Shortest and longest stall, ms. Their logarithm is uniform, so that short ones are frequent and long ones happen.
    pub(super) stall_ms: [f64; 2],
    /// Probability that a write is taken in part.
    pub(super) part: f64,
    /// Probability that a byte is lost, in either direction.
    pub(super) byte_loss: f64,
    /// Times at which the line is unplugged and back, ns of the clock.
    pub(super) unplugged_ns: Vec<[i64; 2]>,
    /// Start and end of scheduled stalls, besides the random ones, ns of the clock.
    pub(super) stalled_ns: Vec<[i64; 2]>,
}

impl Default for LineFaults {
    fn default() -> Self {
        Self {
            stalls_per_s: 0.0,
            stall_ms: [1.0, 500.0],
            part: 0.0,
            byte_loss: 0.0,
            unplugged_ns: Vec::new(),
            stalled_ns: Vec::new(),
        }
    }
}

impl LineFaults {
    /// The same faults with their times counted from `start_ns`.
    #[must_use]
    pub(super) fn from(&self, start_ns: i64) -> Self {
        let later = |spans: &[[i64; 2]]| {
            let later = |[from_ns, until_ns]: &[i64; 2]| [start_ns + from_ns, start_ns + until_ns];
            spans.iter().map(later).collect()
        };
        Self {
            unplugged_ns: later(&self.unplugged_ns),
            stalled_ns: later(&self.stalled_ns),
            ..self.clone()
        }
    }
}

/// A line with faults in front of another one.
#[derive(Debug, Clone)]
pub(super) struct MisbehavingLine<P> {
    line: P,
    clock: Clock,
    faults: LineFaults,
    dice: Random,
    /// Start and end of the next random stall, ns.
    stall_ns: [i64; 2],
    /// Whether the frame that a stall cuts is still to come.
    cuts: bool,
}

impl<P> MisbehavingLine<P> {
    /// Puts faults in front of a line; `seed` fixes them.
    pub(super) fn new(line: P, clock: Clock, faults: LineFaults, seed: u64) -> Self {
        let mut this = Self {
            dice: Random::stream(seed, 31),
            stall_ns: [i64::MAX; 2],
            cuts: true,
            line,
            clock,
            faults,
        };
        this.draw_stall();
        this
    }

    /// Sets other faults from now on.
    pub(super) fn misbehave(&mut self, faults: LineFaults) {
        self.faults = faults;
        self.draw_stall();
    }

    fn draw_stall(&mut self) {
        self.stall_ns = [i64::MAX; 2];
        self.cuts = true;
        if self.faults.stalls_per_s <= 0.0 {
            return;
        }
        let wait_s = -(1.0 - self.dice.uniform()).ln() / self.faults.stalls_per_s;
        let [shortest, longest] = self.faults.stall_ms;
        let ms = shortest * (longest / shortest).powf(self.dice.uniform());
        let from_ns = self.clock.now_ns() + (wait_s * 1e9) as i64;
        self.stall_ns = [from_ns, from_ns + (ms * 1e6) as i64];
    }

    fn is_stalled(&mut self) -> bool {
        let now_ns = self.clock.now_ns();
        if now_ns >= self.stall_ns[1] {
            self.draw_stall();
        }
        let within = |[from_ns, until_ns]: &[i64; 2]| (*from_ns..*until_ns).contains(&now_ns);
        within(&self.stall_ns) || self.faults.stalled_ns.iter().any(within)
    }

    fn is_plugged_in(&self) -> Result<()> {
        let now_ns = self.clock.now_ns();
        let mut spans = self.faults.unplugged_ns.iter();
        if spans.any(|[from_ns, until_ns]| (*from_ns..*until_ns).contains(&now_ns)) {
            return Err(Error::from(ErrorKind::NotConnected));
        }
        Ok(())
    }

    fn keeps(&mut self) -> bool {
        self.faults.byte_loss <= 0.0 || self.dice.uniform() >= self.faults.byte_loss
    }
}

impl<P: Port> Port for MisbehavingLine<P> {
    fn name(&self) -> &str {
        self.line.name()
    }

    fn write_some(&mut self, bytes: &[u8]) -> Result<usize> {
        self.is_plugged_in()?;
        let mut taken = bytes.len();
        if self.is_stalled() {
            if !std::mem::take(&mut self.cuts) {
                return Ok(0);
            }
            taken /= 2;
        } else if self.faults.part > 0.0 && self.dice.uniform() < self.faults.part {
            taken = (self.dice.uniform() * taken as f64) as usize;
        }
        // A frame has at most 104 bytes; longer data are written in pieces.
        let mut passed = [0; 128];
        taken = taken.min(passed.len());
        let mut count = 0;
        for byte in bytes.iter().take(taken) {
            if self.keeps()
                && let Some(place) = passed.get_mut(count)
            {
                *place = *byte;
                count += 1;
            }
        }
        let mut rest = passed.get(..count).unwrap_or(&[]);
        while !rest.is_empty() {
            let written = self.line.write_some(rest)?;
            rest = rest.get(written.max(1)..).unwrap_or(&[]);
        }
        Ok(taken)
    }

    fn read_available(&mut self, buffer: &mut [u8]) -> Result<usize> {
        self.is_plugged_in()?;
        if self.is_stalled() {
            return Ok(0);
        }
        let length = self.line.read_available(buffer)?;
        let mut kept = 0;
        for at in 0..length {
            if self.keeps() {
                buffer.copy_within(at..=at, kept);
                kept += 1;
            }
        }
        Ok(kept)
    }
}
