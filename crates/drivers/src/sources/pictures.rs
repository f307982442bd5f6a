//! A folder of pictures, one a file: PNG, TIFF or JPEG, in the order of their names.
//!
//! Numbers in the names are frame numbers. A missing number is a lost frame, which the recording reports.

use super::grey::{self, Grey};
use super::{Recording, RecordingInfo, SourceError, check_same, check_size};
use cellpos_rig::source::FrameBuffer;
use image::{DynamicImage, ImageReader};
use std::path::{Path, PathBuf};

/// A folder of grey pictures of 8 or 16 bits, all of one size.
#[derive(Debug)]
pub struct PictureFolder {
    pictures: Vec<PathBuf>,
    /// Frame number of each picture, from 0.
    numbers: Vec<u64>,
    info: RecordingInfo,
}

/// Kinds of pictures.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Png,
    Tiff,
    Jpeg,
}

impl Kind {
    fn of(path: &Path) -> Option<Self> {
        let extension = path.extension()?.to_str()?.to_ascii_lowercase();
        match extension.as_str() {
            "png" => Some(Kind::Png),
            "tif" | "tiff" => Some(Kind::Tiff),
            "jpg" | "jpeg" => Some(Kind::Jpeg),
            _ => None,
        }
    }
}

impl PictureFolder {
    /// Opens a folder. Numbers in the names count as numbers: `f_9.png` comes before `f_10.png`.
    ///
    /// # Errors
    /// The folder cannot be read, holds no pictures or pictures of two kinds, or its first picture cannot be used.
    pub fn open(folder: &Path) -> Result<Self, SourceError> {
        let unreadable = |cause| SourceError::Unreadable {
            path: folder.to_path_buf(),
            cause,
        };
        let mut pictures = Vec::new();
        for entry in std::fs::read_dir(folder).map_err(unreadable)? {
            let path = entry.map_err(unreadable)?.path();
            if Kind::of(&path).is_some() && path.is_file() {
                pictures.push(path);
            }
        }
        let count = |kind| {
            pictures
                .iter()
                .filter(|p| Kind::of(p) == Some(kind))
                .count()
        };
        let kinds = [
            (Kind::Png, "PNG"),
            (Kind::Tiff, "TIFF"),
            (Kind::Jpeg, "JPEG"),
        ];
        let found: Vec<String> = kinds
            .iter()
            .map(|(kind, name)| (count(*kind), name))
            .filter(|(count, _)| *count > 0)
            .map(|(count, name)| format!("{count} {name}"))
            .collect();
        if found.len() > 1 {
            return Err(SourceError::TwoKinds {
                path: folder.to_path_buf(),
                found: found.join(" and "),
            });
        }
        pictures.sort_by_cached_key(|p| {
            natural_key(&p.file_name().unwrap_or_default().to_string_lossy())
        });
        Self::of(folder, pictures)
    }

    /// A recording of the given pictures, in the given order.
    ///
    /// # Errors
    /// There is no picture, or the first cannot be used.
    pub fn of(path: &Path, pictures: Vec<PathBuf>) -> Result<Self, SourceError> {
        let Some(first) = pictures.first() else {
            return Err(SourceError::Empty {
                path: path.to_path_buf(),
                expected: "the folder should hold .png, .tif or .jpg pictures",
            });
        };
        let kind = match Kind::of(first) {
            Some(Kind::Tiff) => "TIFF folder",
            Some(Kind::Jpeg) => "JPEG folder",
            _ => "PNG folder",
        };
        let mut buffer = FrameBuffer::default();
        let note = decode(first, 0, &mut buffer)?;
        let numbers = frame_numbers(&pictures);
        let info = RecordingInfo {
            path: path.to_path_buf(),
            kind,
            width_px: buffer.width,
            height_px: buffer.height,
            bits: buffer.bits,
            frames: pictures.len(),
            lost: numbers.last().map_or(0, |last| last + 1) - pictures.len() as u64,
            rate_hz: None,
            pixel_um: None,
            note,
        };
        Ok(PictureFolder {
            pictures,
            numbers,
            info,
        })
    }
}

impl Recording for PictureFolder {
    fn info(&self) -> &RecordingInfo {
        &self.info
    }

    fn number(&self, index: usize) -> u64 {
        self.numbers.get(index).copied().unwrap_or(index as u64)
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

fn decode(
    path: &Path,
    frame: usize,
    buffer: &mut FrameBuffer,
) -> Result<Option<&'static str>, SourceError> {
    match Kind::of(path) {
        Some(Kind::Tiff) => super::tiff::decode_file(path, frame, buffer),
        Some(Kind::Jpeg) => {
            let bytes = std::fs::read(path).map_err(|cause| SourceError::Unreadable {
                path: path.to_path_buf(),
                cause,
            })?;
            super::jpeg::decode(path, frame, &bytes, buffer)
        }
        _ => decode_png(path, frame, buffer),
    }
}

fn decode_png(
    path: &Path,
    frame: usize,
    buffer: &mut FrameBuffer,
) -> Result<Option<&'static str>, SourceError> {
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
    reader.limits(grey::limits());
    let picture = reader.decode().map_err(damaged)?;
    let (width, height) = (picture.width() as usize, picture.height() as usize);
    check_size(path, width, height)?;
    (buffer.width, buffer.height) = (width, height);
    let channels = usize::from(picture.color().channel_count());
    let alpha = picture.color().has_alpha();
    let values = match &picture {
        DynamicImage::ImageLuma8(p) => Grey::Eight(p.as_raw()),
        DynamicImage::ImageLumaA8(p) => Grey::Eight(p.as_raw()),
        DynamicImage::ImageRgb8(p) => Grey::Eight(p.as_raw()),
        DynamicImage::ImageRgba8(p) => Grey::Eight(p.as_raw()),
        DynamicImage::ImageLuma16(p) => Grey::Sixteen(p.as_raw()),
        DynamicImage::ImageLumaA16(p) => Grey::Sixteen(p.as_raw()),
        DynamicImage::ImageRgb16(p) => Grey::Sixteen(p.as_raw()),
        DynamicImage::ImageRgba16(p) => Grey::Sixteen(p.as_raw()),
        other => {
            return Err(grey::refuse(
                path,
                frame,
                format!("pixels of kind {:?}", other.color()),
            ));
        }
    };
    grey::take(path, frame, values, (channels, alpha), buffer)
}

/// Frame numbers, from 0, from the numbers at the end of the names, in steps of their smallest distance. Names without numbers,
/// or with equal ones, are counted instead.
fn frame_numbers(pictures: &[PathBuf]) -> Vec<u64> {
    let counted = || (0..pictures.len() as u64).collect();
    let Some(numbers) = pictures
        .iter()
        .map(|p| last_number(p))
        .collect::<Option<Vec<_>>>()
    else {
        return counted();
    };
    let same = numbers
        .iter()
        .all(|(text, _)| Some(text) == numbers.first().map(|n| &n.0));
    let rising = numbers.windows(2).all(|w| w[0].1 < w[1].1);
    let (Some((_, first)), true, true) = (numbers.first(), same, rising) else {
        return counted();
    };
    let step = numbers
        .windows(2)
        .map(|w| w[1].1 - w[0].1)
        .min()
        .unwrap_or(1);
    let whole = numbers.iter().all(|(_, n)| (n - first) % step == 0);
    // If most numbers are missing, the folder is a selection of pictures, not a recording with gaps.
    let span = numbers.last().map_or(0, |(_, last)| (last - first) / step) + 1;
    if !whole || span > 4 * pictures.len() as u64 {
        return counted();
    }
    numbers.iter().map(|(_, n)| (n - first) / step).collect()
}

/// The part of a name before its last number, and that number.
fn last_number(path: &Path) -> Option<(String, u64)> {
    let stem = path.file_stem()?.to_str()?;
    let end = stem.rfind(|c: char| c.is_ascii_digit())? + 1;
    let begin = stem[..end]
        .rfind(|c: char| !c.is_ascii_digit())
        .map_or(0, |at| {
            at + stem[at..].chars().next().map_or(1, char::len_utf8)
        });
    Some((stem[..begin].to_string(), stem[begin..end].parse().ok()?))
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

    #[test]
    fn a_missing_number_is_a_lost_frame_and_a_choice_of_pictures_is_not() {
        let paths = |numbers: &[u64]| -> Vec<PathBuf> {
            numbers
                .iter()
                .map(|n| PathBuf::from(format!("run2_{n:04}.tif")))
                .collect()
        };
        assert_eq!(frame_numbers(&paths(&[1, 2, 3, 6])), [0, 1, 2, 5]);
        assert_eq!(frame_numbers(&paths(&[10, 20, 30, 50])), [0, 1, 2, 4]);
        assert_eq!(frame_numbers(&paths(&[1, 900, 901])), [0, 1, 2]);
        assert_eq!(
            frame_numbers(&[PathBuf::from("a.png"), PathBuf::from("b.png")]),
            [0, 1]
        );
        let two = [PathBuf::from("a1.png"), PathBuf::from("b3.png")];
        assert_eq!(frame_numbers(&two), [0, 1]);
    }
}
