//! What is seen at a stop. The camera stays open: away from zero flow the bead moves during the search.

use crate::outcome::Failure;
use cellpos_rig::{Camera, Clock, FrameBuffer};
use cellpos_workbench::Bench;
use cellpos_workbench::mover::Mover;
use cellpos_workbench::snapshot::{self, Eye, Seen};

/// Camera and eye.
pub(super) struct Sight<'a> {
    bench: &'a Bench,
    camera: Box<dyn Camera>,
    buffer: FrameBuffer,
}

impl<'a> Sight<'a> {
    /// Of a rig whose camera can be opened.
    pub(super) fn of(bench: &'a Bench) -> Option<Self> {
        bench.camera().ok().map(|camera| Self {
            bench,
            camera,
            buffer: FrameBuffer::default(),
        })
    }

    /// The bead or cell as it is seen now, while the PZT is held at `to_um`.
    pub(super) fn look(&mut self, mover: &mut Mover, to_um: f64) -> Result<Option<Seen>, Failure> {
        /// Frames in which it is looked for.
        const LOOKS: u32 = 50;
        /// Frames that may have piled up since the last look.
        const PILED_UP: u32 = 10_000;
        let Ok(mut eye) = Eye::of(self.bench) else {
            return Ok(None);
        };
        for _ in 0..PILED_UP {
            let now_ns = Clock::Real.now_ns();
            let old = self.camera.next_frame(&mut self.buffer, now_ns);
            if old.map_err(Failure::failed)?.is_none() {
                break;
            }
        }
        let first_ns = snapshot::next_frame(self.camera.as_mut(), &mut self.buffer)?;
        for _ in 0..LOOKS {
            mover.step(to_um, f64::INFINITY)?;
            let at_ns = snapshot::next_frame(self.camera.as_mut(), &mut self.buffer)?;
            let seen = eye.look(&self.buffer, (at_ns - first_ns) as f64 * 1e-9)?;
            if seen.is_some() {
                return Ok(seen);
            }
        }
        Ok(None)
    }
}
