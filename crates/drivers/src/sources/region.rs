//! A part of the frame: read out by a camera, or used of a recording.

use super::SourceError;
use cellpos_rig::source::FrameBuffer;
use serde::{Deserialize, Serialize};

/// A rectangle of pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Region {
    /// First column, px.
    pub x_px: usize,
    /// First row, px.
    pub y_px: usize,
    /// Columns, px.
    pub width_px: usize,
    /// Rows, px.
    pub height_px: usize,
}

impl std::fmt::Display for Region {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "{}x{}+{}+{}",
            self.width_px, self.height_px, self.x_px, self.y_px
        )
    }
}

/// A text that is not a region.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{text:?} is no region: write WIDTHxHEIGHT+X+Y in pixels, such as 64x64+200+120")]
pub struct RegionTextError {
    /// The text.
    pub text: String,
}

impl std::str::FromStr for Region {
    type Err = RegionTextError;

    fn from_str(text: &str) -> Result<Self, RegionTextError> {
        let parse = || {
            let (size, place) = text.split_once('+')?;
            let (width, height) = size.split_once('x')?;
            let (x, y) = place.split_once('+')?;
            Some(Region {
                x_px: x.parse().ok()?,
                y_px: y.parse().ok()?,
                width_px: width.parse().ok()?,
                height_px: height.parse().ok()?,
            })
        };
        parse().ok_or_else(|| RegionTextError {
            text: text.to_string(),
        })
    }
}

impl Region {
    /// Refuses a region that is empty or reaches out of a frame of `width` x `height` px.
    ///
    /// # Errors
    /// [`SourceError::Region`].
    pub fn check(&self, width: usize, height: usize) -> Result<(), SourceError> {
        let refuse = |problem| {
            Err(SourceError::Region {
                region: *self,
                width,
                height,
                problem,
            })
        };
        if self.width_px == 0 || self.height_px == 0 {
            return refuse("it holds no pixel");
        }
        let inside = |first: usize, len: usize, of: usize| {
            first.checked_add(len).is_some_and(|end| end <= of)
        };
        if !inside(self.x_px, self.width_px, width) || !inside(self.y_px, self.height_px, height) {
            return refuse("it reaches beyond the frame");
        }
        Ok(())
    }

    /// Cuts a frame down to the region, in place.
    ///
    /// # Errors
    /// [`SourceError::Region`].
    pub fn cut(&self, buffer: &mut FrameBuffer) -> Result<(), SourceError> {
        self.check(buffer.width, buffer.height)?;
        if buffer.bits > 8 {
            self.keep(&mut buffer.mono16, buffer.width);
        } else {
            self.keep(&mut buffer.mono8, buffer.width);
        }
        (buffer.width, buffer.height) = (self.width_px, self.height_px);
        Ok(())
    }

    fn keep<T: Copy>(&self, pixels: &mut Vec<T>, width: usize) {
        // Rows move towards the front, so that none is overwritten before it has been read.
        for j in 0..self.height_px {
            let from = (self.y_px + j) * width + self.x_px;
            if from + self.width_px <= pixels.len() {
                pixels.copy_within(from..from + self.width_px, j * self.width_px);
            }
        }
        pixels.truncate(self.width_px * self.height_px);
    }
}
