//! One of the pictures of a mosaic.

/// One grey picture of a [`crate::Mosaic`].
#[derive(Debug, Clone, PartialEq)]
pub struct Tile {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Grey levels, row by row from the upper left corner.
    pub pixels: Vec<u8>,
    /// The same as a PNG file.
    pub png: Vec<u8>,
    /// Its value in the figure's CSV, in the mosaic's unit.
    pub value: f64,
}
