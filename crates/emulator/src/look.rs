//! The look of a bead in the emulated camera.

use cellpos_vision::RadialProfile;
use cellpos_vision::profile::{RingProfile, SplineProfile};
use serde::{Deserialize, Serialize};

/// Shape of the bead's picture; the sign of `contrast_grey` makes it bright or dark.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum BeadLook {
    /// A core in a ring of the other sign, as a bead somewhat out of focus in bright field.
    #[default]
    Ring,
    /// A disc of one grey with a soft edge, as an absorbing bead in focus.
    Disc,
    /// A Gaussian spot, as a bead smaller than the resolution; the radius is two standard deviations.
    Spot,
}

/// The picture's radial profile.
#[derive(Debug, Clone)]
pub(crate) enum Look {
    Ring(RingProfile),
    Sampled(SplineProfile),
}

impl Look {
    /// `None` when the bead's radius makes no profile.
    pub(crate) fn new(look: BeadLook, radius_px: f64) -> Option<Self> {
        /// Knots to the radius.
        const FINE: u16 = 10;
        let sampled = |radii: u16, value: fn(f64) -> f64| {
            let values: Vec<f64> = (0..=radii * FINE)
                .map(|knot| value(f64::from(knot) / f64::from(FINE)))
                .collect();
            let knot_px = radius_px / f64::from(FINE);
            SplineProfile::new(&values, knot_px, radius_px).map(Self::Sampled)
        };
        match look {
            BeadLook::Ring => RingProfile::new(radius_px).map(Self::Ring),
            // The edge rises from a tenth to nine tenths over a third of the radius; 2e-6 remains at twice the radius.
            BeadLook::Disc => sampled(2, |r| 1.0 / (1.0 + ((r - 1.0) * 13.0).exp())),
            // Cut at four standard deviations, at 3e-4.
            BeadLook::Spot => sampled(2, |r| (-2.0 * r * r).exp()),
        }
    }

    fn profile(&self) -> &dyn RadialProfile {
        match self {
            Self::Ring(profile) => profile,
            Self::Sampled(profile) => profile,
        }
    }
}

impl RadialProfile for Look {
    fn value(&self, r_px: f64) -> f64 {
        self.profile().value(r_px)
    }

    fn slope(&self, r_px: f64) -> f64 {
        self.profile().slope(r_px)
    }

    fn radius_px(&self) -> f64 {
        self.profile().radius_px()
    }

    fn support_px(&self) -> f64 {
        self.profile().support_px()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_look_is_one_in_the_middle_and_nothing_far_away() {
        for (look, at_radius) in [
            (BeadLook::Ring, 0.0),
            (BeadLook::Disc, 0.5),
            (BeadLook::Spot, (-2.0_f64).exp()),
        ] {
            let radius_px = 5.0;
            let profile = Look::new(look, radius_px).unwrap();
            assert!((profile.value(0.0) - 1.0).abs() < 1e-3, "{look:?}");
            let edge = profile.value(radius_px);
            assert!((edge - at_radius).abs() < 1e-3, "{look:?}: {edge}");
            assert!(profile.value(0.999 * profile.support_px()).abs() < 1e-3);
            assert_eq!(profile.value(1.001 * profile.support_px()), 0.0);
        }
    }
}
