//! A clip as the page plays it: frames of 8 bits with their times.

use std::sync::Arc;

/// Gives a clip by its name, as [`film_bytes`] makes it; `None`: no clip of that name.
pub type Film = Arc<dyn Fn(&str) -> Option<Vec<u8>> + Send + Sync>;

/// A frame of a clip.
#[derive(Debug, Clone, PartialEq)]
pub struct FilmFrame {
    /// Time since the start of the run, s.
    pub time_s: f64,
    /// Centre of bead or cell, px; NaN without one.
    pub centre_px: [f32; 2],
    /// `width * height` grey values, row by row.
    pub pixels: Vec<u8>,
}

/// A clip on the wire, little-endian: width, height and number of frames (u32 each) and an unused word. Then for each frame its
/// time (f64), the centre (two f32) and the pixels, padded with zeros to a multiple of eight bytes. Frames of another size
/// are left out.
///
/// ```
/// let frame = cellpos_live::FilmFrame { time_s: 0.5, centre_px: [1.0, 0.0], pixels: vec![9; 6] };
/// assert_eq!(cellpos_live::film_bytes(3, 2, &[frame]).len(), 16 + 16 + 8);
/// ```
pub fn film_bytes(width: u32, height: u32, frames: &[FilmFrame]) -> Vec<u8> {
    let size = width as usize * height as usize;
    let whole: Vec<&FilmFrame> = (frames.iter())
        .filter(|frame| frame.pixels.len() == size)
        .collect();
    let mut out = Vec::with_capacity(16 + whole.len() * (24 + size));
    for value in [width, height, whole.len() as u32, 0] {
        out.extend(value.to_le_bytes());
    }
    for frame in whole {
        out.extend(frame.time_s.to_le_bytes());
        out.extend(frame.centre_px[0].to_le_bytes());
        out.extend(frame.centre_px[1].to_le_bytes());
        out.extend(&frame.pixels);
        out.resize(out.len().next_multiple_of(8), 0);
    }
    out
}
