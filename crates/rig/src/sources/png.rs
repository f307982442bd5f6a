//! A folder of PNG pictures, in the order of their names.

use super::{MAX_PIXELS, Recording, RecordingInfo, SourceError, check_same, check_size};
use crate::source::FrameBuffer;
use image::{DynamicImage, ImageReader};
use std::path::{Path, PathBuf};

/// A folder of grey PNG pictures of 8 or 16 bits, all of one size.
#[derive(Debug)]
pub struct PngFolder {
    pictures: Vec<PathBuf>,
    info: RecordingInfo,
}

impl PngFolder {
    /// Opens a folder. Numbers in the names count as numbers: `f_9.png` comes before `f_10.png`.
    ///
    /// # Errors
    /// The folder cannot be read, holds no PNG, or its first picture cannot be used.
    pub fn open(folder: &Path) -> Result<Self, SourceError> {
        let unreadable = |cause| SourceError::Unreadable {
            path: folder.to_path_buf(),
            cause,
        };
        let mut pictures = Vec::new();
        for entry in std::fs::read_dir(folder).map_err(unreadable)? {
            let path = entry.map_err(unreadable)?.path();
            let is_png = path
                .extension()
                .is_some_and(|e| e.eq_ignore_ascii_case("png"));
            if is_png && path.is_file() {
                pictures.push(path);
            }
        }
        pictures.sort_by_cached_key(|p| {
            natural_key(&p.file_name().unwrap_or_default().to_string_lossy())
        });
        Self::of(folder, pictures)
    }

    /// A recording of the given pictures, in the given order.
    ///
    /// # Errors
    /// There is none, or the first cannot be used.
    pub fn of(path: &Path, pictures: Vec<PathBuf>) -> Result<Self, SourceError> {
        let Some(first) = pictures.first() else {
            return Err(SourceError::Empty {
                path: path.to_path_buf(),
                expected: "the folder should hold .png pictures",
            });
        };
        let mut buffer = FrameBuffer::default();
        decode(first, 0, &mut buffer)?;
        let info = RecordingInfo {
            path: path.to_path_buf(),
            kind: "PNG folder",
            width_px: buffer.width,
            height_px: buffer.height,
            bits: buffer.bits,
            frames: pictures.len(),
            rate_hz: None,
        };
        Ok(PngFolder { pictures, info })
    }
}

impl Recording for PngFolder {
    fn info(&self) -> &RecordingInfo {
        &self.info
    }

    fn read(&mut self, index: usize, buffer: &mut FrameBuffer) -> Result<(), SourceError> {
        let Some(path) = self.pictures.get(index) else {
            let (path, frames) = (self.info.path.clone(), self.info.frames);
            return Err(SourceError::NoSuchFrame {
                path,
                frame: index,
                frames,
            });
        };
        decode(path, index, buffer)?;
        check_same(&self.info, index, buffer.width, buffer.height)
    }
}

fn decode(path: &Path, frame: usize, buffer: &mut FrameBuffer) -> Result<(), SourceError> {
    let unreadable = |cause| SourceError::Unreadable {
        path: path.to_path_buf(),
        cause,
    };
    let damaged = |e: image::ImageError| SourceError::Damaged {
        path: path.to_path_buf(),
        frame,
        problem: e.to_string(),
    };
    let mut reader = ImageReader::open(path).map_err(unreadable)?;
    reader.set_format(image::ImageFormat::Png);
    let mut limits = image::Limits::default();
    limits.max_alloc = Some(16 * MAX_PIXELS as u64);
    reader.limits(limits);
    let picture = reader.decode().map_err(damaged)?;
    (buffer.width, buffer.height) = (picture.width() as usize, picture.height() as usize);
    check_size(path, buffer.width, buffer.height)?;
    match picture {
        DynamicImage::ImageLuma8(p) => {
            buffer.bits = 8;
            buffer.mono8.clear();
            buffer.mono8.extend_from_slice(p.as_raw());
        }
        DynamicImage::ImageLuma16(p) => {
            buffer.bits = 16;
            buffer.mono16.clear();
            buffer.mono16.extend_from_slice(p.as_raw());
        }
        other => {
            return Err(SourceError::PixelKind {
                path: path.to_path_buf(),
                frame,
                found: format!("pixels of kind {:?}", other.color()),
                expected: "grey pixels of 8 or 16 bits without transparency are needed",
            });
        }
    }
    Ok(())
}

/// A key that sorts digits by their value.
fn natural_key(name: &str) -> Vec<(u128, String)> {
    let mut key = Vec::new();
    let mut rest = name;
    while !rest.is_empty() {
        let text_end = rest
            .find(|c: char| c.is_ascii_digit())
            .unwrap_or(rest.len());
        let (text, after) = rest.split_at(text_end);
        let digits_end = after
            .find(|c: char| !c.is_ascii_digit())
            .unwrap_or(after.len());
        let (digits, after) = after.split_at(digits_end);
        key.push((0, text.to_string()));
        key.push((digits.parse().unwrap_or(u128::MAX), String::new()));
        rest = after;
    }
    key
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_in_names_count_as_numbers() {
        let mut names = ["f_10.png", "f_9.png", "a2.png", "f_1.png", "f_.png"];
        names.sort_by_cached_key(|n| natural_key(n));
        assert_eq!(
            names,
            ["a2.png", "f_1.png", "f_9.png", "f_10.png", "f_.png"]
        );
    }
}
