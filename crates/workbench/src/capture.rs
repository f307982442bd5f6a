//! Records frames of a rig's camera: in memory for a short recording, on disk as a folder of pictures that `cellpos vision`
//! reads.

use crate::bench::Bench;
use crate::snapshot::next_frame;
use cellpos_rig::{Camera, Clock, FrameBuffer, FrameStamp};
use cellpos_session::Failure;
use image::{ImageBuffer, ImageResult, Luma};
use serde::Serialize;
use std::path::Path;

/// Memory for the frames of one recording: a gigabyte, or a minute of a 64 x 256 px region at 1 kHz.
const MOST_BYTES: f64 = (1_u64 << 30) as f64;

/// A frame that was kept.
#[derive(Debug, Clone)]
pub struct Kept {
    /// Id and times.
    pub stamp: FrameStamp,
    /// Its pixels.
    pub frame: FrameBuffer,
}

/// Frames in the order of their ids.
#[derive(Debug, Clone)]
pub struct Capture {
    /// Which camera.
    pub camera: String,
    /// Every new frame that came; never empty.
    pub frames: Vec<Kept>,
    /// Ids that are missing between them.
    pub lost: u64,
    /// Frames whose id was not new.
    pub repeated: u64,
}

/// What was written.
#[derive(Debug, Clone, Serialize)]
pub struct Recorded {
    /// Which camera.
    pub camera: String,
    /// Pixels per row.
    pub width_px: usize,
    /// Rows.
    pub height_px: usize,
    /// Bits per pixel.
    pub bits: u16,
    /// Pictures in the folder.
    pub frames: usize,
    /// Frames that the camera exposed but that never arrived; the file names skip their numbers.
    pub lost: u64,
    /// Frames that came twice.
    pub repeated: u64,
    /// From the first exposure to the last, s.
    pub duration_s: f64,
    /// Frames exposed per second by the camera's stamps, Hz.
    pub rate_hz: f64,
}

impl Capture {
    /// Records the camera of a rig for a time.
    ///
    /// # Errors
    /// No frame comes, the camera breaks, or the frames would not fit into memory.
    pub fn of(bench: &Bench, duration_s: f64) -> Result<Self, Failure> {
        let mut camera = bench.camera()?;
        let mut buffer = FrameBuffer::default();
        next_frame(camera.as_mut(), &mut buffer)?;
        let rate_hz = 1e6 / bench.file().timing.period_us;
        let bytes = (buffer.mono8.len() + 2 * buffer.mono16.len()) as f64;
        let most_s = MOST_BYTES / (bytes * rate_hz).max(1.0);
        if duration_s > most_s {
            return Err(Failure::bad_input(
                format!(
                    "--duration {duration_s}s: {:.0} frames of {} x {} px are more than a gigabyte",
                    duration_s * rate_hz,
                    buffer.width,
                    buffer.height
                ),
                format!("give up to {most_s:.1}s, or a smaller region of the sensor"),
            ));
        }
        let clock = Clock::Real;
        // Frames queued since the camera was opened are old.
        while camera
            .next_frame(&mut buffer, clock.now_ns())
            .map_err(Failure::failed)?
            .is_some()
        {}
        let end_ns = clock.now_ns() + (duration_s * 1e9) as i64;
        let mut capture = Self {
            camera: camera.info().name,
            frames: Vec::with_capacity((duration_s * rate_hz * 1.1) as usize + 1),
            lost: 0,
            repeated: 0,
        };
        while clock.now_ns() < end_ns {
            let Some(stamp) = camera
                .next_frame(&mut buffer, end_ns)
                .map_err(Failure::failed)?
            else {
                break;
            };
            match capture.frames.last().map(|kept| kept.stamp.id) {
                Some(last) if stamp.id <= last => {
                    capture.repeated += 1;
                    continue;
                }
                Some(last) => capture.lost += stamp.id - last - 1,
                None => {}
            }
            let frame = buffer.clone();
            capture.frames.push(Kept { stamp, frame });
        }
        if capture.frames.is_empty() {
            return Err(Failure::bad_input(
                format!("{}: no frame for {duration_s} s", capture.camera),
                "test it with cellpos camera",
            ));
        }
        Ok(capture)
    }

    /// Writes the frames into a new folder, one picture per frame, with the camera's numbers.
    ///
    /// # Errors
    /// The folder exists and is not empty, or cannot be written.
    pub fn write(&self, folder: &Path) -> Result<Recorded, Failure> {
        let refused = |error: &dyn std::fmt::Display| {
            Failure::bad_input(
                format!("{}: {error}", folder.display()),
                "give a new folder that can be written, with room for the pictures",
            )
        };
        std::fs::create_dir_all(folder).map_err(|error| refused(&error))?;
        let first = self.frames.first().map_or(0, |kept| kept.stamp.id);
        for kept in &self.frames {
            let path = folder.join(format!("frame-{:07}.png", kept.stamp.id - first));
            save(&kept.frame, &path).map_err(|error| refused(&error))?;
        }
        Ok(self.recorded())
    }

    fn recorded(&self) -> Recorded {
        let (first, last) = (self.frames.first(), self.frames.last());
        let between = |of: fn(&FrameStamp) -> f64| {
            let at = |kept: Option<&Kept>| kept.map_or(0.0, |kept| of(&kept.stamp));
            at(last) - at(first)
        };
        let duration_s = between(|stamp| stamp.mid_exposure_ns as f64) * 1e-9;
        let size = |of: fn(&FrameBuffer) -> usize| last.map_or(0, |kept| of(&kept.frame));
        Recorded {
            camera: self.camera.clone(),
            width_px: size(|frame| frame.width),
            height_px: size(|frame| frame.height),
            bits: last.map_or(0, |kept| kept.frame.bits),
            frames: self.frames.len(),
            lost: self.lost,
            repeated: self.repeated,
            duration_s,
            rate_hz: if duration_s > 0.0 {
                between(|stamp| stamp.id as f64) / duration_s
            } else {
                0.0
            },
        }
    }
}

/// Refuses a folder that is not empty, so that nothing is overwritten.
///
/// # Errors
/// It exists and is not empty, or it is a file.
pub fn new_folder(folder: &Path) -> Result<(), Failure> {
    let refuse = |why: &str| {
        Err(Failure::bad_input(
            format!("{}: {why}", folder.display()),
            "give a new folder",
        ))
    };
    match std::fs::read_dir(folder).map(|mut entries| entries.next().is_some()) {
        Ok(true) => refuse("is not empty; nothing is overwritten"),
        Ok(false) => Ok(()),
        Err(_) if folder.exists() => refuse("is not a folder"),
        Err(_) => Ok(()),
    }
}

/// Writes a frame as PNG, with the grey values as they are.
fn save(frame: &FrameBuffer, path: &Path) -> ImageResult<()> {
    let (width, height) = (frame.width as u32, frame.height as u32);
    let wrong_size = || {
        image::ImageError::Parameter(image::error::ParameterError::from_kind(
            image::error::ParameterErrorKind::DimensionMismatch,
        ))
    };
    if frame.bits > 8 {
        let picture: ImageBuffer<Luma<u16>, _> =
            ImageBuffer::from_raw(width, height, frame.mono16.clone()).ok_or_else(wrong_size)?;
        picture.save(path)
    } else {
        let picture: ImageBuffer<Luma<u8>, _> =
            ImageBuffer::from_raw(width, height, frame.mono8.clone()).ok_or_else(wrong_size)?;
        picture.save(path)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_drivers::sources;

    fn kept(id: u64, frame: FrameBuffer) -> Kept {
        Kept {
            stamp: FrameStamp {
                id,
                mid_exposure_ns: id as i64 * 1_000_000,
                exposure_ns: 0,
                arrival_ns: 0,
                true_um: f64::NAN,
                true_pzt_um: f64::NAN,
            },
            frame,
        }
    }

    #[test]
    fn a_recording_reads_back_pixel_by_pixel_with_its_gaps() {
        let folder = tempfile::tempdir().expect("a folder");
        let eight = |id: u64| FrameBuffer::of_mono8(6, 4, (0..24).map(|p| p + id as u8).collect());
        let deep = |id: u64| FrameBuffer {
            width: 6,
            height: 4,
            bits: 12,
            mono8: Vec::new(),
            mono16: (0..24).map(|p| 4000 - p - id as u16).collect(),
        };
        for (name, frame) in [
            ("eight", &eight as &dyn Fn(u64) -> FrameBuffer),
            ("deep", &deep),
        ] {
            let capture = Capture {
                camera: "a camera".to_string(),
                frames: [100, 101, 104].map(|id| kept(id, frame(id))).to_vec(),
                lost: 2,
                repeated: 0,
            };
            let out = folder.path().join(name);
            new_folder(&out).unwrap_or_else(|error| panic!("{error}"));
            let recorded = capture
                .write(&out)
                .unwrap_or_else(|error| panic!("{error}"));
            assert_eq!((recorded.frames, recorded.lost), (3, 2));
            assert!((recorded.rate_hz - 1000.0).abs() < 1e-6);
            assert!(new_folder(&out).is_err(), "it holds pictures now");
            let mut read = sources::open(&out).expect("a recording");
            assert_eq!((read.info().frames, read.info().lost), (3, 2));
            let mut buffer = FrameBuffer::default();
            for (n, id) in [100, 101, 104].into_iter().enumerate() {
                read.read(n, &mut buffer).expect("a frame");
                assert_eq!(buffer.mono8, frame(id).mono8);
                assert_eq!(buffer.mono16, frame(id).mono16);
                assert_eq!(read.number(n), id - 100);
            }
        }
    }
}
