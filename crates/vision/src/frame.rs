//! A borrowed grey frame.

/// The grey values of a frame, row by row.
#[derive(Debug, Clone, Copy)]
pub enum Pixels<'a> {
    /// 8 bits per pixel.
    Mono8(&'a [u8]),
    /// 9 to 16 bits per pixel, in the low bits.
    Mono16(&'a [u16]),
}

/// A borrowed grey frame of `width` x `height` pixels, rows contiguous.
#[derive(Debug, Clone, Copy)]
pub struct Frame<'a> {
    /// Pixels per row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// `width * height` grey values.
    pub pixels: Pixels<'a>,
}
