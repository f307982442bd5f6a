//! Diffusion of two beads across the channel and relative to each other, in the same flow.

use cellpos_numeric::Random;

/// The place of the second bead after a step, along the channel from the first and across the channel, um. Both diffuse: their
/// distance along the channel spreads with twice the variance. Hard spheres in one plane cannot pass through each other, so a
/// move that brings the centres nearer than a diameter is dropped. `room_um` is the diameter and the largest distance across.
pub(crate) fn diffuse(
    (along, across): (f64, f64),
    own_across: f64,
    spread_um: f64,
    (diameter_um, most_across_um): (f64, f64),
    random: &mut Random,
) -> (f64, f64) {
    let moved = (
        along + std::f64::consts::SQRT_2 * spread_um * random.normal(),
        confined(across + spread_um * random.normal(), most_across_um),
    );
    let apart = |(x, y): (f64, f64)| f64::hypot(x, y - own_across);
    // If the two overlap from the start they may separate.
    let nearest_um = diameter_um.min(apart((along, across)));
    if apart(moved) < nearest_um {
        (along, across)
    } else {
        moved
    }
}

/// Reflects a position across the channel at the borders of the frame's range.
pub(crate) fn confined(lateral_um: f64, limit_um: f64) -> f64 {
    if lateral_um.abs() <= limit_um {
        lateral_um
    } else {
        (2.0 * limit_um.copysign(lateral_um) - lateral_um).clamp(-limit_um, limit_um)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_beads_stay_a_diameter_apart_and_do_not_pass_each_other() {
        let mut random = Random::stream(5, 1);
        let (mut place, mut touched) = ((1.2, 0.0), 0);
        for _ in 0..200_000 {
            place = diffuse(place, 0.0, 0.02, (1.0, 0.25), &mut random);
            let apart_um = f64::hypot(place.0, place.1);
            assert!(apart_um >= 1.0 && place.0 > 0.0, "{place:?}");
            touched += i32::from(apart_um < 1.02);
        }
        assert!(touched > 100, "they must have met: {touched}");
    }

    #[test]
    fn beads_that_overlap_from_the_start_part() {
        let mut random = Random::stream(6, 1);
        let mut place = (0.3, 0.0);
        for _ in 0..20_000 {
            place = diffuse(place, 0.0, 0.02, (1.0, 0.25), &mut random);
        }
        assert!(f64::hypot(place.0, place.1) >= 1.0, "{place:?}");
    }
}
