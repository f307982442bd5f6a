//! Which kind of recording a file is, and the command that converts those that are not read here.

use std::io::{Error, ErrorKind, Read};
use std::path::Path;

/// Kinds of files.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Format {
    Tiff,
    Photron,
    Rtdc,
    Picture,
    Avi,
    Npy,
    Other(Other),
}

/// Files that other programs read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Other {
    /// A film, by its name.
    Film(&'static str),
    /// A microscope's file, by its name.
    Microscope(&'static str),
    Bitmap,
    Npz,
}

/// First bytes that a file is known by: where they begin, and what they are.
const BYTES: [(usize, &[u8], Format); 22] = [
    (0, b"II*\0", Format::Tiff),
    (0, b"MM\0*", Format::Tiff),
    (0, b"II+\0", Format::Tiff),
    (0, b"MM\0+", Format::Tiff),
    (0, b"\x89PNG", Format::Picture),
    (0, b"\xFF\xD8\xFF", Format::Picture),
    (8, b"AVI ", Format::Avi),
    (0, b"\x93NUMPY", Format::Npy),
    (4, b"ftypqt", Format::Other(Other::Film("QuickTime"))),
    (4, b"ftyp", Format::Other(Other::Film("MP4"))),
    (4, b"moov", Format::Other(Other::Film("QuickTime"))),
    (
        0,
        b"\x1A\x45\xDF\xA3",
        Format::Other(Other::Film("Matroska or WebM")),
    ),
    (0, b"GIF8", Format::Other(Other::Film("GIF"))),
    (
        0,
        b"\x30\x26\xB2\x75",
        Format::Other(Other::Film("Windows Media")),
    ),
    (0, b"\0\0\x01\xBA", Format::Other(Other::Film("MPEG"))),
    (0, b"\0\0\x01\xB3", Format::Other(Other::Film("MPEG"))),
    (0, b"CI\x2C\0", Format::Other(Other::Film("Phantom Cine"))),
    (
        0,
        b"\xDA\xCE\xBE\x0A",
        Format::Other(Other::Microscope("Nikon ND2")),
    ),
    (
        0,
        b"ZISRAWFILE",
        Format::Other(Other::Microscope("Zeiss CZI")),
    ),
    (0, b"PK\x03\x04", Format::Other(Other::Npz)),
    (0, b"BM", Format::Other(Other::Bitmap)),
    (0, b"\x89HDF\r\n", Format::Rtdc),
];

/// Ends of names, in small letters.
const NAMES: [(&str, Format); 26] = [
    ("tif", Format::Tiff),
    ("tiff", Format::Tiff),
    ("mraw", Format::Photron),
    ("cih", Format::Photron),
    ("cihx", Format::Photron),
    ("rtdc", Format::Rtdc),
    ("png", Format::Picture),
    ("jpg", Format::Picture),
    ("jpeg", Format::Picture),
    ("avi", Format::Avi),
    ("npy", Format::Npy),
    ("mp4", Format::Other(Other::Film("MP4"))),
    ("m4v", Format::Other(Other::Film("MP4"))),
    ("mov", Format::Other(Other::Film("QuickTime"))),
    ("mkv", Format::Other(Other::Film("Matroska"))),
    ("webm", Format::Other(Other::Film("WebM"))),
    ("wmv", Format::Other(Other::Film("Windows Media"))),
    ("mpg", Format::Other(Other::Film("MPEG"))),
    ("mpeg", Format::Other(Other::Film("MPEG"))),
    ("gif", Format::Other(Other::Film("GIF"))),
    ("cine", Format::Other(Other::Film("Phantom Cine"))),
    ("nd2", Format::Other(Other::Microscope("Nikon ND2"))),
    ("czi", Format::Other(Other::Microscope("Zeiss CZI"))),
    ("lif", Format::Other(Other::Microscope("Leica LIF"))),
    ("bmp", Format::Other(Other::Bitmap)),
    ("npz", Format::Other(Other::Npz)),
];

impl Format {
    /// The kind of a file: by its first bytes, but for raw pixels of a Photron camera, which may begin with any. `None` for a kind
    /// not known.
    pub(super) fn of(path: &Path) -> Result<Option<Self>, Error> {
        let end = path.extension().and_then(|e| e.to_str());
        let end = end.unwrap_or_default().to_ascii_lowercase();
        let by_name = NAMES.iter().find(|(name, _)| *name == end).map(|n| n.1);
        if by_name == Some(Format::Photron) {
            return Ok(by_name);
        }
        let mut first = Vec::new();
        let read = std::fs::File::open(path).and_then(|file| file.take(16).read_to_end(&mut first));
        if let Err(cause) = read {
            // The reader of a known kind says what is wrong in its own words.
            let is_known = by_name.is_some() && cause.kind() != ErrorKind::NotFound;
            return if is_known { Ok(by_name) } else { Err(cause) };
        }
        let begins = |(at, bytes, _): &&(usize, &[u8], Format)| {
            first.get(*at..).is_some_and(|rest| rest.starts_with(bytes))
        };
        let by_bytes = BYTES.iter().find(begins).map(|b| b.2);
        Ok(by_bytes.or(by_name))
    }
}

impl Other {
    pub(super) fn name(self) -> &'static str {
        match self {
            Other::Film(name) | Other::Microscope(name) => name,
            Other::Bitmap => "BMP",
            Other::Npz => "NumPy .npz (or another ZIP archive)",
        }
    }

    /// The command that makes a file that is read here.
    pub(super) fn conversion(self, path: &Path) -> String {
        let from = quoted(path);
        match self {
            Other::Film(_) => conversion(path),
            Other::Microscope(_) => {
                format!("bfconvert {from} {}", quoted(&path.with_extension("tif")))
            }
            Other::Bitmap => {
                format!("ffmpeg -i {from} {}", quoted(&path.with_extension("png")))
            }
            Other::Npz => {
                let to = quoted(&path.with_extension("npy"));
                format!(
                    "python3 -c 'import numpy, sys; a = numpy.load(sys.argv[1]); numpy.save(sys.argv[2], a[a.files[0]])' {from} {to}"
                )
            }
        }
    }
}

/// A path as the shell takes it.
fn quoted(path: &Path) -> String {
    format!("'{}'", path.display().to_string().replace('\'', "'\\''"))
}

/// The command that makes an uncompressed grey film of any other.
pub(crate) fn conversion(path: &Path) -> String {
    let to = path.with_extension("grey.avi");
    format!(
        "ffmpeg -i {} -an -fps_mode passthrough -c:v rawvideo -pix_fmt gray {}",
        quoted(path),
        quoted(&to)
    )
}
