//! Grey values from pictures saved in colour: equal channels are merged into one.

use super::SourceError;
use cellpos_rig::source::FrameBuffer;
use std::path::Path;

/// Values as a picture holds them, channel by channel in each pixel.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Grey<'a> {
    Eight(&'a [u8]),
    Sixteen(&'a [u16]),
}

/// The note on a recording with equal channels, given once.
const EQUAL: &str = "three equal channels of colour, read as one of grey";

pub(crate) fn refuse(path: &Path, frame: usize, found: String) -> SourceError {
    SourceError::PixelKind {
        path: path.to_path_buf(),
        frame,
        found,
        expected: "grey pixels of 8 or 16 bits are needed, or three equal channels",
    }
}

/// Writes the values into the buffer, whose size is set. A pixel has `channels` values; the last one is transparency if the
/// second number of `channels` says so. Returns warnings.
pub(crate) fn take(
    path: &Path,
    frame: usize,
    values: Grey,
    channels: (usize, bool),
    buffer: &mut FrameBuffer,
) -> Result<Option<&'static str>, SourceError> {
    let pixels = buffer.width * buffer.height;
    let problem = match values {
        Grey::Eight(v) => {
            buffer.bits = 8;
            one_channel(v, channels, pixels, u8::MAX, &mut buffer.mono8)
        }
        Grey::Sixteen(v) => {
            buffer.bits = 16;
            one_channel(v, channels, pixels, u16::MAX, &mut buffer.mono16)
        }
    };
    match problem {
        Some(found) => Err(refuse(path, frame, found)),
        None => Ok((channels.0 >= 3).then_some(EQUAL)),
    }
}

fn one_channel<T: Copy + PartialEq + std::fmt::Display>(
    values: &[T],
    (channels, alpha): (usize, bool),
    pixels: usize,
    opaque: T,
    to: &mut Vec<T>,
) -> Option<String> {
    to.clear();
    if channels == 0 || values.len() != pixels * channels {
        return Some(format!("{} values for {pixels} pixels", values.len()));
    }
    let colours = channels - usize::from(alpha);
    for (k, pixel) in values.chunks_exact(channels).enumerate() {
        let (first, rest) = pixel.split_first()?;
        let different = rest.iter().take(colours - 1).find(|v| *v != first);
        if let Some(other) = different {
            return Some(format!(
                "colour: channels of {first} and {other} in pixel {k}"
            ));
        }
        if alpha && pixel.last() != Some(&opaque) {
            return Some(format!("transparency in pixel {k}"));
        }
        to.push(*first);
    }
    None
}

/// Memory limit of a picture: a header that claims more is broken.
pub(crate) fn limits() -> image::Limits {
    let mut limits = image::Limits::default();
    limits.max_alloc = Some(16 * super::MAX_PIXELS as u64);
    limits
}
