//! AVI films: uncompressed grey (`Y800`, `GREY`, `Y8`, `Y16`), bitmaps of 8 bits (with a grey palette) or 24, and MJPEG. Other
//! codecs are refused; the error gives the command that converts them.

use super::grey::{self, Grey};
use super::jpeg;
use super::{
    MAX_PIXELS, Recording, RecordingInfo, SourceError, check_same, check_size, no_such_frame,
};
use cellpos_rig::source::FrameBuffer;
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::Path;

/// Storage of the frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Codec {
    /// Rows of grey pixels from the top, of 8 or 16 bits.
    Grey {
        bits: u16,
    },
    /// Rows of a bitmap, of 1 or 3 bytes a pixel, from the bottom unless it says otherwise.
    Bitmap {
        channels: usize,
        top_down: bool,
    },
    Mjpeg,
}

/// A film.
#[derive(Debug)]
pub struct AviFilm {
    file: BufReader<File>,
    codec: Codec,
    /// Place and length of each frame's data, and its number: larger where frames before it were dropped.
    frames: Vec<(u64, u32, u64)>,
    bytes: Vec<u8>,
    info: RecordingInfo,
}

/// The video stream as its header describes it.
#[derive(Debug, Default)]
struct Stream {
    /// Streams seen so far; the number of the video among them.
    streams: u32,
    number: u32,
    found: bool,
    handler: [u8; 4],
    compression: [u8; 4],
    width: i32,
    height: i32,
    bits: u16,
    grey_palette: bool,
    rate: u32,
    scale: u32,
}

impl AviFilm {
    /// Opens a film, lists its frames and decodes the first.
    ///
    /// # Errors
    /// The file is not an AVI or has no video stream, its codec is not supported, or its first frame is damaged.
    pub fn open(path: &Path) -> Result<Self, SourceError> {
        let unreadable = |cause| SourceError::Unreadable {
            path: path.to_path_buf(),
            cause,
        };
        let mut file = BufReader::new(File::open(path).map_err(unreadable)?);
        let length = file.get_ref().metadata().map_err(unreadable)?.len();
        let mut head = [0; 12];
        let read = file.read_exact(&mut head);
        if read.is_err() || !head.starts_with(b"RIFF") || !head.ends_with(b"AVI ") {
            return Err(SourceError::Header {
                path: path.to_path_buf(),
                key: "RIFF",
                value: String::from_utf8_lossy(&head).into_owned(),
                must_be: "RIFF....AVI at the beginning of a film",
            });
        }
        let (mut stream, mut frames) = (Stream::default(), Vec::new());
        walk(&mut file, (0, length), &mut stream, &mut frames, 0).map_err(unreadable)?;
        if !stream.found || frames.is_empty() {
            return Err(SourceError::Empty {
                path: path.to_path_buf(),
                expected: "the film should hold a video stream with frames",
            });
        }
        let (width, height) = (
            stream.width.unsigned_abs() as usize,
            stream.height.unsigned_abs() as usize,
        );
        check_size(path, width, height)?;
        let codec = stream.codec().ok_or_else(|| SourceError::Film {
            path: path.to_path_buf(),
            format: format!("AVI with the codec {}", stream.codec_name()),
            command: super::conversion(path),
        })?;
        let rate_hz = f64::from(stream.rate) / f64::from(stream.scale.max(1));
        let (taken, numbers) = (frames.len(), frames.last().map_or(0, |f| f.2 + 1));
        let mut film = AviFilm {
            file,
            codec,
            frames,
            bytes: Vec::new(),
            info: RecordingInfo {
                path: path.to_path_buf(),
                kind: match codec {
                    Codec::Mjpeg => "AVI film (MJPEG)",
                    _ => "AVI film (uncompressed)",
                },
                width_px: width,
                height_px: height,
                bits: 8,
                frames: taken,
                lost: numbers - taken as u64,
                rate_hz: (rate_hz.is_finite() && rate_hz > 0.0).then_some(rate_hz),
                pixel_um: None,
                note: None,
            },
        };
        let mut first = FrameBuffer::default();
        film.info.note = film.decode(0, &mut first)?;
        film.info.bits = first.bits;
        Ok(film)
    }

    fn decode(
        &mut self,
        index: usize,
        buffer: &mut FrameBuffer,
    ) -> Result<Option<&'static str>, SourceError> {
        no_such_frame(&self.info, index)?;
        let path = self.info.path.clone();
        let damaged = |problem: String| SourceError::Damaged {
            path: path.clone(),
            frame: index,
            problem,
        };
        let Some(&(at, length, _)) = self.frames.get(index) else {
            return Err(damaged("no such frame".into()));
        };
        if length as usize > 4 * MAX_PIXELS {
            return Err(damaged(format!("{length} bytes")));
        }
        self.bytes.resize(length as usize, 0);
        let read = self.file.seek(SeekFrom::Start(at));
        read.and_then(|_| self.file.read_exact(&mut self.bytes))
            .map_err(|e| damaged(e.to_string()))?;
        let (width, height) = (self.info.width_px, self.info.height_px);
        let (channels, bytes_each, top_down) = match self.codec {
            Codec::Mjpeg => {
                let note = jpeg::decode(&path, index, &jpeg::with_tables(&self.bytes), buffer)?;
                check_same(&self.info, index, buffer.width, buffer.height)?;
                return Ok(note);
            }
            Codec::Grey { bits } => (1, usize::from(bits) / 8, true),
            Codec::Bitmap { channels, top_down } => (channels, 1, top_down),
        };
        let row = width * channels * bytes_each;
        // A bitmap's rows are filled up to four bytes; some programs do so with grey, some do not.
        let filled = row.next_multiple_of(4);
        let stride = if self.bytes.len() >= filled * height {
            filled
        } else if self.bytes.len() >= row * height {
            row
        } else {
            return Err(damaged(format!(
                "{} bytes of {}",
                self.bytes.len(),
                row * height
            )));
        };
        let order = (0..height).map(|k| if top_down { k } else { height - 1 - k });
        let mut values = Vec::with_capacity(row * height);
        for k in order {
            values.extend_from_slice(&self.bytes[k * stride..k * stride + row]);
        }
        (buffer.width, buffer.height) = (width, height);
        if bytes_each == 2 {
            let words = values.as_chunks::<2>().0.iter();
            let words: Vec<u16> = words.map(|b| u16::from_le_bytes(*b)).collect();
            return grey::take(&path, index, Grey::Sixteen(&words), (1, false), buffer);
        }
        grey::take(
            &path,
            index,
            Grey::Eight(&values),
            (channels, false),
            buffer,
        )
    }
}

impl Recording for AviFilm {
    fn info(&self) -> &RecordingInfo {
        &self.info
    }

    fn number(&self, index: usize) -> u64 {
        self.frames.get(index).map_or(index as u64, |f| f.2)
    }

    fn read(&mut self, index: usize, buffer: &mut FrameBuffer) -> Result<(), SourceError> {
        self.decode(index, buffer).map(|_| ())
    }
}

impl Stream {
    fn codec(&self) -> Option<Codec> {
        let upper = |code: [u8; 4]| code.map(|c| c.to_ascii_uppercase());
        match (&upper(self.compression), &upper(self.handler)) {
            (b"Y800" | b"Y8  " | b"GREY", _) => Some(Codec::Grey { bits: 8 }),
            (b"Y16 ", _) => Some(Codec::Grey { bits: 16 }),
            (b"MJPG" | b"JPEG", _) => Some(Codec::Mjpeg),
            ([0, 0, 0, 0] | b"DIB " | b"RGB ", _) => {
                let top_down = self.height < 0;
                let channels = match self.bits {
                    8 if self.grey_palette => 1,
                    24 => 3,
                    _ => return None,
                };
                Some(Codec::Bitmap { channels, top_down })
            }
            _ => None,
        }
    }

    fn codec_name(&self) -> String {
        let code = if self.compression == [0; 4] {
            return format!("bitmap of {} bits in colour", self.bits);
        } else {
            self.compression
        };
        code.iter()
            .map(|c| char::from(*c))
            .filter(|c| c.is_ascii_graphic())
            .collect()
    }
}

/// Lists of lists: headers of the streams, then the frames, in one part or in several of a gigabyte each.
fn walk(
    file: &mut BufReader<File>,
    (mut at, end): (u64, u64),
    stream: &mut Stream,
    frames: &mut Vec<(u64, u32, u64)>,
    depth: usize,
) -> std::io::Result<()> {
    let mut number = frames.last().map_or(0, |f| f.2 + 1);
    while at + 8 <= end {
        file.seek(SeekFrom::Start(at))?;
        let mut head = [0; 8];
        file.read_exact(&mut head)?;
        let size = u32::from_le_bytes([head[4], head[5], head[6], head[7]]);
        let (name, body) = ([head[0], head[1], head[2], head[3]], at + 8);
        let next = body + u64::from(size) + u64::from(size % 2);
        match &name {
            b"RIFF" | b"LIST" if depth < 6 => {
                walk(file, (body + 4, next.min(end)), stream, frames, depth + 1)?;
                number = frames.last().map_or(number, |f| f.2 + 1);
            }
            b"strh" => {
                let head = part(file, size.min(56))?;
                let own = stream.streams;
                stream.streams += 1;
                if head.starts_with(b"vids") && !stream.found {
                    (stream.found, stream.number) = (true, own);
                    stream.handler.copy_from_slice(&four(&head, 4));
                    stream.scale = u32::from_le_bytes(four(&head, 20));
                    stream.rate = u32::from_le_bytes(four(&head, 24));
                    // The format follows its header.
                    let format = part_at(file, next)?;
                    stream.width = i32::from_le_bytes(four(&format, 4));
                    stream.height = i32::from_le_bytes(four(&format, 8));
                    stream.bits = u16::from_le_bytes([four(&format, 14)[0], four(&format, 14)[1]]);
                    stream.compression = four(&format, 16);
                    let palette = format.get(40..).unwrap_or(&[]).as_chunks::<4>().0;
                    let is_grey =
                        |(k, c): (usize, &[u8; 4])| c[..3].iter().all(|v| usize::from(*v) == k);
                    stream.grey_palette = palette.iter().enumerate().all(is_grey);
                }
            }
            [a, b, b'd', b'b' | b'c'] if stream.found => {
                let tens = [*a, *b].map(|d| char::from(d).to_digit(10).unwrap_or(99));
                if tens[0] * 10 + tens[1] == stream.number {
                    // An empty frame repeats the one before: it was dropped.
                    if size > 0 {
                        frames.push((body, size, number));
                    }
                    number += 1;
                }
            }
            _ => {}
        }
        at = next;
    }
    Ok(())
}

fn part(file: &mut BufReader<File>, size: u32) -> std::io::Result<Vec<u8>> {
    let mut bytes = vec![0; size as usize];
    file.read_exact(&mut bytes)?;
    Ok(bytes)
}

/// The format chunk at a place: with a palette of at most 256 colours.
fn part_at(file: &mut BufReader<File>, at: u64) -> std::io::Result<Vec<u8>> {
    file.seek(SeekFrom::Start(at))?;
    let head = part(file, 8)?;
    if !head.starts_with(b"strf") {
        return Ok(Vec::new());
    }
    part(file, u32::from_le_bytes(four(&head, 4)).min(40 + 4 * 256))
}

fn four(bytes: &[u8], at: usize) -> [u8; 4] {
    core::array::from_fn(|k| bytes.get(at + k).copied().unwrap_or(0))
}
