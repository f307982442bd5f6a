//! Recordings on disk as cameras: folders of PNG, TIFF or JPEG pictures, TIFF stacks, Photron recordings, AVI films, NumPy
//! arrays, `.rtdc` files.
//!
//! [`open`] recognises the kind by the first bytes, or else by the name; [`Playback`] plays a recording at its frame rate behind the
//! [`Camera`](cellpos_rig::Camera) trait. Not for writing.

pub mod avi;
mod format;
mod grey;
#[cfg(feature = "aravis")]
pub mod industrial;
mod jpeg;
pub mod npy;
pub mod photron;
pub mod pictures;
pub mod playback;
pub mod region;
#[cfg(feature = "hdf5")]
pub mod rtdc;
pub mod tiff;
#[cfg(feature = "hdf5")]
mod zstandard;

use cellpos_rig::source::FrameBuffer;
use std::path::{Path, PathBuf};

pub use avi::AviFilm;
use format::Format;
pub(crate) use format::conversion;
pub use npy::NpyStack;
pub use photron::PhotronRecording;
pub use pictures::PictureFolder;
pub use playback::Playback;
pub use region::Region;
pub use tiff::TiffStack;

/// Largest accepted picture, pixels: a header that claims more is damaged.
pub const MAX_PIXELS: usize = 1 << 26;

/// The reason why a recording or one of its frames cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum SourceError {
    /// The file or folder cannot be opened or read.
    #[error("{}: cannot read: {cause}", path.display())]
    Unreadable {
        /// Which file.
        path: PathBuf,
        /// What the operating system said.
        cause: std::io::Error,
    },
    /// No known kind of recording.
    #[error(
        "{}: not a recording: give a folder of PNG, TIFF or JPEG pictures, a .tif or .tiff stack, a Photron .cihx, .cih or .mraw file, an .avi film, an .npy array, or an .rtdc file",
        path.display()
    )]
    UnknownKind {
        /// Which file.
        path: PathBuf,
    },
    /// A film or stack in an unsupported format.
    #[error("{}: {format} is not read here: convert it without loss with `{command}` and give what it writes", path.display())]
    Film {
        /// Which file.
        path: PathBuf,
        /// The format, with its codec if known.
        format: String,
        /// The command that converts it.
        command: String,
    },
    /// A recording without frames.
    #[error("{}: no frames: {expected}", path.display())]
    Empty {
        /// Which file.
        path: PathBuf,
        /// The expected content.
        expected: &'static str,
    },
    /// The file ends, or its data break off, before the frame is whole.
    #[error("{}: frame {frame} is cut off or damaged ({problem}): copy the recording again", path.display())]
    Damaged {
        /// Which file.
        path: PathBuf,
        /// Which frame, from 0.
        frame: usize,
        /// What is missing.
        problem: String,
    },
    /// Pixels of a kind that is not grey, or of a bit depth not understood.
    #[error("{}: frame {frame} has {found}: {expected}", path.display())]
    PixelKind {
        /// Which file.
        path: PathBuf,
        /// Which frame, from 0.
        frame: usize,
        /// The value found.
        found: String,
        /// What would be right.
        expected: &'static str,
    },
    /// A folder with pictures of two kinds.
    #[error("{}: {found} pictures: give a folder with pictures of one kind", path.display())]
    TwoKinds {
        /// Which folder.
        path: PathBuf,
        /// How many of each kind.
        found: String,
    },
    /// An unsupported compression.
    #[error(
        "{}: frame {frame} is compressed by {name} (method {method}): save it uncompressed, or with LZW, Deflate or PackBits",
        path.display()
    )]
    Compression {
        /// Which file.
        path: PathBuf,
        /// Which frame, from 0.
        frame: usize,
        /// Number of the method.
        method: u16,
        /// Its name.
        name: &'static str,
    },
    /// A frame with no pixels or with too many.
    #[error("{}: frames of {width} x {height} px: from 1 x 1 to 2^26 pixels are possible", path.display())]
    Size {
        /// Which file.
        path: PathBuf,
        /// Pixels per row.
        width: usize,
        /// Rows.
        height: usize,
    },
    /// A frame of another size than the first.
    #[error("{}: frame {frame} has {width} x {height} px, the first has {first_width} x {first_height} px", path.display())]
    SizeChanges {
        /// Which file.
        path: PathBuf,
        /// Which frame, from 0.
        frame: usize,
        /// Its width, px.
        width: usize,
        /// Its height, px.
        height: usize,
        /// Width of the first, px.
        first_width: usize,
        /// Height of the first, px.
        first_height: usize,
    },
    /// A frame number beyond the end.
    #[error("{}: there is no frame {frame}: the recording has {frames}", path.display())]
    NoSuchFrame {
        /// Which file.
        path: PathBuf,
        /// Which frame, from 0.
        frame: usize,
        /// Frames there are.
        frames: usize,
    },
    /// A key of the header is missing or cannot be used.
    #[error("{}: {key} = {value}: must be {must_be}", path.display())]
    Header {
        /// Which file.
        path: PathBuf,
        /// Which key.
        key: &'static str,
        /// Its text.
        value: String,
        /// What would be right.
        must_be: &'static str,
    },
    /// A region that is empty or reaches out of the frame.
    #[error("region {region} of a frame of {width} x {height} px: {problem}")]
    Region {
        /// The region.
        region: Region,
        /// Width of the frame, px.
        width: usize,
        /// Height of the frame, px.
        height: usize,
        /// The error of the region.
        problem: &'static str,
    },
}

/// Description of a recording.
#[derive(Debug, Clone, PartialEq)]
pub struct RecordingInfo {
    /// File or folder.
    pub path: PathBuf,
    /// Kind of recording.
    pub kind: &'static str,
    /// Pixels per row.
    pub width_px: usize,
    /// Rows.
    pub height_px: usize,
    /// Bits per pixel.
    pub bits: u16,
    /// Frames.
    pub frames: usize,
    /// Frames between them that are missing.
    pub lost: u64,
    /// Frame rate, if the recording states it, Hz.
    pub rate_hz: Option<f64>,
    /// Size of a pixel, if the recording states it, um.
    pub pixel_um: Option<f64>,
    /// Notes on the reading of the recording.
    pub note: Option<&'static str>,
}

/// A recording: frames by number.
pub trait Recording: Send + std::fmt::Debug {
    /// Description of the recording.
    fn info(&self) -> &RecordingInfo;

    /// Number of the frame `index`, from 0: larger where frames before it were lost.
    fn number(&self, index: usize) -> u64 {
        index as u64
    }

    /// The empty scene, if the recording holds it or enough frames to compute it.
    ///
    /// # Errors
    /// It is there but damaged.
    fn background(&mut self) -> Result<Option<FrameBuffer>, SourceError> {
        Ok(None)
    }

    /// Reads the frame `index` (from 0) into `buffer`.
    ///
    /// # Errors
    /// The frame is not there, damaged, or not like the first.
    fn read(&mut self, index: usize, buffer: &mut FrameBuffer) -> Result<(), SourceError>;
}

/// Opens a recording of any known kind and checks its first frame. What a file is, its first bytes say; its name says it where they
/// do not.
///
/// # Errors
/// The path is not a recording, or cannot be read.
pub fn open(path: &Path) -> Result<Box<dyn Recording>, SourceError> {
    if path.is_dir() {
        return Ok(Box::new(PictureFolder::open(path)?));
    }
    let format = Format::of(path).map_err(|cause| SourceError::Unreadable {
        path: path.to_path_buf(),
        cause,
    })?;
    match format {
        Some(Format::Tiff) => Ok(Box::new(TiffStack::open(path)?)),
        Some(Format::Photron) => Ok(Box::new(PhotronRecording::open(path)?)),
        #[cfg(feature = "hdf5")]
        Some(Format::Rtdc) => Ok(Box::new(rtdc::RtdcRecording::open(path)?)),
        Some(Format::Picture) => Ok(Box::new(PictureFolder::of(path, vec![path.to_path_buf()])?)),
        Some(Format::Avi) => Ok(Box::new(AviFilm::open(path)?)),
        Some(Format::Npy) => Ok(Box::new(NpyStack::open(path)?)),
        Some(Format::Other(other)) => Err(SourceError::Film {
            path: path.to_path_buf(),
            format: other.name().to_string(),
            command: other.conversion(path),
        }),
        _ => Err(SourceError::UnknownKind {
            path: path.to_path_buf(),
        }),
    }
}

/// Refuses a frame beyond the end.
pub(crate) fn no_such_frame(info: &RecordingInfo, frame: usize) -> Result<(), SourceError> {
    if frame < info.frames {
        return Ok(());
    }
    Err(SourceError::NoSuchFrame {
        path: info.path.clone(),
        frame,
        frames: info.frames,
    })
}

/// Fills a buffer with a frame's bytes in the order of the file.
pub(crate) fn fill(info: &RecordingInfo, bytes: &[u8], big_endian: bool, buffer: &mut FrameBuffer) {
    (buffer.width, buffer.height, buffer.bits) = (info.width_px, info.height_px, info.bits);
    if info.bits == 8 {
        buffer.mono8.clear();
        buffer.mono8.extend_from_slice(bytes);
        return;
    }
    let words = bytes.as_chunks::<2>().0.iter();
    buffer.mono16.clear();
    if big_endian {
        buffer.mono16.extend(words.map(|b| u16::from_be_bytes(*b)));
    } else {
        buffer.mono16.extend(words.map(|b| u16::from_le_bytes(*b)));
    }
}

/// Refuses invalid sizes.
pub(crate) fn check_size(path: &Path, width: usize, height: usize) -> Result<(), SourceError> {
    match width.checked_mul(height) {
        Some(n) if (1..=MAX_PIXELS).contains(&n) => Ok(()),
        _ => Err(SourceError::Size {
            path: path.to_path_buf(),
            width,
            height,
        }),
    }
}

/// Refuses a frame of another size than the recording's.
pub(crate) fn check_same(
    info: &RecordingInfo,
    frame: usize,
    width: usize,
    height: usize,
) -> Result<(), SourceError> {
    if (width, height) == (info.width_px, info.height_px) {
        return Ok(());
    }
    Err(SourceError::SizeChanges {
        path: info.path.clone(),
        frame,
        width,
        height,
        first_width: info.width_px,
        first_height: info.height_px,
    })
}
