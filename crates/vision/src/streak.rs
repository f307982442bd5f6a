//! A bead that moves while the shutter is open: its image is drawn out along the motion.
//!
//! At constant velocity the image is the mean of the template along the way, and the middle of the way is the position at
//! mid-exposure. The mean is taken at equally spaced teeth, near enough to each other to pass for a line.

/// Ways shorter than this are no streak, in bead radii: the second-order blur of such a way (0.0033 squared radii of
/// variance) is below what a template is ever known to.
const LEAST_RADII: f64 = 0.2;
/// Distance of the teeth, in bead radii.
const TOOTH_RADII: f64 = 0.2;
/// Most teeth; a longer way is not resolved.
const MOST_TEETH: usize = 48;

/// Teeth along the way of one exposure, about its middle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Comb {
    teeth: usize,
    step_x_px: f32,
    step_y_px: f32,
}

impl Comb {
    /// A bead at rest.
    pub(crate) const STILL: Comb = Comb {
        teeth: 1,
        step_x_px: 0.0,
        step_y_px: 0.0,
    };

    /// The comb of a way (px, from the start to the end of the exposure) for a bead of the radius `radius_px`.
    pub(crate) fn new((x_px, y_px): (f64, f64), radius_px: f64) -> Self {
        let length_px = f64::hypot(x_px, y_px);
        // The comparison also turns NaN away.
        if length_px > LEAST_RADII * radius_px && length_px.is_finite() {
            let teeth =
                ((length_px / (TOOTH_RADII * radius_px)).ceil() as usize).clamp(2, MOST_TEETH);
            Comb {
                teeth,
                step_x_px: (x_px / teeth as f64) as f32,
                step_y_px: (y_px / teeth as f64) as f32,
            }
        } else {
            Comb::STILL
        }
    }

    /// Whether the bead counts as at rest.
    pub(crate) fn is_still(&self) -> bool {
        self.teeth == 1
    }

    /// Share of each tooth in the image.
    pub(crate) fn share(&self) -> f32 {
        1.0 / self.teeth as f32
    }

    /// Offsets of the teeth from the middle, px.
    pub(crate) fn offsets(&self) -> impl Iterator<Item = (f32, f32)> {
        let Comb {
            teeth,
            step_x_px,
            step_y_px,
        } = *self;
        let middle = 0.5 * (teeth as f32 - 1.0);
        (0..teeth).map(move |k| {
            let at = k as f32 - middle;
            (at * step_x_px, at * step_y_px)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn teeth_stand_evenly_about_the_middle_and_span_the_way() {
        let comb = Comb::new((6.0, 8.0), 5.0);
        let offsets: Vec<_> = comb.offsets().collect();
        assert_eq!(offsets.len(), 10);
        let (x, y) = offsets[9];
        // Ten teeth of a way of 10 px stand in the middles of its ten parts.
        assert!((f32::hypot(x, y) - 4.5).abs() < 1e-5, "{x} {y}");
        assert!((offsets[0].0 + x).abs() < 1e-6 && (offsets[0].1 + y).abs() < 1e-6);
    }

    #[test]
    fn short_ways_and_what_is_no_number_count_as_rest() {
        for way in [(0.9, 0.0), (f64::NAN, 0.0), (f64::INFINITY, 1.0)] {
            assert!(Comb::new(way, 5.0).is_still(), "{way:?}");
        }
    }
}
