//! A camera and its tracker, for a thread that must not wait.
//!
//! Vision can take longer than the time between two commands. Frames are therefore stored when they come and evaluated when there
//! is time: none is lost, and no command is late.

use crate::bench::Bench;
use crate::snapshot::Eye;
use cellpos_rig::{Camera, Clock, FrameBuffer};
use cellpos_session::Failure;
use std::collections::VecDeque;

/// One frame with a bead: when, and where.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Sighting {
    pub(crate) at_ns: i64,
    pub(crate) x_px: f64,
    pub(crate) y_px: f64,
}

/// Camera, tracker and the stored frames.
pub(crate) struct Watch {
    camera: Box<dyn Camera>,
    eye: Eye,
    start_ns: i64,
    buffer: FrameBuffer,
    aside: VecDeque<(i64, FrameBuffer)>,
    aside_bytes: usize,
    /// The beads seen, oldest first.
    pub(crate) sightings: Vec<Sighting>,
}

/// Frames that are taken at once.
const AT_ONCE: usize = 100;
/// Memory for stored frames; beyond it, frames are evaluated when they come.
const MOST_BYTES: usize = 1 << 29;

impl Watch {
    /// Of a bench whose camera can be opened.
    pub(crate) fn of(bench: &Bench) -> Result<Self, Failure> {
        Ok(Self {
            camera: bench.camera()?,
            eye: Eye::of(bench)?,
            start_ns: Clock::Real.now_ns(),
            buffer: FrameBuffer::default(),
            aside: VecDeque::new(),
            aside_bytes: 0,
            sightings: Vec::new(),
        })
    }

    /// Size of the frames, px; zero before the first.
    pub(crate) fn size_px(&self) -> [usize; 2] {
        [self.buffer.width, self.buffer.height]
    }

    /// Evaluates the newest few of the frames that have come, and forgets the others.
    pub(crate) fn glance(&mut self) -> Result<(), Failure> {
        const NEWEST: usize = 2;
        self.put_aside()?;
        while self.aside.len() > NEWEST {
            self.take_aside();
        }
        self.look_at_all()
    }

    /// Stores the frames that have come.
    pub(crate) fn put_aside(&mut self) -> Result<(), Failure> {
        let now_ns = Clock::Real.now_ns();
        for _ in 0..AT_ONCE {
            if !self.next(now_ns)? {
                break;
            }
        }
        while self.aside_bytes > MOST_BYTES {
            self.look()?;
        }
        Ok(())
    }

    /// Waits for the frames exposed up to `until_ns`, evaluates all stored frames and returns the beads seen in them.
    pub(crate) fn finish(mut self, until_ns: i64) -> Result<Vec<Sighting>, Failure> {
        const PATIENCE_NS: i64 = 200_000_000;
        while self.aside.back().is_none_or(|(at_ns, _)| *at_ns < until_ns) {
            if !self.next(Clock::Real.now_ns() + PATIENCE_NS)? {
                break;
            }
        }
        self.look_at_all()?;
        self.sightings.retain(|seen| seen.at_ns <= until_ns);
        Ok(self.sightings)
    }

    /// Stores one frame, if one comes until then.
    fn next(&mut self, deadline_ns: i64) -> Result<bool, Failure> {
        let stamp = self.camera.next_frame(&mut self.buffer, deadline_ns);
        let Some(stamp) = stamp.map_err(Failure::failed)? else {
            return Ok(false);
        };
        self.aside_bytes += bytes(&self.buffer);
        self.aside
            .push_back((stamp.mid_exposure_ns, self.buffer.clone()));
        Ok(true)
    }

    fn take_aside(&mut self) -> Option<(i64, FrameBuffer)> {
        let taken = self.aside.pop_front()?;
        self.aside_bytes -= bytes(&taken.1);
        Some(taken)
    }

    fn look(&mut self) -> Result<bool, Failure> {
        let Some((at_ns, frame)) = self.take_aside() else {
            return Ok(false);
        };
        let time_s = (at_ns - self.start_ns) as f64 * 1e-9;
        if let Some(seen) = self.eye.look(&frame, time_s)? {
            self.sightings.push(Sighting {
                at_ns,
                x_px: seen.x_px,
                y_px: seen.y_px,
            });
        }
        Ok(true)
    }

    fn look_at_all(&mut self) -> Result<(), Failure> {
        while self.look()? {}
        Ok(())
    }
}

fn bytes(frame: &FrameBuffer) -> usize {
    frame.mono8.len() + 2 * frame.mono16.len()
}
