//! Recordings on disk as cameras: folders of PNG or TIFF pictures, TIFF stacks, Photron recordings, `.rtdc` files.
//!
//! [`open`] tells the kind by the name; [`Playback`] plays a recording at its frame rate behind the
//! [`Camera`](cellpos_rig::Camera) trait. Not for writing.

mod grey;
#[cfg(feature = "aravis")]
pub mod industrial;
pub mod photron;
pub mod pictures;
pub mod playback;
pub mod region;
#[cfg(feature = "hdf5")]
pub mod rtdc;
pub mod tiff;

use cellpos_rig::source::FrameBuffer;
use std::path::{Path, PathBuf};

pub use photron::PhotronRecording;
pub use pictures::PictureFolder;
pub use playback::Playback;
pub use region::Region;
pub use tiff::TiffStack;

/// Largest picture taken, pixels: a header that claims more is broken.
pub const MAX_PIXELS: usize = 1 << 26;

/// Why a recording, or a frame of it, cannot be read.
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
        "{}: not a recording: give a folder of PNG or TIFF pictures, a .tif or .tiff stack, a Photron .cihx, .cih or .mraw file, or an .rtdc file",
        path.display()
    )]
    UnknownKind {
        /// Which file.
        path: PathBuf,
    },
    /// A recording without frames.
    #[error("{}: no frames: {expected}", path.display())]
    Empty {
        /// Which file.
        path: PathBuf,
        /// What should have been there.
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
        /// What it is.
        found: String,
        /// What would be right.
        expected: &'static str,
    },
    /// A folder with pictures of two kinds.
    #[error("{}: {png} PNG and {tiff} TIFF pictures: give a folder with pictures of one kind", path.display())]
    TwoKinds {
        /// Which folder.
        path: PathBuf,
        /// PNG pictures.
        png: usize,
        /// TIFF pictures.
        tiff: usize,
    },
    /// A compression that is not read here.
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
    /// A frame without pixels, or of more than can be.
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
        /// What it says.
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
        /// What is wrong with it.
        problem: &'static str,
    },
}

/// What a recording says of itself.
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
    /// Frame rate, when the recording says so, Hz.
    pub rate_hz: Option<f64>,
    /// Size of a pixel, when the recording says so, um.
    pub pixel_um: Option<f64>,
    /// What is to be said of how it was read.
    pub note: Option<&'static str>,
}

/// A recording: frames by number.
pub trait Recording: Send + std::fmt::Debug {
    /// What the recording says of itself.
    fn info(&self) -> &RecordingInfo;

    /// Number of the frame `index`, from 0: larger where frames before it were lost.
    fn number(&self, index: usize) -> u64 {
        index as u64
    }

    /// The empty scene, where the recording holds it or enough frames to tell it.
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

/// Opens a recording of any known kind and checks its first frame.
///
/// # Errors
/// The path is no recording, or cannot be read.
pub fn open(path: &Path) -> Result<Box<dyn Recording>, SourceError> {
    if path.is_dir() {
        return Ok(Box::new(PictureFolder::open(path)?));
    }
    let extension = path
        .extension()
        .and_then(|e| e.to_str())
        .unwrap_or_default()
        .to_ascii_lowercase();
    match extension.as_str() {
        "tif" | "tiff" => Ok(Box::new(TiffStack::open(path)?)),
        "mraw" | "cih" | "cihx" => Ok(Box::new(PhotronRecording::open(path)?)),
        #[cfg(feature = "hdf5")]
        "rtdc" => Ok(Box::new(rtdc::RtdcRecording::open(path)?)),
        "png" => Ok(Box::new(PictureFolder::of(path, vec![path.to_path_buf()])?)),
        _ if !path.exists() => Err(SourceError::Unreadable {
            path: path.to_path_buf(),
            cause: std::io::Error::new(std::io::ErrorKind::NotFound, "no such file or folder"),
        }),
        _ => Err(SourceError::UnknownKind {
            path: path.to_path_buf(),
        }),
    }
}

/// Refuses sizes that cannot be.
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
