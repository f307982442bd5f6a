//! NumPy arrays (`.npy`) of frames: `frame, row, column`, or one frame as `row, column`.

use super::{Recording, RecordingInfo, SourceError, check_size, no_such_frame};
use cellpos_rig::source::FrameBuffer;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;

/// Longest header taken, bytes: NumPy writes 128 for an array of plain numbers.
const LONGEST_HEADER: usize = 1 << 16;

/// An array of unsigned 8- or 16-bit values in C order.
#[derive(Debug)]
pub struct NpyStack {
    file: File,
    start: u64,
    big_endian: bool,
    bytes: Vec<u8>,
    info: RecordingInfo,
}

impl NpyStack {
    /// Opens the file and compares its length with the header.
    ///
    /// # Errors
    /// No array, values of another kind, another order or number of dimensions, or a file that is too short.
    pub fn open(path: &Path) -> Result<Self, SourceError> {
        let unreadable = |cause| SourceError::Unreadable {
            path: path.to_path_buf(),
            cause,
        };
        let refused = |key, value: &str, must_be| refused(path, key, value, must_be);
        let mut file = File::open(path).map_err(unreadable)?;
        let mut head = [0_u8; 12];
        file.read_exact(&mut head).map_err(unreadable)?;
        if !head.starts_with(b"\x93NUMPY") {
            let must_be = "\\x93NUMPY at the beginning of an array that numpy.save wrote";
            return Err(refused("magic", "other bytes", must_be));
        }
        let (length, start) = match head[6] {
            1 => (usize::from(u16::from_le_bytes([head[8], head[9]])), 10),
            _ => (
                u32::from_le_bytes([head[8], head[9], head[10], head[11]]) as usize,
                12,
            ),
        };
        if length > LONGEST_HEADER {
            return Err(refused(
                "header",
                &length.to_string(),
                "at most 65536 bytes",
            ));
        }
        let mut text = vec![0; length];
        file.seek(SeekFrom::Start(start)).map_err(unreadable)?;
        file.read_exact(&mut text).map_err(unreadable)?;
        let text = String::from_utf8_lossy(&text);
        let ((bits, big_endian), (frames, height, width)) = kind_and_sides(path, &text)?;
        check_size(path, width, height)?;
        if frames == 0 {
            return Err(SourceError::Empty {
                path: path.to_path_buf(),
                expected: "the array's first side is 0",
            });
        }
        let start = start + length as u64;
        let bytes = vec![0; width * height * usize::from(bits) / 8];
        let held = file
            .metadata()
            .map_err(unreadable)?
            .len()
            .saturating_sub(start);
        let whole = held / bytes.len() as u64;
        if whole < frames as u64 {
            return Err(SourceError::Damaged {
                path: path.to_path_buf(),
                frame: whole as usize,
                problem: format!("{whole} of the {frames} frames of the array are whole"),
            });
        }
        let info = RecordingInfo {
            path: path.to_path_buf(),
            kind: "NumPy array",
            width_px: width,
            height_px: height,
            bits,
            frames,
            lost: 0,
            rate_hz: None,
            pixel_um: None,
            note: None,
        };
        Ok(NpyStack {
            file,
            start,
            big_endian,
            bytes,
            info,
        })
    }
}

impl Recording for NpyStack {
    fn info(&self) -> &RecordingInfo {
        &self.info
    }

    fn read(&mut self, index: usize, buffer: &mut FrameBuffer) -> Result<(), SourceError> {
        no_such_frame(&self.info, index)?;
        let damaged = |e: std::io::Error| SourceError::Damaged {
            path: self.info.path.clone(),
            frame: index,
            problem: e.to_string(),
        };
        let at = self.start + index as u64 * self.bytes.len() as u64;
        self.file.seek(SeekFrom::Start(at)).map_err(damaged)?;
        self.file.read_exact(&mut self.bytes).map_err(damaged)?;
        super::fill(&self.info, &self.bytes, self.big_endian, buffer);
        Ok(())
    }
}

/// Bits of a value and whether the high byte comes first; frames, rows and columns.
type KindAndSides = ((u16, bool), (usize, usize, usize));

/// Type and order of the values, from the header.
fn kind_and_sides(path: &Path, text: &str) -> Result<KindAndSides, SourceError> {
    let refused = |key, value: &str, must_be| refused(path, key, value, must_be);
    let descr = value(text, "descr").unwrap_or_default();
    let (bits, big_endian) = match descr.trim_matches(['\'', '"']) {
        "|u1" | "<u1" | ">u1" => (8, false),
        "<u2" => (16, false),
        ">u2" => (16, true),
        _ => {
            let must_be = "'|u1', '<u2' or '>u2': save array.astype(numpy.uint8) or numpy.uint16";
            return Err(refused("descr", descr, must_be));
        }
    };
    let order = value(text, "fortran_order").unwrap_or_default();
    if order != "False" {
        let must_be = "False: save numpy.ascontiguousarray(array)";
        return Err(refused("fortran_order", order, must_be));
    }
    let shape = value(text, "shape").unwrap_or_default();
    let sides: Option<Vec<usize>> = shape
        .trim_matches(['(', ')'])
        .split(',')
        .map(str::trim)
        .filter(|side| !side.is_empty())
        .map(|side| side.parse().ok())
        .collect();
    let (frames, height, width) = match sides.as_deref() {
        Some([height, width]) => (1, *height, *width),
        Some([frames, height, width]) => (*frames, *height, *width),
        _ => {
            return Err(refused(
                "shape",
                shape,
                "(frame, row, column) or (row, column)",
            ));
        }
    };
    Ok(((bits, big_endian), (frames, height, width)))
}

fn refused(path: &Path, key: &'static str, value: &str, must_be: &'static str) -> SourceError {
    SourceError::Header {
        path: path.to_path_buf(),
        key,
        value: value.to_string(),
        must_be,
    }
}

/// Value of a key of the header, a Python dictionary of three known keys.
fn value<'a>(text: &'a str, key: &str) -> Option<&'a str> {
    let at = text.find(&format!("'{key}'"))?;
    let rest = text.get(at..)?.split_once(':')?.1.trim_start();
    let end = if rest.starts_with('(') {
        rest.find(')')? + 1
    } else {
        rest.find([',', '}'])?
    };
    rest.get(..end).map(str::trim)
}
