//! The part of a frame around the bead or cell, as page and clips show it.

use cellpos_rig::SeenFrame;
use std::ops::Range;

/// Largest part, px.
pub(crate) const MOST: (usize, usize) = (384, 288);

/// A part of a frame, px.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Crop {
    /// First column and first row.
    pub(crate) origin: (usize, usize),
    /// Columns and rows.
    pub(crate) size: (usize, usize),
    stride: usize,
}

impl Crop {
    /// At most `most` px about bead or cell, or about its expected place. The crop moves with it in `steps` of its size.
    pub(crate) fn about(seen: &SeenFrame<'_>, most: (usize, usize), steps: usize) -> Self {
        let frame = &seen.frame;
        let about = seen.centre_px.unwrap_or(seen.expected_px);
        let (left, width) = span(frame.width, most.0, about.0, steps);
        let (top, height) = span(frame.height, most.1, about.1, steps);
        Self {
            origin: (left, top),
            size: (width, height),
            stride: frame.width,
        }
    }

    /// Ranges of its rows among the frame's pixels.
    pub(crate) fn rows(&self) -> impl Iterator<Item = Range<usize>> + use<> {
        let Self {
            origin: (left, top),
            size: (width, height),
            stride,
        } = *self;
        (top..top + height).map(move |row| row * stride + left..row * stride + left + width)
    }

    /// A position of the frame, in the crop's coordinates.
    pub(crate) fn place(&self, (x, y): (f64, f64)) -> (f64, f64) {
        (x - self.origin.0 as f64, y - self.origin.1 as f64)
    }
}

/// Start and length of `most` px within `size` px so that they hold `place`.
fn span(size: usize, most: usize, place: f64, steps: usize) -> (usize, usize) {
    let step = (most / steps.max(1)).max(1);
    let wanted = if place.is_finite() {
        place as usize
    } else {
        size / 2
    };
    let start = wanted.saturating_sub(most / 2) / step * step;
    (start.min(size.saturating_sub(most)), size.min(most))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_span_holds_its_place_and_stays_within_the_frame() {
        assert_eq!(span(1024, 384, 900.0, 8), (640, 384));
        assert_eq!(span(1024, 384, 500.0, usize::MAX), (308, 384));
        assert_eq!(
            span(1024, 384, 500.0, 8),
            (288, 384),
            "in steps of an eighth"
        );
        assert_eq!(span(64, 384, 3.0, 8), (0, 64));
        assert_eq!(span(1024, 384, f64::NAN, usize::MAX), (320, 384));
    }
}
