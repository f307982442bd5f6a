//! Recordings of deformability cytometers (`.rtdc`): HDF5 with one picture per event, its background, and the instrument's camera and
//! pixel size.
//!
//! Read: `events/image`, `events/image_bg`, `events/frame`, and of the root's attributes `imaging:pixel size` and
//! `imaging:frame rate`. Masks and features of the instrument are not used: vision measures independently.

use super::zstandard::Rows;
use super::{Recording, RecordingInfo, SourceError, check_size};
use cellpos_rig::source::FrameBuffer;
use hdf5_pure::{AttrValue, Error, File};
use std::io::Read;
use std::path::{Path, PathBuf};

/// Most backgrounds that are averaged, and pictures of which a median is taken where the file holds none.
const MOST_BACKGROUNDS: usize = 64;
/// Filters that occur in such files but are not supported.
const FILTERS: [(u16, &str); 4] = [
    (307, "bzip2"),
    (32_001, "Blosc"),
    (32_004, "LZ4"),
    (32_008, "Bitshuffle"),
];

/// An `.rtdc` file.
#[derive(Debug)]
pub struct RtdcRecording {
    info: RecordingInfo,
    pictures: Rows,
    backgrounds: Option<Rows>,
    /// Numbers of the frames, if they grow.
    numbers: Vec<u64>,
}

/// Refuses a file that ends before the address that its superblock gives as its end (HDF5 file format, versions 0 to 3). Of a file cut
/// off nothing else can be trusted: the list of what it holds may be in what is missing.
fn check_whole(path: &Path) -> Result<(), SourceError> {
    const SIGNATURE: &[u8] = b"\x89HDF\r\n\x1a\n";
    let unreadable = |cause| SourceError::Unreadable {
        path: path.to_path_buf(),
        cause,
    };
    let file = std::fs::File::open(path).map_err(unreadable)?;
    let length = file.metadata().map_err(unreadable)?.len();
    let mut head = Vec::new();
    file.take(64).read_to_end(&mut head).map_err(unreadable)?;
    let version = head.get(8).copied();
    // Sizes of addresses, where the addresses begin, and which of them is the end of the file.
    let (size_at, first, which) = match version {
        Some(0) => (13, 24, 2),
        Some(1) => (13, 28, 2),
        Some(2 | 3) => (9, 12, 2),
        _ => return Ok(()),
    };
    let is_wide = head.starts_with(SIGNATURE) && head.get(size_at) == Some(&8);
    let Some(end) = head.get(first + 8 * which..first + 8 * which + 8) else {
        return Ok(());
    };
    let end = u64::from_le_bytes(end.try_into().unwrap_or_default());
    if is_wide && length < end {
        return Err(SourceError::Damaged {
            path: path.to_path_buf(),
            frame: 0,
            problem: format!("the file has {length} of {end} bytes"),
        });
    }
    Ok(())
}

impl RtdcRecording {
    /// Opens the file and reads its first picture.
    ///
    /// # Errors
    /// No HDF5, no pictures, pixels of another kind than 8 or 16 bits, a compression that is not read.
    pub fn open(path: &Path) -> Result<Self, SourceError> {
        std::fs::File::open(path).map_err(|cause| SourceError::Unreadable {
            path: path.to_path_buf(),
            cause,
        })?;
        check_whole(path)?;
        let wrong = |error: Error| source_error(path, 0, &error);
        let file = File::open_streaming(path).map_err(wrong)?;
        let events = file.group("events").and_then(|events| events.datasets());
        let held = |name: &str| {
            events
                .as_ref()
                .is_ok_and(|names| names.iter().any(|n| n == name))
        };
        // Damaged parts are reported; parts that were never saved are optional.
        let source = path;
        let dataset = |name: &str| {
            let path = format!("events/{name}");
            let found = held(name).then(|| Rows::new(file.dataset(&path)?, source));
            found.transpose().map_err(wrong)
        };
        let Some(pictures) = dataset("image")? else {
            return Err(SourceError::Empty {
                path: path.to_path_buf(),
                expected: "an .rtdc file with events/image is needed, as the instrument saves it with images",
            });
        };
        let shape = pictures.shape().map_err(wrong)?;
        let [frames, height, width] = shape[..] else {
            return Err(SourceError::PixelKind {
                path: path.to_path_buf(),
                frame: 0,
                found: format!("events/image of {} dimensions", shape.len()),
                expected: "event, row, column are needed",
            });
        };
        let (width, height) = (width as usize, height as usize);
        check_size(path, width, height)?;
        if frames == 0 {
            return Err(SourceError::Empty {
                path: path.to_path_buf(),
                expected: "events/image holds no event",
            });
        }
        let attributes = file.root().attrs().unwrap_or_default();
        let number = |key: &str| {
            let value = attributes.get(key).and_then(number)?;
            (value.is_finite() && value > 0.0).then_some(value)
        };
        let numbers = match dataset("frame")? {
            Some(mut frames) => frames.numbers().map_err(wrong)?,
            None => Vec::new(),
        };
        let backgrounds = dataset("image_bg")?;
        let alike = |other: &Rows| other.shape().is_ok_and(|own| own == shape);
        let mut recording = RtdcRecording {
            info: RecordingInfo {
                path: path.to_path_buf(),
                kind: "deformability cytometer recording (.rtdc)",
                width_px: width,
                height_px: height,
                bits: 8,
                frames: frames as usize,
                lost: 0,
                rate_hz: number("imaging:frame rate"),
                pixel_um: number("imaging:pixel size"),
                note: None,
            },
            pictures,
            backgrounds: backgrounds.filter(alike),
            numbers: growing(&numbers, frames as usize),
        };
        let mut first = FrameBuffer::default();
        recording.read(0, &mut first)?;
        recording.info.bits = first.bits;
        Ok(recording)
    }

    fn take(
        info: &RecordingInfo,
        from: &mut Rows,
        index: usize,
        to: &mut FrameBuffer,
    ) -> Result<(), SourceError> {
        let wrong = |error: Error| source_error(&info.path, index, &error);
        let pixels = info.width_px * info.height_px;
        (to.width, to.height) = (info.width_px, info.height_px);
        let bytes = from.element_size().map_err(wrong)?;
        let row = index as u64;
        let read = match bytes {
            1 => {
                (to.bits, to.mono8) = (8, from.bytes(row).map_err(wrong)?);
                to.mono8.len()
            }
            2 => {
                (to.bits, to.mono16) = (16, from.words(row).map_err(wrong)?);
                to.mono16.len()
            }
            _ => 0,
        };
        if read != pixels {
            return Err(SourceError::PixelKind {
                path: info.path.clone(),
                frame: index,
                found: format!("{read} of {pixels} pixels, of {bytes} bytes each"),
                expected: "pixels of 8 or 16 bits are needed",
            });
        }
        Ok(())
    }
}

impl Recording for RtdcRecording {
    fn info(&self) -> &RecordingInfo {
        &self.info
    }

    fn number(&self, index: usize) -> u64 {
        self.numbers.get(index).copied().unwrap_or(index as u64)
    }

    fn read(&mut self, index: usize, buffer: &mut FrameBuffer) -> Result<(), SourceError> {
        if index >= self.info.frames {
            return Err(SourceError::NoSuchFrame {
                path: self.info.path.clone(),
                frame: index,
                frames: self.info.frames,
            });
        }
        Self::take(&self.info, &mut self.pictures, index, buffer)
    }

    fn background(&mut self) -> Result<Option<FrameBuffer>, SourceError> {
        let count = self.info.frames.min(MOST_BACKGROUNDS);
        let from = self.backgrounds.as_mut().unwrap_or(&mut self.pictures);
        let mut frames = vec![FrameBuffer::default(); count];
        for (k, frame) in frames.iter_mut().enumerate() {
            Self::take(&self.info, from, k * self.info.frames / count, frame)?;
        }
        Ok(median(&frames))
    }
}

/// Median of each pixel, which a cell in a few frames does not change.
fn median(frames: &[FrameBuffer]) -> Option<FrameBuffer> {
    let first = frames.first()?;
    let mut values = Vec::with_capacity(frames.len());
    let mut middle = |k: usize| {
        values.clear();
        values.extend(frames.iter().filter_map(|frame| {
            let eight = frame.mono8.get(k).map(|v| u16::from(*v));
            eight.or_else(|| frame.mono16.get(k).copied())
        }));
        values.sort_unstable();
        values.get(values.len() / 2).copied().unwrap_or(0)
    };
    let mut picture = FrameBuffer {
        mono8: Vec::new(),
        mono16: Vec::new(),
        ..first.clone()
    };
    let pixels = first.width * first.height;
    if first.bits <= 8 {
        picture.mono8 = (0..pixels).map(|k| middle(k) as u8).collect();
    } else {
        picture.mono16 = (0..pixels).map(middle).collect();
    }
    Some(picture)
}

/// Frame numbers from the first on, if there is one for each event and they grow; else none.
fn growing(numbers: &[f64], events: usize) -> Vec<u64> {
    let (Some(first), true) = (numbers.first(), numbers.len() == events) else {
        return Vec::new();
    };
    if numbers.windows(2).all(|pair| pair[0] < pair[1]) {
        numbers.iter().map(|n| (n - first) as u64).collect()
    } else {
        Vec::new()
    }
}

fn number(value: &AttrValue) -> Option<f64> {
    match value {
        AttrValue::String(text) => text.trim().parse().ok(),
        other => other.as_f64(),
    }
}

fn source_error(path: &Path, frame: usize, error: &Error) -> SourceError {
    let (path, problem) = (PathBuf::from(path), error.to_string());
    let named = FILTERS
        .iter()
        .find(|(method, _)| problem.contains(&method.to_string()) && problem.contains("filter"));
    match named {
        Some(&(method, name)) => SourceError::Compression {
            path,
            frame,
            method,
            name,
        },
        None => SourceError::Damaged {
            path,
            frame,
            problem,
        },
    }
}
