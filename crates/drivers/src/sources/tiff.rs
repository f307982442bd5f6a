//! A TIFF file of several pages, or of one directory before many pictures, as ImageJ writes stacks beyond 4 GB.

use super::grey::{self, Grey};
use super::{MAX_PIXELS, Recording, RecordingInfo, SourceError, check_same, check_size};
use cellpos_rig::source::FrameBuffer;
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::Path;
use tiff::ColorType;
use tiff::TiffError;
use tiff::decoder::{Decoder, DecodingResult, Limits};
use tiff::tags::{CompressionMethod, Tag};

/// Most pages counted: a damaged file can chain its pages in a circle.
const MAX_PAGES: usize = 1 << 22;

/// A TIFF stack of grey pages of 8 to 16 bits, all of one size.
pub struct TiffStack {
    decoder: Decoder<BufReader<File>>,
    /// The decoder's page.
    page: usize,
    /// Pictures one after the other, behind a single directory.
    raw: Option<RawStack>,
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
            lost: 0,
            rate_hz: None,
            pixel_um: None,
            note: None,
        };
        let mut buffer = FrameBuffer::default();
        info.note = decode(&mut decoder, path, 0, &mut buffer)?;
        (info.width_px, info.height_px, info.bits) = (buffer.width, buffer.height, buffer.bits);
        while decoder.more_images() && info.frames < MAX_PAGES {
            // A page with an unreadable directory ends the stack here; reading that page gives the error.
            let readable = decoder.next_image().is_ok();
            info.frames += 1;
            if !readable {
                break;
            }
        }
        let mut decoder = self::decoder(path)?;
        let raw = if info.frames == 1 {
            RawStack::of(&mut decoder, path, &buffer)?
        } else {
            None
        };
        if let Some(raw) = &raw {
            info.frames = raw.frames;
            info.kind = "ImageJ stack";
        }
        Ok(TiffStack {
            decoder,
            page: 0,
            raw,
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
        if let Some(raw) = &mut self.raw {
            return raw.read(&self.info, index, buffer);
        }
        if index == self.page + 1 {
            self.decoder.next_image().map_err(damaged)?;
        } else if index != self.page {
            self.decoder.seek_to_image(index).map_err(damaged)?;
        }
        self.page = index;
        decode(&mut self.decoder, &self.info.path, index, buffer)?;
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

/// The picture of a file in a folder, with its warnings.
pub(crate) fn decode_file(
    path: &Path,
    frame: usize,
    buffer: &mut FrameBuffer,
) -> Result<Option<&'static str>, SourceError> {
    let mut decoder = decoder(path)?;
    let note = decode(&mut decoder, path, frame, buffer)?;
    if decoder.more_images() {
        return Err(SourceError::Damaged {
            path: path.to_path_buf(),
            frame,
            problem:
                "a folder's files hold one picture each, this one holds more; give the stack itself"
                    .to_string(),
        });
    }
    Ok(note)
}

fn decode(
    decoder: &mut Decoder<BufReader<File>>,
    path: &Path,
    frame: usize,
    buffer: &mut FrameBuffer,
) -> Result<Option<&'static str>, SourceError> {
    let damaged = |e: TiffError| damage(path, frame, &e);
    let (width, height) = decoder.dimensions().map_err(damaged)?;
    let (width, height) = (width as usize, height as usize);
    check_size(path, width, height)?;
    check_compression(decoder, path, frame)?;
    let kind = decoder.colortype().map_err(damaged)?;
    if let ColorType::Gray(bits @ (10 | 12 | 14)) = kind {
        return packed(decoder, path, (frame, bits.into()), (width, height), buffer);
    }
    let channels = match kind {
        ColorType::Gray(8 | 16) => (1, false),
        ColorType::GrayA(8 | 16) => (2, true),
        ColorType::RGB(8 | 16) => (3, false),
        ColorType::RGBA(8 | 16) => (4, true),
        _ => {
            return Err(grey::refuse(
                path,
                frame,
                format!("pixels of kind {kind:?}"),
            ));
        }
    };
    let pixels = decoder.read_image().map_err(damaged)?;
    let values = match &pixels {
        DecodingResult::U8(p) => Grey::Eight(p),
        DecodingResult::U16(p) => Grey::Sixteen(p),
        _ => {
            let found = "signed or floating-point pixels".to_string();
            return Err(grey::refuse(path, frame, found));
        }
    };
    let held = match values {
        Grey::Eight(p) => p.len(),
        Grey::Sixteen(p) => p.len(),
    };
    if held != width * height * channels.0 {
        let problem = format!("{held} values of {}", width * height * channels.0);
        return Err(SourceError::Damaged {
            path: path.to_path_buf(),
            frame,
            problem,
        });
    }
    (buffer.width, buffer.height) = (width, height);
    grey::take(path, frame, values, channels, buffer)
}

/// Grey pixels of 10, 12 or 14 bits one right after another, the high bits first, each row starts at a byte: strips of whole rows,
/// not compressed.
fn packed(
    decoder: &mut Decoder<BufReader<File>>,
    path: &Path,
    (frame, bits): (usize, u16),
    (width, height): (usize, usize),
    buffer: &mut FrameBuffer,
) -> Result<Option<&'static str>, SourceError> {
    let damaged = |e: TiffError| damage(path, frame, &e);
    let plain = decoder.get_tag_u32(Tag::Compression).unwrap_or(1) == 1
        && decoder.find_tag(Tag::StripOffsets).ok().flatten().is_some()
        && decoder.get_tag_u32(Tag::FillOrder).unwrap_or(1) == 1;
    if !plain {
        let found = format!("packed pixels of {bits} bits, compressed or in tiles");
        return Err(SourceError::PixelKind {
            path: path.to_path_buf(),
            frame,
            found,
            expected: "save it uncompressed, or with 16 bits a pixel",
        });
    }
    let offsets = decoder
        .get_tag_u64_vec(Tag::StripOffsets)
        .map_err(damaged)?;
    let lengths = decoder
        .get_tag_u64_vec(Tag::StripByteCounts)
        .map_err(damaged)?;
    let row = (width * usize::from(bits)).div_ceil(8);
    let mut bytes = vec![0; row * height];
    let mut rest = bytes.as_mut_slice();
    for (offset, length) in offsets.iter().zip(&lengths) {
        let part = rest.len().min(*length as usize);
        let (strip, after) = rest.split_at_mut(part);
        let file = decoder.inner();
        let read = file.seek(SeekFrom::Start(*offset));
        read.and_then(|_| file.read_exact(strip))
            .map_err(|e| damaged(TiffError::IoError(e)))?;
        rest = after;
    }
    if !rest.is_empty() {
        return Err(SourceError::Damaged {
            path: path.to_path_buf(),
            frame,
            problem: format!("{} of {} bytes are missing", rest.len(), row * height),
        });
    }
    (buffer.width, buffer.height, buffer.bits) = (width, height, bits);
    buffer.mono16.clear();
    for row in bytes.chunks_exact(row) {
        let (mut held, mut have) = (0_u32, 0);
        let mut next = row.iter();
        for _ in 0..width {
            while have < bits {
                held = held << 8 | u32::from(next.next().copied().unwrap_or(0));
                have += 8;
            }
            have -= bits;
            buffer.mono16.push((held >> have) as u16);
            held &= (1 << have) - 1;
        }
    }
    Ok(None)
}

/// Names a compression that cannot be read.
fn check_compression(
    decoder: &mut Decoder<BufReader<File>>,
    path: &Path,
    frame: usize,
) -> Result<(), SourceError> {
    let Ok(Some(value)) = decoder.find_tag(Tag::Compression) else {
        return Ok(());
    };
    let method = value.into_u16().unwrap_or(0);
    let readable = [
        CompressionMethod::None,
        CompressionMethod::LZW,
        CompressionMethod::Deflate,
        CompressionMethod::OldDeflate,
        CompressionMethod::PackBits,
    ];
    if readable.iter().any(|m| m.to_u16() == method) {
        return Ok(());
    }
    let name = match method {
        2..=4 => "a fax method",
        6 => "JPEG of the old kind",
        7 => "JPEG",
        34_712 | 33_003 | 33_005 => "JPEG 2000",
        34_925 => "LZMA",
        50_000 => "Zstandard",
        50_001 => "WebP",
        _ => "a method unknown here",
    };
    Err(SourceError::Compression {
        path: path.to_path_buf(),
        frame,
        method,
        name,
    })
}

/// Uncompressed pictures one after the other; only the description of the first gives their number.
#[derive(Debug)]
struct RawStack {
    file: File,
    start: u64,
    big_endian: bool,
    frames: usize,
    bytes: Vec<u8>,
}

impl RawStack {
    /// `None` for a file that is not such a stack.
    fn of(
        decoder: &mut Decoder<BufReader<File>>,
        path: &Path,
        first: &FrameBuffer,
    ) -> Result<Option<Self>, SourceError> {
        let text = decoder.get_tag_ascii_string(Tag::ImageDescription);
        let Some(frames) = text
            .ok()
            .filter(|t| t.starts_with("ImageJ="))
            .and_then(|t| {
                let count = t.lines().find_map(|line| line.strip_prefix("images="))?;
                count.trim().parse::<usize>().ok()
            })
        else {
            return Ok(None);
        };
        let plain = decoder.get_tag_u32(Tag::Compression).unwrap_or(1) == 1
            && decoder.get_tag_u32(Tag::SamplesPerPixel).unwrap_or(1) == 1;
        let offsets = decoder
            .get_tag_u64_vec(Tag::StripOffsets)
            .unwrap_or_default();
        let Some(start) = offsets.first().copied().filter(|_| plain && frames > 1) else {
            return Ok(None);
        };
        let unreadable = |cause| SourceError::Unreadable {
            path: path.to_path_buf(),
            cause,
        };
        let mut file = File::open(path).map_err(unreadable)?;
        let mut order = [0; 2];
        file.read_exact(&mut order).map_err(unreadable)?;
        let bytes = first.width * first.height * usize::from(first.bits / 8);
        let held = file
            .metadata()
            .map_err(unreadable)?
            .len()
            .saturating_sub(start);
        let whole = held / bytes as u64;
        if whole < frames as u64 {
            return Err(SourceError::Damaged {
                path: path.to_path_buf(),
                frame: whole as usize,
                problem: format!(
                    "{whole} of the {frames} pictures that the description counts are whole"
                ),
            });
        }
        Ok(Some(RawStack {
            file,
            start,
            big_endian: order == *b"MM",
            frames,
            bytes: vec![0; bytes],
        }))
    }

    fn read(
        &mut self,
        info: &RecordingInfo,
        index: usize,
        buffer: &mut FrameBuffer,
    ) -> Result<(), SourceError> {
        let damaged = |e: std::io::Error| SourceError::Damaged {
            path: info.path.clone(),
            frame: index,
            problem: e.to_string(),
        };
        let at = self.start + index as u64 * self.bytes.len() as u64;
        self.file.seek(SeekFrom::Start(at)).map_err(damaged)?;
        self.file.read_exact(&mut self.bytes).map_err(damaged)?;
        super::fill(info, &self.bytes, self.big_endian, buffer);
        Ok(())
    }
}
