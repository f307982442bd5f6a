//! Cameras, and how their frames become positions.

use crate::measurement::Measurement;
use cellpos_vision::{Fix, Frame, Localiser, Pixels, Verdict};
use serde::{Deserialize, Serialize};

/// What is known of a frame besides its pixels. Times are nanoseconds of the run's clock.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameStamp {
    /// Unwrapped id, rising by one per exposed frame.
    pub id: u64,
    /// Middle of the exposure.
    pub mid_exposure_ns: i64,
    /// Arrival in this process.
    pub arrival_ns: i64,
    /// True bead position at arrival, um (emulated rig only, else NaN).
    pub true_um: f64,
    /// True PZT displacement at arrival, um (emulated rig only, else NaN).
    pub true_pzt_um: f64,
}

/// Room for one frame, used again and again. Grows to the first frame's size and then allocates no more.
#[derive(Debug, Clone, Default)]
pub struct FrameBuffer {
    /// Pixels per row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Bits per pixel: up to 8 in `mono8`, else in `mono16`.
    pub bits: u16,
    /// Grey values of 8 bits.
    pub mono8: Vec<u8>,
    /// Grey values of 9 to 16 bits.
    pub mono16: Vec<u16>,
}

impl FrameBuffer {
    /// The frame as vision takes it.
    pub fn frame(&self) -> Frame<'_> {
        Frame {
            width: self.width,
            height: self.height,
            pixels: if self.bits > 8 {
                Pixels::Mono16(&self.mono16)
            } else {
                Pixels::Mono8(&self.mono8)
            },
        }
    }
}

/// Why a source gives no more frames. A frame that is only late or missing is no error.
#[derive(Debug, thiserror::Error)]
pub enum CameraError {
    /// The camera, or the file or process behind it, is gone.
    #[error("camera {camera}: {problem}")]
    Gone {
        /// Which camera.
        camera: String,
        /// What happened.
        problem: String,
    },
    /// The stream is not what was promised.
    #[error("camera {camera}: {problem}; {remedy}")]
    Broken {
        /// Which camera.
        camera: String,
        /// What is wrong.
        problem: String,
        /// What would be right.
        remedy: String,
    },
}

/// What a source says of itself.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SourceInfo {
    /// Kind and address.
    pub name: String,
    /// Pixels per row; 0 without pictures.
    pub width_px: usize,
    /// Rows; 0 without pictures.
    pub height_px: usize,
    /// Frame rate promised, Hz.
    pub rate_hz: f64,
    /// From the middle of an exposure to its arrival, as configured, ms.
    pub latency_ms: f64,
    /// Lowest and highest position that can be seen, um.
    pub field_um: [f64; 2],
}

/// A camera: frames with ids and mid-exposure time stamps.
pub trait Camera: Send {
    /// Waits for the next frame until `deadline_ns` and copies it into `buffer`; `None` when none came in time.
    ///
    /// # Errors
    /// [`CameraError`] when there will be no more frames.
    fn next_frame(
        &mut self,
        buffer: &mut FrameBuffer,
        deadline_ns: i64,
    ) -> Result<Option<FrameStamp>, CameraError>;

    /// What the camera says of itself; `field_um` counts from the left border when the calibration is not known here.
    fn info(&self) -> SourceInfo;
}

/// A stream of bead positions.
pub trait PositionSource: Send {
    /// Waits for the next position until `deadline_ns`; `None` when none came in time.
    ///
    /// # Errors
    /// [`CameraError`] when there will be no more.
    fn next(&mut self, deadline_ns: i64) -> Result<Option<Measurement>, CameraError>;

    /// What the source says of itself.
    fn info(&self) -> SourceInfo;
}

/// From pixels to micrometres along the channel: `position_um = sign * (x_px - origin_px) * pixel_um`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Calibration {
    /// Size of a pixel in the object plane, um.
    pub pixel_um: f64,
    /// Column of position 0, px.
    pub origin_px: f64,
    /// +1 when the column number rises in the direction in which the bead moves when the PZT extends, else -1.
    pub sign: f64,
}

impl Calibration {
    /// Position of a column, um.
    pub fn position_um(&self, x_px: f64) -> f64 {
        self.sign * (x_px - self.origin_px) * self.pixel_um
    }

    /// Variance of a position, um^2.
    pub fn variance_um2(&self, var_px2: f64) -> f64 {
        var_px2 * self.pixel_um * self.pixel_um
    }
}

/// A camera with a localiser: frames in, positions out. Allocates nothing per frame once it runs.
#[derive(Debug)]
pub struct VisionSource<C> {
    camera: C,
    localiser: Localiser,
    calibration: Calibration,
    buffer: FrameBuffer,
    clock: crate::Clock,
    /// Where the bead was last, px; `None` looks at the whole frame.
    last_px: Option<(f64, f64)>,
    /// Frames in a row without a good fix.
    misses: u32,
}

/// After this many frames without a good fix the whole frame is searched again.
const SEARCH_AFTER: u32 = 5;

impl<C: Camera> VisionSource<C> {
    /// Joins a camera and a localiser.
    pub fn new(
        camera: C,
        localiser: Localiser,
        calibration: Calibration,
        clock: crate::Clock,
    ) -> Self {
        Self {
            camera,
            localiser,
            calibration,
            buffer: FrameBuffer::default(),
            clock,
            last_px: None,
            misses: 0,
        }
    }

    fn locate(&mut self) -> Fix {
        let fix = self.localiser.locate(&self.buffer.frame(), self.last_px);
        if fix.verdict == Verdict::Good {
            self.last_px = Some((fix.x_px, fix.y_px));
            self.misses = 0;
        } else {
            self.misses = self.misses.saturating_add(1);
            if self.misses >= SEARCH_AFTER {
                self.last_px = None;
            }
        }
        fix
    }
}

impl<C: Camera> PositionSource for VisionSource<C> {
    fn next(&mut self, deadline_ns: i64) -> Result<Option<Measurement>, CameraError> {
        let Some(stamp) = self.camera.next_frame(&mut self.buffer, deadline_ns)? else {
            return Ok(None);
        };
        let fix = self.locate();
        let good = fix.verdict == Verdict::Good;
        let or_nan = |value: f64| if good { value } else { f64::NAN };
        Ok(Some(Measurement {
            frame_id: stamp.id,
            mid_exposure_ns: stamp.mid_exposure_ns,
            ready_ns: self.clock.now_ns(),
            position_um: or_nan(self.calibration.position_um(fix.x_px)),
            variance_um2: or_nan(self.calibration.variance_um2(fix.var_x_px2)),
            verdict: fix.verdict,
            snr: fix.snr,
            true_um: stamp.true_um,
            true_pzt_um: stamp.true_pzt_um,
        }))
    }

    fn info(&self) -> SourceInfo {
        let mut info = self.camera.info();
        let ends =
            [0.0, info.width_px.saturating_sub(1) as f64].map(|x| self.calibration.position_um(x));
        info.field_um = [ends[0].min(ends[1]), ends[0].max(ends[1])];
        info
    }
}
