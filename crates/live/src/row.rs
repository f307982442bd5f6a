//! Ticks and frames as bytes for the page.

/// Bytes of one row on the wire.
pub(crate) const ROW_BYTES: usize = 64;
/// Bytes of a picture's head on the wire.
pub(crate) const PICTURE_HEAD: usize = 40;
/// Largest picture, pixels: a crop, not a frame.
pub const PICTURE_MARGIN: usize = 512 * 512;

/// Most points of an outline.
pub const OUTLINE_POINTS: usize = 200;

/// One tick as the page draws it. Numbers that do not exist are NaN.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Row {
    /// Sequence number of the tick.
    pub seq: u32,
    /// Time since the start of the run, s.
    pub time_s: f64,
    /// Measured position, um.
    pub measured_um: f32,
    /// Reference, um.
    pub target_um: f32,
    /// Reference at the exposure of the measurement, um; the error refers to it.
    pub target_then_um: f32,
    /// Commanded PZT displacement, um.
    pub command_um: f32,
    /// Displacement at which the bead is at rest, um.
    pub zero_flow_um: f32,
    /// Length of the cell, um.
    pub length_um: f32,
    /// Projected area of the cell, um^2.
    pub area_um2: f32,
    /// The plant's gain as the loop estimates it, over the model's.
    pub gain: f32,
    /// Start of the tick after its due time, us.
    pub wake_us: f32,
    /// Start of the tick to the hand-over of the command, us.
    pub compute_us: f32,
    /// Flags of the tick.
    pub flags: u32,
    /// Life-cycle state.
    pub life: u8,
}

impl Default for Row {
    fn default() -> Self {
        Self {
            seq: 0,
            time_s: 0.0,
            measured_um: f32::NAN,
            target_um: f32::NAN,
            target_then_um: f32::NAN,
            command_um: f32::NAN,
            zero_flow_um: f32::NAN,
            length_um: f32::NAN,
            area_um2: f32::NAN,
            gain: f32::NAN,
            wake_us: 0.0,
            compute_us: 0.0,
            flags: 0,
            life: 0,
        }
    }
}

impl Row {
    /// Appends the row, little-endian, [`ROW_BYTES`] long.
    pub(crate) fn encode(&self, out: &mut Vec<u8>) {
        out.extend(self.time_s.to_le_bytes());
        out.extend(self.seq.to_le_bytes());
        out.extend(self.flags.to_le_bytes());
        for value in [
            self.measured_um,
            self.target_um,
            self.target_then_um,
            self.command_um,
            self.zero_flow_um,
            self.length_um,
            self.wake_us,
            self.compute_us,
            self.area_um2,
            self.gain,
        ] {
            out.extend(value.to_le_bytes());
        }
        out.extend([self.life, 0, 0, 0, 0, 0, 0, 0]);
    }
}

/// A crop of a frame, 8 bits, with vision's result. Positions are along the channel in um; places are in px of the crop.
#[derive(Debug, Clone, PartialEq)]
pub struct Picture {
    /// Columns.
    pub width: u16,
    /// Rows.
    pub height: u16,
    /// `width * height` grey values, row by row.
    pub pixels: Vec<u8>,
    /// Size of a pixel along the channel, um; negative if the channel runs against the columns.
    pub um_per_px: f32,
    /// Whether the channel runs along the rows (`false`) or the columns (`true`) of pixels.
    pub upright: bool,
    /// Position along the channel of the centre of the first pixel, um.
    pub first_um: f32,
    /// Centre of bead or cell, px; NaN without one.
    pub centre_px: [f32; 2],
    /// Half width of the mark around it, px, along columns and rows.
    pub half_px: [f32; 2],
    /// Outline of the cell, px; empty for a bead.
    pub outline_px: Vec<[f32; 2]>,
    /// Half width of the search gate, px; NaN without one.
    pub gate_px: f32,
    /// Time since the start of the run, s.
    pub time_s: f32,
}

impl Picture {
    /// Head and pixels, little-endian, after the message's own head.
    pub(crate) fn encode(&self, out: &mut Vec<u8>) {
        out.extend(self.width.to_le_bytes());
        out.extend(self.height.to_le_bytes());
        let points = self.outline_px.len().min(OUTLINE_POINTS);
        out.extend([u8::from(self.upright), points as u8, 0, 0]);
        for value in [
            self.um_per_px,
            self.first_um,
            self.centre_px[0],
            self.centre_px[1],
            self.half_px[0],
            self.half_px[1],
            self.gate_px,
            self.time_s,
        ] {
            out.extend(value.to_le_bytes());
        }
        out.extend(&self.pixels);
        if points > 0 {
            // The page reads them in place, so they are aligned to a multiple of their size.
            out.resize(out.len().next_multiple_of(4), 0);
            for value in self.outline_px.iter().take(points).flatten() {
                out.extend(value.to_le_bytes());
            }
        }
    }

    /// Whether size and pixels agree and the crop is small enough to be sent.
    pub(crate) fn is_sound(&self) -> bool {
        let size = usize::from(self.width) * usize::from(self.height);
        size == self.pixels.len() && size > 0 && size <= PICTURE_MARGIN
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_row_and_a_pictures_head_have_the_size_that_the_page_reads() {
        let mut bytes = vec![];
        Row::default().encode(&mut bytes);
        assert_eq!(bytes.len(), ROW_BYTES);
        bytes.clear();
        let picture = Picture {
            width: 3,
            height: 2,
            pixels: vec![7; 6],
            um_per_px: 0.1,
            upright: false,
            first_um: -1.0,
            centre_px: [1.0, 0.5],
            half_px: [2.0, 2.0],
            outline_px: vec![],
            gate_px: f32::NAN,
            time_s: 0.5,
        };
        assert!(picture.is_sound());
        picture.encode(&mut bytes);
        assert_eq!(bytes.len(), PICTURE_HEAD + 6);
        bytes.clear();
        let outlined = Picture {
            outline_px: vec![[0.5, 1.0]; OUTLINE_POINTS + 1],
            ..picture
        };
        outlined.encode(&mut bytes);
        assert_eq!(bytes.len(), PICTURE_HEAD + 8 + 8 * OUTLINE_POINTS);
    }
}
