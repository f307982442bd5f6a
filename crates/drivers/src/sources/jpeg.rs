//! JPEG pictures, alone and as the frames of a film.

use super::grey::{self, Grey};
use super::{SourceError, check_size};
use cellpos_rig::source::FrameBuffer;
use image::{DynamicImage, ImageFormat, ImageReader};
use std::io::Cursor;
use std::path::Path;

/// Largest difference of the channels that the format's own rounding makes of grey: conversion to luminance and colour
/// difference and back rounds three times.
const ROUNDING: u8 = 3;

/// Decodes a grey picture, or one whose three channels differ by no more than the format's rounding.
pub(crate) fn decode(
    path: &Path,
    frame: usize,
    bytes: &[u8],
    buffer: &mut FrameBuffer,
) -> Result<Option<&'static str>, SourceError> {
    let mut reader = ImageReader::with_format(Cursor::new(bytes), ImageFormat::Jpeg);
    reader.limits(grey::limits());
    let picture = reader.decode().map_err(|e| SourceError::Damaged {
        path: path.to_path_buf(),
        frame,
        problem: e.to_string(),
    })?;
    let (width, height) = (picture.width() as usize, picture.height() as usize);
    check_size(path, width, height)?;
    (buffer.width, buffer.height) = (width, height);
    match picture {
        DynamicImage::ImageLuma8(p) => {
            grey::take(path, frame, Grey::Eight(p.as_raw()), (1, false), buffer)
        }
        DynamicImage::ImageRgb8(p) => {
            let mut values = p.into_raw();
            for pixel in values.as_chunks_mut::<3>().0 {
                let [r, g, b] = *pixel;
                if r.max(g).max(b) - r.min(g).min(b) <= ROUNDING {
                    *pixel = [g; 3];
                }
            }
            grey::take(path, frame, Grey::Eight(&values), (3, false), buffer)
        }
        other => Err(grey::refuse(
            path,
            frame,
            format!("pixels of kind {:?}", other.color()),
        )),
    }
}

/// A film's frame with the code tables that films leave out: those of the standard (ISO 10918-1, annex K.3).
pub(crate) fn with_tables(bytes: &[u8]) -> Vec<u8> {
    // Segments up to the start of the scan: does one hold the tables?
    let mut at = 2;
    while let Some([0xFF, marker, high, low]) = bytes.get(at..at + 4) {
        match marker {
            0xC4 => return bytes.to_vec(),
            0xDA => break,
            _ => at += 2 + usize::from(u16::from_be_bytes([*high, *low])),
        }
    }
    let (head, scan) = bytes.split_at(at.min(bytes.len()));
    [head, &standard_tables(), scan].concat()
}

/// The four tables as a segment: class and number, codes of each length, and the values in the order of their codes.
fn standard_tables() -> Vec<u8> {
    const DIFFERENCES: [u8; 12] = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11];
    const LUMA_DC: [u8; 16] = [0, 1, 5, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0, 0, 0];
    const CHROMA_DC: [u8; 16] = [0, 3, 1, 1, 1, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0];
    const LUMA_AC: [u8; 16] = [0, 2, 1, 3, 3, 2, 4, 3, 5, 5, 4, 4, 0, 0, 1, 125];
    const CHROMA_AC: [u8; 16] = [0, 2, 1, 2, 4, 4, 3, 4, 7, 5, 4, 4, 0, 1, 2, 119];
    // The values of short codes as the standard lists them; the rest in ascending order.
    const LUMA_SHORT: [u8; 37] = [
        0x01, 0x02, 0x03, 0x00, 0x04, 0x11, 0x05, 0x12, 0x21, 0x31, 0x41, 0x06, 0x13, 0x51, 0x61,
        0x07, 0x22, 0x71, 0x14, 0x32, 0x81, 0x91, 0xA1, 0x08, 0x23, 0x42, 0xB1, 0xC1, 0x15, 0x52,
        0xD1, 0xF0, 0x24, 0x33, 0x62, 0x72, 0x82,
    ];
    const CHROMA_SHORT: [u8; 43] = [
        0x00, 0x01, 0x02, 0x03, 0x11, 0x04, 0x05, 0x21, 0x31, 0x06, 0x12, 0x41, 0x51, 0x07, 0x61,
        0x71, 0x13, 0x22, 0x32, 0x81, 0x08, 0x14, 0x42, 0x91, 0xA1, 0xB1, 0xC1, 0x09, 0x23, 0x33,
        0x52, 0xF0, 0x15, 0x62, 0x72, 0xD1, 0x0A, 0x16, 0x24, 0x34, 0xE1, 0x25, 0xF1,
    ];
    let complete = |short: &[u8]| {
        let mut values = short.to_vec();
        // Runs of 0 to 15 zeros before a value of 1 to 10 bits, the end of a block, and sixteen zeros: 162 in all.
        let all = (0..=0xFF_u8).filter(|v| (1..=10).contains(&(v & 15)) || *v == 0 || *v == 0xF0);
        values.extend(all.filter(|v| !short.contains(v)));
        values
    };
    let tables: [(u8, [u8; 16], Vec<u8>); 4] = [
        (0x00, LUMA_DC, DIFFERENCES.to_vec()),
        (0x10, LUMA_AC, complete(&LUMA_SHORT)),
        (0x01, CHROMA_DC, DIFFERENCES.to_vec()),
        (0x11, CHROMA_AC, complete(&CHROMA_SHORT)),
    ];
    let mut body = Vec::new();
    for (number, lengths, values) in tables {
        body.push(number);
        body.extend(lengths);
        body.extend(values);
    }
    let length = (body.len() + 2) as u16;
    let mut segment = vec![0xFF, 0xC4];
    segment.extend(length.to_be_bytes());
    segment.extend(body);
    segment
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_standard_tables_have_as_many_values_as_codes() {
        let segment = standard_tables();
        assert_eq!(segment.len(), 4 + 2 * (17 + 12) + 2 * (17 + 162));
        assert_eq!(segment[2..4], 418_u16.to_be_bytes());
    }
}
