//! Frames of the empty channel, from which vision separates cells: recorded once per setting of the camera, kept as a stack.
//!
//! All frames are kept, not only their mean. Their scatter is the noise that sets the threshold for a cell, and frames with a
//! passing object are found and named.

use crate::sources::{self, SourceError};
use cellpos_rig::source::FrameBuffer;
use cellpos_vision::{CellConfig, CellError, CellFinder, ConfigError};
use std::fs::OpenOptions;
use std::path::{Path, PathBuf};
use tiff::encoder::{TiffEncoder, colortype};

/// The reason why there is no background.
#[derive(Debug, thiserror::Error)]
pub enum BackgroundError {
    /// The recording cannot be read.
    #[error(transparent)]
    Source(#[from] SourceError),
    /// A setting of the finder.
    #[error("[cell.finder] {0}")]
    Config(#[from] ConfigError),
    /// A frame that cannot be taken.
    #[error("{from}: frame {frame}: {problem}")]
    Frame {
        /// Where the frames come from.
        from: String,
        /// Which, from 0.
        frame: usize,
        /// Why.
        problem: CellError,
    },
    /// Not enough frames to know the noise.
    #[error("{from}: {frames} frames of the empty channel: 2 or more are needed, 100 are better")]
    TooFew {
        /// Where the frames come from.
        from: String,
        /// How many there are.
        frames: usize,
    },
    /// Something moved.
    #[error(
        "{from}: frame {frame} differs from the others by {area_px:.0} px about x = {x_px:.0}, y = {y_px:.0} px: the channel \
         was not empty, the light changed, or the pictures were compressed with loss"
    )]
    NotEmpty {
        /// Where the frames come from.
        from: String,
        /// Which, from 0.
        frame: usize,
        /// Position of the difference, px.
        x_px: f64,
        /// Position of the difference, px.
        y_px: f64,
        /// Its area, px.
        area_px: f64,
    },
    /// The file is there already, or cannot be written.
    #[error("{}: cannot write: {cause}", path.display())]
    Write {
        /// Which file.
        path: PathBuf,
        /// What went wrong.
        cause: String,
    },
}

/// A finder with the empty channel from frames; `from` names them in messages.
///
/// # Errors
/// Too few frames, frames of different size, or frames in which something moved.
pub fn finder(
    frames: &[FrameBuffer],
    from: &str,
    config: CellConfig,
) -> Result<CellFinder, BackgroundError> {
    let first =
        frames
            .first()
            .filter(|_| frames.len() > 1)
            .ok_or_else(|| BackgroundError::TooFew {
                from: from.to_string(),
                frames: frames.len(),
            })?;
    let mut finder = CellFinder::new(first.width, first.height, config)?;
    let wrong = |frame, problem| BackgroundError::Frame {
        from: from.to_string(),
        frame,
        problem,
    };
    for (n, frame) in frames.iter().enumerate() {
        finder
            .take_background(&frame.frame())
            .map_err(|problem| wrong(n, problem))?;
    }
    for (n, frame) in frames.iter().enumerate() {
        let found = finder
            .find(&frame.frame())
            .map_err(|problem| wrong(n, problem))?;
        if let Some(cell) = found.first() {
            return Err(BackgroundError::NotEmpty {
                from: from.to_string(),
                frame: n,
                x_px: cell.x_px,
                y_px: cell.y_px,
                area_px: cell.area_px,
            });
        }
    }
    Ok(finder)
}

/// The same from a recording.
///
/// # Errors
/// As [`finder`], or the recording cannot be read.
pub fn load(path: &Path, config: CellConfig) -> Result<CellFinder, BackgroundError> {
    let mut recording = sources::open(path)?;
    let mut frames = Vec::new();
    for n in 0..recording.info().frames {
        let mut frame = FrameBuffer::default();
        recording.read(n, &mut frame)?;
        frames.push(frame);
    }
    finder(&frames, &path.display().to_string(), config)
}

/// Writes frames as a new TIFF stack of 8 or 16 bits.
///
/// # Errors
/// The file is there already, or cannot be written.
pub fn save(path: &Path, frames: &[FrameBuffer]) -> Result<(), BackgroundError> {
    let failed = |cause: &dyn std::fmt::Display| BackgroundError::Write {
        path: path.to_path_buf(),
        cause: cause.to_string(),
    };
    let mut options = OpenOptions::new();
    let file = options
        .write(true)
        .create_new(true)
        .open(path)
        .map_err(|e| failed(&e))?;
    let mut stack = TiffEncoder::new(&file).map_err(|e| failed(&e))?;
    for frame in frames {
        let (width, height) = (frame.width as u32, frame.height as u32);
        if frame.bits > 8 {
            stack.write_image::<colortype::Gray16>(width, height, &frame.mono16)
        } else {
            stack.write_image::<colortype::Gray8>(width, height, &frame.mono8)
        }
        .map_err(|e| failed(&e))?;
    }
    file.sync_all().map_err(|e| failed(&e))
}
