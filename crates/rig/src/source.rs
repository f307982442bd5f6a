//! The interface of a camera and of a stream of positions.

use crate::measurement::Measurement;
use cellpos_vision::{Frame, Pixels};
use serde::Serialize;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

/// Data of a frame besides its pixels. Times are nanoseconds of the run's clock.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameStamp {
    /// Unwrapped id, rising by one per exposed frame.
    pub id: u64,
    /// Middle of the exposure.
    pub mid_exposure_ns: i64,
    /// Length of the exposure; 0 if the camera does not report it.
    pub exposure_ns: i64,
    /// Arrival in this process.
    pub arrival_ns: i64,
    /// True bead position at arrival, um (emulated rig only, else NaN).
    pub true_um: f64,
    /// True PZT displacement at arrival, um (emulated rig only, else NaN).
    pub true_pzt_um: f64,
}

/// A reusable buffer for one frame. It grows to the first frame's size and then allocates no more.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
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
    /// A frame of 8 bits per pixel, rows contiguous.
    pub fn of_mono8(width: usize, height: usize, mono8: Vec<u8>) -> Self {
        Self {
            width,
            height,
            bits: 8,
            mono8,
            mono16: Vec::new(),
        }
    }

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

/// The reason why a source gives no more frames. A late or missing frame is not an error.
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
    /// The stream is not in the expected format.
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

/// Description of a source.
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
    /// Length of an exposure as the camera reports it, s; 0 if it does not. The controller that a run records has it.
    #[serde(skip)]
    pub exposure_s: f64,
    /// Lowest and highest position that can be seen, um.
    pub field_um: [f64; 2],
}

/// A camera: frames with ids and mid-exposure time stamps.
pub trait Camera: Send {
    /// Waits for the next frame until `deadline_ns` and copies it into `buffer`; `None` if no frame came in time.
    ///
    /// # Errors
    /// [`CameraError`] when there will be no more frames.
    fn next_frame(
        &mut self,
        buffer: &mut FrameBuffer,
        deadline_ns: i64,
    ) -> Result<Option<FrameStamp>, CameraError>;

    /// True bead position now, um (emulated rig only, else NaN), for moments without a frame.
    fn truth_um(&mut self) -> f64 {
        f64::NAN
    }

    /// Description of the camera; `field_um` counts from the left border if the calibration is unknown here.
    fn info(&self) -> SourceInfo;
}

impl<C: Camera + ?Sized> Camera for Box<C> {
    fn next_frame(
        &mut self,
        buffer: &mut FrameBuffer,
        deadline_ns: i64,
    ) -> Result<Option<FrameStamp>, CameraError> {
        (**self).next_frame(buffer, deadline_ns)
    }

    fn truth_um(&mut self) -> f64 {
        (**self).truth_um()
    }

    fn info(&self) -> SourceInfo {
        (**self).info()
    }
}

/// A frame with the result of vision.
#[derive(Debug, Clone, Copy)]
pub struct SeenFrame<'a> {
    /// The frame.
    pub frame: Frame<'a>,
    /// Bits per pixel of the frame.
    pub bits: u16,
    /// When it was exposed.
    pub stamp: FrameStamp,
    /// Centre of the accepted bead or cell, px; `None` without one.
    pub centre_px: Option<(f64, f64)>,
    /// Half its width along the columns and the rows, px.
    pub half_px: (f64, f64),
    /// Outline of the cell, px; empty for a bead or without a cell.
    pub outline_px: &'a [(f64, f64)],
    /// Its expected position, px.
    pub expected_px: (f64, f64),
    /// Standard deviation of that position, px; infinite while vision searches everywhere.
    pub expected_sd_px: f64,
    /// From pixels to the channel.
    pub scale: PictureScale,
}

/// Position of the channel in a picture, to first order: enough for a scale bar and a click.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PictureScale {
    /// Position along the channel at the centre of the first pixel, um.
    pub first_um: f64,
    /// Change of position per pixel along the channel's axis, um; negative if the channel runs against it.
    pub um_per_px: f64,
    /// Whether the channel follows the columns of the picture rather than its rows.
    pub upright: bool,
}

/// Sees each new frame without delaying the loop: a live picture, a ring of the last seconds. Called on the camera's thread between
/// a frame and its position: it must not wait, lock or allocate.
pub trait FrameWatch: Send {
    /// Called after vision has processed a new frame.
    fn frame(&mut self, seen: &SeenFrame<'_>);
}

/// Tells a source that the object it follows did not move with the PZT: it looks for another one.
#[derive(Debug, Clone, Default)]
pub struct Rejections(Arc<AtomicU32>);

impl Rejections {
    /// Rejects the object that is followed now. Neither locks nor waits.
    pub fn reject(&self) {
        self.0.fetch_add(1, Ordering::Relaxed);
    }

    /// How many objects were rejected.
    pub fn count(&self) -> u32 {
        self.0.load(Ordering::Relaxed)
    }
}

/// A stream of bead positions.
pub trait PositionSource: Send {
    /// Waits for the next position until `deadline_ns`; `None` when none came in time.
    ///
    /// # Errors
    /// [`CameraError`] when there will be no more.
    fn next(&mut self, deadline_ns: i64) -> Result<Option<Measurement>, CameraError>;

    /// True bead position now, um (emulated rig only, else NaN), for moments without a position.
    fn truth_um(&mut self) -> f64 {
        f64::NAN
    }

    /// Description of the source.
    fn info(&self) -> SourceInfo;

    /// A run begins, and nothing is held yet: a source that has lost its bead looks for another one.
    fn begin(&mut self) {}

    /// Where to reject the object that it follows. `None` if the source can follow no other.
    fn rejections(&self) -> Option<Rejections> {
        None
    }

    /// Shows each new frame to `watch` from now on; `false` if the source has no frames.
    fn watch(&mut self, watch: Box<dyn FrameWatch>) -> bool {
        drop(watch);
        false
    }
}
