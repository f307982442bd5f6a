//! A TIFF file of several pages.

use super::{MAX_PIXELS, Recording, RecordingInfo, SourceError, check_same, check_size};
use crate::source::FrameBuffer;
use std::fs::File;
use std::io::BufReader;
use std::path::Path;
use tiff::ColorType;
use tiff::TiffError;
use tiff::decoder::{Decoder, DecodingResult, Limits};

/// Most pages counted: a damaged file can chain its pages in a circle.
const MAX_PAGES: usize = 1 << 22;

/// A TIFF stack of grey pages of 8 to 16 bits, all of one size.
pub struct TiffStack {
    decoder: Decoder<BufReader<File>>,
    /// The page that the decoder stands at.
    page: usize,
    info: RecordingInfo,
}

impl std::fmt::Debug for TiffStack {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("TiffStack")
            .field("page", &self.page)
            .field("info", &self.info)
            .finish_non_exhaustive()
    }
}

impl TiffStack {
    /// Opens a stack, reads its first page and counts the others.
    ///
    /// # Errors
    /// The file cannot be read, or its first page cannot be used.
    pub fn open(path: &Path) -> Result<Self, SourceError> {
        let mut decoder = decoder(path)?;
        let mut info = RecordingInfo {
            path: path.to_path_buf(),
            kind: "TIFF stack",
            width_px: 0,
            height_px: 0,
            bits: 0,
            frames: 1,
            rate_hz: None,
        };
        let mut buffer = FrameBuffer::default();
        decode(&mut decoder, &info, 0, &mut buffer)?;
        (info.width_px, info.height_px, info.bits) = (buffer.width, buffer.height, buffer.bits);
        while decoder.more_images() && info.frames < MAX_PAGES {
            // A page whose directory cannot be read ends the stack here; reading it will say why.
            let readable = decoder.next_image().is_ok();
            info.frames += 1;
            if !readable {
                break;
            }
        }
        Ok(TiffStack {
            decoder: self::decoder(path)?,
            page: 0,
            info,
        })
    }
}

impl Recording for TiffStack {
    fn info(&self) -> &RecordingInfo {
        &self.info
    }

    fn read(&mut self, index: usize, buffer: &mut FrameBuffer) -> Result<(), SourceError> {
        let damaged = |e: TiffError| damage(&self.info.path, index, &e);
        if index >= self.info.frames {
            let (path, frames) = (self.info.path.clone(), self.info.frames);
            return Err(SourceError::NoSuchFrame {
                path,
                frame: index,
                frames,
            });
        }
        if index == self.page + 1 {
            self.decoder.next_image().map_err(damaged)?;
        } else if index != self.page {
            self.decoder.seek_to_image(index).map_err(damaged)?;
        }
        self.page = index;
        decode(&mut self.decoder, &self.info, index, buffer)?;
        check_same(&self.info, index, buffer.width, buffer.height)
    }
}

fn damage(path: &Path, frame: usize, error: &TiffError) -> SourceError {
    SourceError::Damaged {
        path: path.to_path_buf(),
        frame,
        problem: error.to_string(),
    }
}

fn decoder(path: &Path) -> Result<Decoder<BufReader<File>>, SourceError> {
    let file = File::open(path).map_err(|cause| SourceError::Unreadable {
        path: path.to_path_buf(),
        cause,
    })?;
    let mut limits = Limits::default();
    limits.decoding_buffer_size = 2 * MAX_PIXELS;
    limits.intermediate_buffer_size = 2 * MAX_PIXELS;
    limits.ifd_value_size = 1 << 20;
    let decoder = Decoder::new(BufReader::new(file)).map_err(|e| damage(path, 0, &e))?;
    Ok(decoder.with_limits(limits))
}

fn decode(
    decoder: &mut Decoder<BufReader<File>>,
    info: &RecordingInfo,
    frame: usize,
    buffer: &mut FrameBuffer,
) -> Result<(), SourceError> {
    let path = &info.path;
    let damaged = |e: TiffError| damage(path, frame, &e);
    let (width, height) = decoder.dimensions().map_err(damaged)?;
    let (width, height) = (width as usize, height as usize);
    check_size(path, width, height)?;
    let kind = decoder.colortype().map_err(damaged)?;
    let refuse = |found: String| SourceError::PixelKind {
        path: path.clone(),
        frame,
        found,
        expected: "grey pixels of 8 or 16 bits without transparency are needed",
    };
    let ColorType::Gray(8 | 16) = kind else {
        return Err(refuse(format!("pixels of kind {kind:?}")));
    };
    let pixels = decoder.read_image().map_err(damaged)?;
    let held = match pixels {
        DecodingResult::U8(p) => {
            buffer.bits = 8;
            buffer.mono8.clear();
            buffer.mono8.extend_from_slice(&p);
            p.len()
        }
        DecodingResult::U16(p) => {
            buffer.bits = 16;
            buffer.mono16.clear();
            buffer.mono16.extend_from_slice(&p);
            p.len()
        }
        _ => return Err(refuse("signed or floating-point pixels".to_string())),
    };
    if held != width * height {
        let problem = format!("{held} pixels of {}", width * height);
        return Err(SourceError::Damaged {
            path: path.clone(),
            frame,
            problem,
        });
    }
    (buffer.width, buffer.height) = (width, height);
    Ok(())
}
