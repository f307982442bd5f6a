//! Radial intensity profiles of beads.
//!
//! A profile is the grey value of a bead as a function of the distance from its centre, 1 at the centre and 0 far
//! away: an image is `background + amplitude * profile(r)`. Not for beads without circular symmetry.

/// Profile measured on 2.12 um beads in bright field: mean over 250 images of five beads (250,000 pixels), at
/// multiples of 0.1 edge radii, 1 at the centre (where few pixels contribute: smoothed). The edge is where the profile first crosses the background.
const RING_KNOTS: [f64; 27] = [
    1.0, 1.0035, 1.011, 1.0185, 1.015, 0.9755, 0.8838, 0.7338, 0.5443, 0.2905, 0.0, -0.2799,
    -0.4644, -0.5395, -0.5241, -0.4298, -0.276, -0.1124, -0.0044, 0.03, 0.0167, -0.0025, -0.011,
    -0.0071, -0.0017, 0.0, 0.0,
];

/// Knots per edge radius of [`RING_KNOTS`].
const RING_KNOTS_PER_EDGE: f64 = 10.0;

/// The radius, in standard deviations, beyond which the Gaussian is taken as zero (4e-6 of the peak).
const GAUSSIAN_SUPPORT_SIGMA: f64 = 5.0;

/// Normalised radial profile of a bead: 1 at the centre, 0 beyond [`RadialProfile::support_px`].
pub trait RadialProfile {
    /// Value at the radius `r_px` (px).
    fn value(&self, r_px: f64) -> f64;
    /// Derivative of the value with respect to the radius, 1/px.
    fn slope(&self, r_px: f64) -> f64;
    /// Radius of the bead, px: the edge of a ring profile, twice the standard deviation of a Gaussian.
    fn radius_px(&self) -> f64;
    /// Radius beyond which the profile is zero, px.
    fn support_px(&self) -> f64;

    /// Value averaged over the area of a pixel whose centre is at `r_px`: `f + (f'' + f'/r) / 24`, the first term of the average's
    /// expansion. The rest is of fourth order in the pixel over the bead's finest detail.
    fn pixel_value(&self, r_px: f64) -> f64 {
        const STEP_PX: f64 = 1e-2;
        let r_px = r_px.abs();
        let curvature =
            (self.slope(r_px + STEP_PX) - odd_slope(self, r_px - STEP_PX)) / (2.0 * STEP_PX);
        // f'/r tends to f'' at the centre of a smooth even profile.
        let transverse = if r_px < STEP_PX {
            curvature
        } else {
            self.slope(r_px) / r_px
        };
        self.value(r_px) + (curvature + transverse) / 24.0
    }
}

/// Slope continued to negative radii: a profile is even, its slope odd.
fn odd_slope<P: RadialProfile + ?Sized>(profile: &P, r_px: f64) -> f64 {
    if r_px < 0.0 {
        -profile.slope(-r_px)
    } else {
        profile.slope(r_px)
    }
}

/// Cubic spline through equally spaced samples of a radial profile, flat at the centre and at the end.
#[derive(Debug, Clone, PartialEq)]
pub struct SplineProfile {
    values: Vec<f64>,
    /// Second derivatives at the knots, per squared knot distance.
    curvatures: Vec<f64>,
    knot_px: f64,
    radius_px: f64,
}

impl SplineProfile {
    /// A profile through `values` at the radii 0, `knot_px`, 2 `knot_px` ..., zero beyond the last; `radius_px` is the
    /// bead's radius. `None` for fewer than three values, a value that is not finite, or a distance not above zero.
    pub fn new(values: &[f64], knot_px: f64, radius_px: f64) -> Option<Self> {
        let positive = |v: f64| v.is_finite() && v > 0.0;
        if values.len() < 3
            || !positive(knot_px)
            || !positive(radius_px)
            || values.iter().any(|v| !v.is_finite())
        {
            return None;
        }
        let (mut upper, mut curvatures) = (vec![0.0; values.len()], vec![0.0; values.len()]);
        clamped_curvatures(values, &mut upper, &mut curvatures);
        Some(SplineProfile {
            values: values.to_vec(),
            curvatures,
            knot_px,
            radius_px,
        })
    }

    /// Interval and position in it, `None` beyond the last knot.
    fn place(&self, r_px: f64) -> Option<(usize, f64)> {
        let u = r_px.abs() / self.knot_px;
        let last = self.values.len() - 1;
        // The comparison also turns NaN away.
        if u < last as f64 {
            Some((u as usize, u.fract()))
        } else {
            None
        }
    }
}

impl RadialProfile for SplineProfile {
    fn value(&self, r_px: f64) -> f64 {
        spline_value(&self.values, &self.curvatures, r_px.abs() / self.knot_px)
    }

    fn slope(&self, r_px: f64) -> f64 {
        let Some((i, t)) = self.place(r_px) else {
            return 0.0;
        };
        let (a, b) = (1.0 - t, t);
        let bend =
            (1.0 - 3.0 * a * a) * self.curvatures[i] + (3.0 * b * b - 1.0) * self.curvatures[i + 1];
        (self.values[i + 1] - self.values[i] + bend / 6.0) / self.knot_px
    }

    fn radius_px(&self) -> f64 {
        self.radius_px
    }

    fn support_px(&self) -> f64 {
        self.knot_px * (self.values.len() - 1) as f64
    }
}

/// Value of the spline at `u` knot distances from the centre, zero beyond the last knot.
pub(crate) fn spline_value(values: &[f64], curvatures: &[f64], u: f64) -> f64 {
    let i = u as usize;
    let (Some([v0, v1]), Some([c0, c1])) = (values.get(i..i + 2), curvatures.get(i..i + 2)) else {
        return 0.0;
    };
    let b = u - i as f64;
    let a = 1.0 - b;
    a * v0 + b * v1 + ((a * a * a - a) * c0 + (b * b * b - b) * c1) / 6.0
}

/// Second derivatives of the cubic spline with zero slope at both ends (tridiagonal elimination), unit knot distance,
/// into `curvatures`; `upper` is scratch. Both as long as `values`, three or more.
pub(crate) fn clamped_curvatures(values: &[f64], upper: &mut [f64], curvatures: &mut [f64]) {
    let n = values.len();
    let right_side = |i: usize| match i {
        0 => 6.0 * (values[1] - values[0]),
        i if i == n - 1 => 6.0 * (values[n - 2] - values[n - 1]),
        i => 6.0 * (values[i + 1] - 2.0 * values[i] + values[i - 1]),
    };
    for i in 0..n {
        let diagonal = if i == 0 || i == n - 1 { 2.0 } else { 4.0 };
        let (previous_upper, previous) = if i == 0 {
            (0.0, 0.0)
        } else {
            (upper[i - 1], curvatures[i - 1])
        };
        let pivot = diagonal - previous_upper;
        upper[i] = 1.0 / pivot;
        curvatures[i] = (right_side(i) - previous) / pivot;
    }
    for i in (0..n - 1).rev() {
        curvatures[i] -= upper[i] * curvatures[i + 1];
    }
}

/// Bright core with a dark ring, as a bead shows in bright field slightly out of focus: the measured profile, scaled.
///
/// For an edge radius of 6.37 px, as measured, the ring's minimum (-0.54) is at 8.5 px and the faint outer lobe (+0.03) at 12.1
/// px.
#[derive(Debug, Clone, PartialEq)]
pub struct RingProfile(SplineProfile);

impl RingProfile {
    /// Edge radius of the bead in the measured images, px.
    pub const MEASURED_EDGE_PX: f64 = 6.373;

    /// The measured profile scaled to an edge radius of `edge_px`; `None` unless that is finite and above zero.
    pub fn new(edge_px: f64) -> Option<Self> {
        SplineProfile::new(&RING_KNOTS, edge_px / RING_KNOTS_PER_EDGE, edge_px).map(RingProfile)
    }
}

impl RadialProfile for RingProfile {
    fn value(&self, r_px: f64) -> f64 {
        self.0.value(r_px)
    }
    fn slope(&self, r_px: f64) -> f64 {
        self.0.slope(r_px)
    }
    fn radius_px(&self) -> f64 {
        self.0.radius_px()
    }
    fn support_px(&self) -> f64 {
        self.0.support_px()
    }
}

/// A Gaussian spot, `exp(-r^2 / (2 sigma^2))`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GaussianProfile {
    sigma_px: f64,
}

impl GaussianProfile {
    /// A spot of standard deviation `sigma_px`; `None` unless that is finite and above zero.
    pub fn new(sigma_px: f64) -> Option<Self> {
        (sigma_px.is_finite() && sigma_px > 0.0).then_some(GaussianProfile { sigma_px })
    }
}

impl RadialProfile for GaussianProfile {
    fn value(&self, r_px: f64) -> f64 {
        let u = r_px / self.sigma_px;
        if u.abs() < GAUSSIAN_SUPPORT_SIGMA {
            (-0.5 * u * u).exp()
        } else {
            0.0
        }
    }
    fn slope(&self, r_px: f64) -> f64 {
        -r_px / (self.sigma_px * self.sigma_px) * self.value(r_px)
    }
    fn radius_px(&self) -> f64 {
        2.0 * self.sigma_px
    }
    fn support_px(&self) -> f64 {
        GAUSSIAN_SUPPORT_SIGMA * self.sigma_px
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn slope_by_difference<P: RadialProfile>(p: &P, r: f64) -> f64 {
        (p.value(r + 1e-5) - p.value(r - 1e-5)) / 2e-5
    }

    #[test]
    fn slope_is_the_derivative_of_the_value() {
        let ring = RingProfile::new(6.373).unwrap();
        let spot = GaussianProfile::new(3.0).unwrap();
        for i in 1..140 {
            let r = 0.1 * f64::from(i) + 0.003;
            assert!(
                (ring.slope(r) - slope_by_difference(&ring, r)).abs() < 1e-6,
                "ring at {r}"
            );
            assert!(
                (spot.slope(r) - slope_by_difference(&spot, r)).abs() < 1e-6,
                "spot at {r}"
            );
        }
    }

    #[test]
    fn ring_profile_has_the_measured_landmarks_at_any_scale() {
        for scale in [0.3, 1.0, 2.5] {
            let p = RingProfile::new(RingProfile::MEASURED_EDGE_PX * scale).unwrap();
            assert!((p.value(0.0) - 1.0).abs() < 1e-12);
            assert!(p.value(p.radius_px()).abs() < 1e-12);
            let minimum = (0..2000)
                .map(|i| 0.01 * f64::from(i) * scale)
                .min_by(|a, b| p.value(*a).total_cmp(&p.value(*b)));
            assert!((minimum.unwrap() / scale - 8.5).abs() < 0.2, "{minimum:?}");
            assert!(p.value(p.support_px() + 1e-9) == 0.0 && p.slope(1e9) == 0.0);
        }
    }

    #[test]
    fn spline_reproduces_its_knots_and_is_flat_at_the_centre() {
        let p = RingProfile::new(10.0).unwrap();
        for (i, v) in RING_KNOTS.iter().enumerate().take(26) {
            assert!((p.value(i as f64) - v).abs() < 1e-12);
        }
        assert!(p.slope(0.0).abs() < 1e-12);
    }

    #[test]
    fn pixel_value_is_the_mean_over_the_pixel() {
        let p = GaussianProfile::new(1.2).unwrap();
        for (x, y) in [(0.0, 0.0), (0.7, 0.3), (1.5, -1.1), (2.4, 0.2)] {
            let n = 40;
            let mut sum = 0.0;
            for i in 0..n {
                for j in 0..n {
                    let offset = |k: i32| (f64::from(k) + 0.5) / f64::from(n) - 0.5;
                    sum += p.value(f64::hypot(x + offset(i), y + offset(j)));
                }
            }
            let mean = sum / f64::from(n * n);
            let point_error = (p.value(f64::hypot(x, y)) - mean).abs();
            let error = (p.pixel_value(f64::hypot(x, y)) - mean).abs();
            assert!(
                error < 3e-3 && error < 0.1 * point_error + 1e-3,
                "{x} {y}: {error} {point_error}"
            );
        }
    }
}
