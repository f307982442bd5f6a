//! Photron recordings: a header (`.cihx`, XML, or the older `.cih`, lines of `key : value`) with the pixels (`.mraw`).
//!
//! The pixels are stored frame after frame without gaps: 8 bits, 16 bits little-endian, or 12 bits packed, two pixels
//! in three bytes with the high bits first. Frames of 12 effective bits in 16 may sit at the lower or the higher side.

use super::{Recording, RecordingInfo, SourceError, check_size};
use cellpos_rig::source::FrameBuffer;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// Longest header read, bytes.
const MAX_HEADER: u64 = 1 << 20;

/// A Photron recording.
#[derive(Debug)]
pub struct PhotronRecording {
    pixels: File,
    mraw: PathBuf,
    stored_bits: u16,
    /// Bits by which values are shifted down: the effective ones sit at the higher side.
    shift: u16,
    bytes: Vec<u8>,
    info: RecordingInfo,
}

/// Content of the header.
#[derive(Debug, Clone, PartialEq)]
struct Header {
    width: usize,
    height: usize,
    frames: usize,
    rate_hz: f64,
    stored_bits: u16,
    effective_bits: u16,
    higher_side: bool,
}

impl PhotronRecording {
    /// Opens a recording by its header or by its pixels; the other file is next to it under the same name.
    ///
    /// # Errors
    /// A file is missing, or the header cannot be used.
    pub fn open(path: &Path) -> Result<Self, SourceError> {
        let (header, mraw) = pair(path);
        let unreadable = |path: &Path| {
            let path = path.to_path_buf();
            move |cause| SourceError::Unreadable { path, cause }
        };
        let mut raw = Vec::new();
        let file = File::open(&header).map_err(unreadable(&header))?;
        file.take(MAX_HEADER)
            .read_to_end(&mut raw)
            .map_err(unreadable(&header))?;
        let text = String::from_utf8_lossy(&raw);
        let is_xml = header
            .extension()
            .is_some_and(|e| e.eq_ignore_ascii_case("cihx"));
        let h = if is_xml {
            read_cihx(&header, &text)?
        } else {
            read_cih(&header, &text)?
        };
        check_size(&header, h.width, h.height)?;
        let pixels = File::open(&mraw).map_err(unreadable(&mraw))?;
        if h.frames == 0 {
            return Err(SourceError::Empty {
                path: header,
                expected: "the header counts no frames",
            });
        }
        let info = RecordingInfo {
            path: header,
            kind: "Photron recording",
            width_px: h.width,
            height_px: h.height,
            bits: if h.stored_bits == 8 {
                8
            } else {
                h.effective_bits.max(9)
            },
            frames: h.frames,
            lost: 0,
            rate_hz: Some(h.rate_hz),
            pixel_um: None,
            note: None,
        };
        let held = pixels.metadata().map_err(unreadable(&mraw))?.len();
        let whole = held / frame_bytes(&h).max(1) as u64;
        if whole < h.frames as u64 {
            return Err(SourceError::Damaged {
                path: mraw,
                frame: whole as usize,
                problem: format!(
                    "{whole} of the {} frames that the header counts are whole",
                    h.frames
                ),
            });
        }
        let shift = if h.higher_side && h.stored_bits == 16 {
            16 - h.effective_bits
        } else {
            0
        };
        let bytes = vec![0; frame_bytes(&h)];
        Ok(PhotronRecording {
            pixels,
            mraw,
            stored_bits: h.stored_bits,
            shift,
            bytes,
            info,
        })
    }
}

fn frame_bytes(h: &Header) -> usize {
    (h.width * h.height * usize::from(h.stored_bits)).div_ceil(8)
}

/// Header and pixels of a recording given by either.
fn pair(path: &Path) -> (PathBuf, PathBuf) {
    let is_pixels = path
        .extension()
        .is_some_and(|e| e.eq_ignore_ascii_case("mraw"));
    if !is_pixels {
        return (path.to_path_buf(), path.with_extension("mraw"));
    }
    let xml = path.with_extension("cihx");
    let header = if xml.exists() {
        xml
    } else {
        path.with_extension("cih")
    };
    (header, path.to_path_buf())
}

impl Recording for PhotronRecording {
    fn info(&self) -> &RecordingInfo {
        &self.info
    }

    fn read(&mut self, index: usize, buffer: &mut FrameBuffer) -> Result<(), SourceError> {
        if index >= self.info.frames {
            let (path, frames) = (self.info.path.clone(), self.info.frames);
            return Err(SourceError::NoSuchFrame {
                path,
                frame: index,
                frames,
            });
        }
        let start = index as u64 * self.bytes.len() as u64;
        let damaged = |e: std::io::Error| SourceError::Damaged {
            path: self.mraw.clone(),
            frame: index,
            problem: e.to_string(),
        };
        self.pixels.seek(SeekFrom::Start(start)).map_err(damaged)?;
        self.pixels.read_exact(&mut self.bytes).map_err(damaged)?;
        (buffer.width, buffer.height, buffer.bits) =
            (self.info.width_px, self.info.height_px, self.info.bits);
        let shift = self.shift;
        match self.stored_bits {
            8 => {
                buffer.mono8.clear();
                buffer.mono8.extend_from_slice(&self.bytes);
            }
            16 => {
                buffer.mono16.clear();
                let words = self.bytes.as_chunks::<2>().0.iter();
                buffer
                    .mono16
                    .extend(words.map(|b| u16::from_le_bytes(*b) >> shift));
            }
            _ => {
                buffer.mono16.clear();
                for [a, b, c] in self.bytes.as_chunks::<3>().0 {
                    let (a, b, c) = (u16::from(*a), u16::from(*b), u16::from(*c));
                    buffer.mono16.push(a << 4 | b >> 4);
                    buffer.mono16.push((b & 15) << 8 | c);
                }
            }
        }
        Ok(())
    }
}

/// Reads values of the header, naming the key when one cannot be used.
struct Keys<'a> {
    path: &'a Path,
    get: &'a dyn Fn(&str) -> Option<String>,
}

impl Keys<'_> {
    fn error(
        &self,
        key: &'static str,
        value: Option<String>,
        must_be: &'static str,
    ) -> SourceError {
        let value = value.unwrap_or_else(|| "(missing)".to_string());
        SourceError::Header {
            path: self.path.to_path_buf(),
            key,
            value,
            must_be,
        }
    }

    fn count(
        &self,
        key: &'static str,
        most: usize,
        must_be: &'static str,
    ) -> Result<usize, SourceError> {
        let value = (self.get)(key);
        let number = value
            .as_deref()
            .and_then(|v| v.trim().parse::<usize>().ok());
        number
            .filter(|n| *n <= most)
            .ok_or_else(|| self.error(key, value, must_be))
    }

    fn rate(&self, key: &'static str) -> Result<f64, SourceError> {
        let value = (self.get)(key);
        let number = value.as_deref().and_then(|v| v.trim().parse::<f64>().ok());
        let usable = number.filter(|r| r.is_finite() && *r > 0.0 && *r < 1e9);
        usable.ok_or_else(|| self.error(key, value, "a frame rate above 0 Hz"))
    }

    fn header(&self, keys: [&'static str; 8]) -> Result<Header, SourceError> {
        let [width, height, frames, rate, bits, depth, side, format] = keys;
        if let Some(kind) = (self.get)(format)
            && !kind.trim().eq_ignore_ascii_case("mraw")
        {
            return Err(self.error(
                format,
                Some(kind),
                "MRaw: other file formats hold no pixels in an .mraw file",
            ));
        }
        let stored_bits = self.count(bits, 16, "8, 12 or 16 bits of one grey value")? as u16;
        if ![8, 12, 16].contains(&stored_bits) {
            return Err(self.error(bits, (self.get)(bits), "8, 12 or 16 bits of one grey value"));
        }
        let effective_bits =
            self.count(depth, usize::from(stored_bits), "at most the bits stored")? as u16;
        if effective_bits == 0 {
            return Err(self.error(depth, (self.get)(depth), "1 bit or more"));
        }
        let header = Header {
            width: self.count(width, 1 << 16, "1 to 65536 px")?,
            height: self.count(height, 1 << 16, "1 to 65536 px")?,
            frames: self.count(frames, usize::MAX, "a number of frames")?,
            rate_hz: self.rate(rate)?,
            stored_bits,
            effective_bits,
            higher_side: (self.get)(side).is_some_and(|s| s.trim().eq_ignore_ascii_case("higher")),
        };
        // All frames form one sequence of bits: with an odd number of pixels every other frame would begin inside a
        // byte.
        if stored_bits == 12 && (header.width * header.height) % 2 == 1 {
            let must_be = "an even number of pixels in 12-bit packing";
            return Err(self.error(width, Some(header.width.to_string()), must_be));
        }
        Ok(header)
    }
}

fn read_cihx(path: &Path, text: &str) -> Result<Header, SourceError> {
    let broken = |value: String| SourceError::Header {
        path: path.to_path_buf(),
        key: "<cih>",
        value,
        must_be: "an XML element of a Photron header",
    };
    // The XML element is wrapped in binary lines.
    let start = text
        .find("<cih>")
        .ok_or_else(|| broken("(missing)".to_string()))?;
    let length = text[start..]
        .find("</cih>")
        .ok_or_else(|| broken("without an end".to_string()))?;
    let document = roxmltree::Document::parse(&text[start..start + length + "</cih>".len()])
        .map_err(|e| broken(e.to_string()))?;
    let get = |key: &str| {
        let mut node = document.root_element();
        for name in key.split('/') {
            node = node.children().find(|c| c.has_tag_name(name))?;
        }
        node.text().map(str::to_string)
    };
    Keys { path, get: &get }.header([
        "imageDataInfo/resolution/width",
        "imageDataInfo/resolution/height",
        "frameInfo/totalFrame",
        "recordInfo/recordRate",
        "imageDataInfo/colorInfo/bit",
        "imageDataInfo/effectiveBit/depth",
        "imageDataInfo/effectiveBit/side",
        "imageFileInfo/fileFormat",
    ])
}

fn read_cih(path: &Path, text: &str) -> Result<Header, SourceError> {
    let get = |key: &str| {
        let mut lines = text.lines().filter_map(|l| l.split_once(" : "));
        lines
            .find(|(k, _)| k.trim() == key)
            .map(|(_, v)| v.trim().to_string())
    };
    Keys { path, get: &get }.header([
        "Image Width",
        "Image Height",
        "Total Frame",
        "Record Rate(fps)",
        "Color Bit",
        "EffectiveBit Depth",
        "EffectiveBit Side",
        "File Format",
    ])
}
