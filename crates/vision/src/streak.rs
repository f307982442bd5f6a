//! A bead that moves while the shutter is open: its image is drawn out along the motion.
//!
//! The image is the mean of the template along the way, taken at teeth of equal times, near enough to each other to pass for a line. A
//! command that takes effect meanwhile changes the speed: the slower half of the way is the brighter one. The position is the mean of the
//! way; at constant velocity that is its middle.

/// Ways shorter than this are no streak, in bead radii: the second-order blur of such a way (0.0033 squared radii of variance) is
/// below the uncertainty of any template.
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
    /// Half of the difference between the second half of the way and the first, per tooth.
    turn_x_px: f32,
    turn_y_px: f32,
}

/// The way of a bead during an exposure, px.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct Way {
    /// From the start to the end.
    pub whole_px: (f64, f64),
    /// Length of the second half less the first.
    pub turn_px: (f64, f64),
}

impl Way {
    /// The same at another speed.
    pub(crate) fn times(self, factor: f64) -> Self {
        let times = |(x, y): (f64, f64)| (factor * x, factor * y);
        Self {
            whole_px: times(self.whole_px),
            turn_px: times(self.turn_px),
        }
    }
}

impl Comb {
    /// A bead at rest.
    pub(crate) const STILL: Comb = Comb {
        teeth: 1,
        step_x_px: 0.0,
        step_y_px: 0.0,
        turn_x_px: 0.0,
        turn_y_px: 0.0,
    };

    /// The comb of a way for a bead of the radius `radius_px`.
    pub(crate) fn new(way: Way, radius_px: f64) -> Self {
        let (x_px, y_px) = way.whole_px;
        // No half is run backwards.
        let turn = |turn_px: f64, whole_px: f64| turn_px.clamp(-whole_px.abs(), whole_px.abs());
        let length_px = f64::hypot(x_px, y_px);
        // The comparison also turns NaN away.
        if length_px > LEAST_RADII * radius_px && length_px.is_finite() {
            let teeth =
                ((length_px / (TOOTH_RADII * radius_px)).ceil() as usize).clamp(2, MOST_TEETH);
            Comb {
                teeth,
                step_x_px: (x_px / teeth as f64) as f32,
                step_y_px: (y_px / teeth as f64) as f32,
                turn_x_px: (turn(way.turn_px.0, x_px) / teeth as f64) as f32,
                turn_y_px: (turn(way.turn_px.1, y_px) / teeth as f64) as f32,
            }
        } else {
            Comb::STILL
        }
    }

    /// Whether the bead counts as at rest.
    pub(crate) fn is_still(&self) -> bool {
        self.teeth == 1
    }

    /// Number of teeth: images that are drawn for one bead.
    pub(crate) fn teeth(&self) -> usize {
        self.teeth
    }

    /// Share of each tooth in the image.
    pub(crate) fn share(&self) -> f32 {
        1.0 / self.teeth as f32
    }

    /// Offsets of the teeth from their mean, px.
    pub(crate) fn offsets(&self) -> impl Iterator<Item = (f32, f32)> {
        let comb = *self;
        let n = comb.teeth as f32;
        let middle = 0.5 * (n - 1.0);
        // Mean distance of the teeth from the middle one.
        let mean = if comb.teeth.is_multiple_of(2) {
            0.25 * n
        } else {
            0.25 * (n - 1.0 / n)
        };
        (0..comb.teeth).map(move |k| {
            let at = k as f32 - middle;
            let turned = at.abs() - mean;
            (
                at * comb.step_x_px + turned * comb.turn_x_px,
                at * comb.step_y_px + turned * comb.turn_y_px,
            )
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn straight(whole_px: (f64, f64)) -> Way {
        Way {
            whole_px,
            ..Way::default()
        }
    }

    #[test]
    fn teeth_stand_evenly_about_the_middle_and_span_the_way() {
        let comb = Comb::new(straight((6.0, 8.0)), 5.0);
        let offsets: Vec<_> = comb.offsets().collect();
        assert_eq!(offsets.len(), 10);
        let (x, y) = offsets[9];
        // Ten teeth of a way of 10 px are in the middles of its ten parts.
        assert!((f32::hypot(x, y) - 4.5).abs() < 1e-5, "{x} {y}");
        assert!((offsets[0].0 + x).abs() < 1e-6 && (offsets[0].1 + y).abs() < 1e-6);
    }

    #[test]
    fn short_ways_and_what_is_no_number_count_as_rest() {
        for way in [(0.9, 0.0), (f64::NAN, 0.0), (f64::INFINITY, 1.0)] {
            assert!(Comb::new(straight(way), 5.0).is_still(), "{way:?}");
        }
    }

    #[test]
    fn teeth_of_a_way_that_grows_faster_stand_at_equal_times_about_their_mean() {
        for whole_px in [9.0, 10.0] {
            let way = Way {
                whole_px: (whole_px, 0.0),
                turn_px: (4.0, 0.0),
            };
            let along: Vec<f32> = Comb::new(way, 5.0).offsets().map(|o| o.0).collect();
            let n = along.len();
            let mean = along.iter().sum::<f32>() / n as f32;
            assert!(mean.abs() < 1e-5, "{along:?}");
            // The halves of the way are 2 px shorter and longer than the half of the whole.
            let speed = |pair: &[f32]| (pair[1] - pair[0]) * n as f32;
            let (first, last) = (speed(&along[..2]), speed(&along[n - 2..]));
            assert!(
                (f64::from(first) - whole_px + 4.0).abs() < 1e-4,
                "{along:?}"
            );
            assert!((f64::from(last) - whole_px - 4.0).abs() < 1e-4, "{along:?}");
        }
    }
}
