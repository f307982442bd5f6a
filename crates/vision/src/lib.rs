//! Bead position, covariance and verdict from a camera frame.
//!
//! Pixel coordinates are 0-based with pixel centres at whole numbers, x along the row. Everything that runs per frame
//! uses buffers made beforehand and allocates nothing. Not for devices or files: frames come in as slices.
#![forbid(unsafe_code)]

mod fix;
mod frame;

pub use fix::{Fix, Verdict};
pub use frame::{Frame, Pixels};
