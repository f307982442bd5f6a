//! A recording behind the camera trait.

use super::{Recording, Region, SourceError};
use cellpos_rig::clock::Clock;
use cellpos_rig::source::{Camera, CameraError, FrameBuffer, FrameStamp, SourceInfo};

/// Plays a recording at a frame rate: frame `n` is exposed about `start + n / rate` and arrives then. A frame that the
/// disk gives late arrives late; no frame is left out.
#[derive(Debug)]
pub struct Playback {
    recording: Box<dyn Recording>,
    region: Option<Region>,
    rate_hz: f64,
    clock: Clock,
    start_ns: Option<i64>,
    next: usize,
}

impl Playback {
    /// Plays `recording` at `rate_hz`, or at its own rate, on `clock`; only `region` of each frame when given.
    ///
    /// # Errors
    /// A region that is empty or reaches beyond the frame.
    pub fn new(
        recording: Box<dyn Recording>,
        rate_hz: Option<f64>,
        region: Option<Region>,
        clock: Clock,
    ) -> Result<Self, SourceError> {
        let info = recording.info();
        if let Some(region) = region {
            region.check(info.width_px, info.height_px)?;
        }
        let rate_hz = rate_hz
            .or(info.rate_hz)
            .filter(|r| r.is_finite() && *r > 0.0)
            .unwrap_or(DEFAULT_RATE_HZ);
        Ok(Playback {
            recording,
            region,
            rate_hz,
            clock,
            start_ns: None,
            next: 0,
        })
    }
}

/// Frame rate of a recording that does not state it, Hz.
const DEFAULT_RATE_HZ: f64 = 1000.0;

impl Camera for Playback {
    fn next_frame(
        &mut self,
        buffer: &mut FrameBuffer,
        deadline_ns: i64,
    ) -> Result<Option<FrameStamp>, CameraError> {
        let info = self.recording.info();
        let camera = || info.path.display().to_string();
        if self.next >= info.frames {
            let problem = format!("the recording has ended after {} frames", info.frames);
            return Err(CameraError::Gone {
                camera: camera(),
                problem,
            });
        }
        let start_ns = *self.start_ns.get_or_insert_with(|| self.clock.now_ns());
        let number = self.recording.number(self.next);
        let due_ns = start_ns.saturating_add((number as f64 / self.rate_hz * 1e9) as i64);
        if due_ns > deadline_ns {
            self.clock.sleep_until_ns(deadline_ns);
            return Ok(None);
        }
        let name = camera();
        let broken = |e: SourceError| CameraError::Gone {
            camera: name.clone(),
            problem: e.to_string(),
        };
        self.recording.read(self.next, buffer).map_err(broken)?;
        if let Some(region) = self.region {
            region.cut(buffer).map_err(broken)?;
        }
        self.clock.sleep_until_ns(due_ns);
        self.next += 1;
        Ok(Some(FrameStamp {
            id: number + 1,
            mid_exposure_ns: due_ns,
            exposure_ns: 0,
            arrival_ns: self.clock.now_ns(),
            true_um: f64::NAN,
            true_pzt_um: f64::NAN,
        }))
    }

    fn info(&self) -> SourceInfo {
        let info = self.recording.info();
        let (width_px, height_px) = self.region.map_or((info.width_px, info.height_px), |r| {
            (r.width_px, r.height_px)
        });
        SourceInfo {
            name: format!("{} {}", info.kind, info.path.display()),
            width_px,
            height_px,
            rate_hz: self.rate_hz,
            latency_ms: 0.0,
            exposure_s: 0.0,
            field_um: [0.0, 0.0],
        }
    }
}
