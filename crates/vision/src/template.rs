//! The table of a profile that the fit and the renderer read, and which profile a configuration file names.

use crate::profile::{GaussianProfile, RadialProfile, RingProfile, SplineProfile};
use serde::{Deserialize, Serialize};
use wide::f32x4;

/// Values of a learnt profile.
pub const TABLE_KNOTS: usize = 32;

/// Which profile a bead has, as written in a configuration file.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
#[expect(
    clippy::large_enum_variant,
    reason = "read once; a table on the heap would make the settings of a whole rig not Copy"
)]
pub enum ProfileSpec {
    /// Learnt from a recording: a spline through values at equal distances, 1 at the extreme, 0 from the last on.
    Table {
        /// Radius of the bead, px: where the profile has fallen to 0.135 of its extreme, as a Gaussian has at two standard deviations.
        radius_px: f64,
        /// Distance of the values, px.
        knot_px: f64,
        /// Values from the centre outwards.
        values: [f64; TABLE_KNOTS],
    },
    /// [`RingProfile`].
    Ring {
        /// Radius at which the profile first crosses the background, px.
        edge_px: f64,
    },
    /// [`GaussianProfile`].
    Gaussian {
        /// Standard deviation, px.
        sigma_px: f64,
    },
}

impl ProfileSpec {
    /// The table of this profile; `None` for a size that is not finite and above zero.
    pub fn template(&self, response: PixelResponse) -> Option<Template> {
        match *self {
            ProfileSpec::Table {
                radius_px,
                knot_px,
                values,
            } => {
                SplineProfile::new(&values, knot_px, radius_px).map(|p| Template::new(&p, response))
            }
            ProfileSpec::Ring { edge_px } => {
                RingProfile::new(edge_px).map(|p| Template::new(&p, response))
            }
            ProfileSpec::Gaussian { sigma_px } => {
                GaussianProfile::new(sigma_px).map(|p| Template::new(&p, response))
            }
        }
    }
}

/// What a pixel reads of the profile.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PixelResponse {
    /// The value at the pixel's centre.
    #[default]
    Point,
    /// The mean over the pixel's area. Matters for spots narrower than about two pixels.
    Area,
}

/// Entries of a [`Template`]: a power of two, so that masking an index replaces a bounds check.
pub(crate) const TABLE_LEN: usize = 1024;

/// From this number on, single precision holds whole numbers only.
const TWO_TO_23: f32 = 8_388_608.0;

/// One entry: value, its change per entry, derivative with respect to the squared radius, its change per entry.
pub(crate) type Entry = [f32; 4];

/// A profile tabulated over the squared radius, so that a pixel costs no square root: value and derivative by linear
/// expansion about the nearest of 1024 entries. The interpolation error is below 3e-4 of the amplitude.
#[derive(Debug, Clone)]
pub struct Template {
    pub(crate) table: Box<[Entry; TABLE_LEN]>,
    entries_per_px2: f32,
    /// Size at which the bead is looked at, relative to the profile's: another focus changes it.
    size: f32,
    radius_px: f64,
    support_px: f64,
}

impl Template {
    /// Tabulates a profile. Allocates; done once, before frames come.
    pub fn new<P: RadialProfile + ?Sized>(profile: &P, response: PixelResponse) -> Self {
        let mut template = Template {
            table: Box::new([[0.0; 4]; TABLE_LEN]),
            entries_per_px2: 1.0,
            size: 1.0,
            radius_px: profile.radius_px(),
            support_px: profile.support_px(),
        };
        template.fill(profile.support_px(), |r_px| match response {
            PixelResponse::Point => profile.value(r_px),
            PixelResponse::Area => profile.pixel_value(r_px),
        });
        template
    }

    /// Tabulates another function of the radius in place; the bead's radius stays. Allocates nothing.
    pub(crate) fn fill(&mut self, support_px: f64, value: impl Fn(f64) -> f64) {
        let step_px2 = support_px * support_px / (TABLE_LEN - 1) as f64;
        let at = |i: usize| {
            if i < TABLE_LEN - 1 {
                value((i as f64 * step_px2).sqrt())
            } else {
                0.0
            }
        };
        // Five neighbouring values; those before the centre continue the first three as a parabola.
        let (v0, v1, v2) = (at(0), at(1), at(2));
        let mut v = [
            6.0 * v0 - 8.0 * v1 + 3.0 * v2,
            3.0 * v0 - 3.0 * v1 + v2,
            v0,
            v1,
            v2,
        ];
        for (i, entry) in self.table.iter_mut().enumerate() {
            // Derivatives from the table, so that value and derivative belong to the same function. An entry serves the half step
            // on either side of it.
            let slope = (v[3] - v[1]) / 2.0;
            let bend = (v[4] - 2.0 * v[2] + v[0]) / 4.0;
            *entry = [v[2], slope, slope / step_px2, bend / step_px2].map(|e| e as f32);
            v = [v[1], v[2], v[3], v[4], at(i + 3)];
        }
        // Beyond the support there is nothing.
        self.table[TABLE_LEN - 1] = [0.0; 4];
        self.entries_per_px2 = (1.0 / step_px2) as f32;
        self.size = 1.0;
        self.support_px = support_px;
    }

    /// Stretches the profile to a size relative to the one that was tabulated. Radius and support stay those of size 1.
    pub(crate) fn stretch_to(&mut self, size: f64) {
        let change = size as f32 / self.size;
        self.entries_per_px2 /= change * change;
        self.size = size as f32;
    }

    /// Size at which the bead is looked at, relative to the profile's.
    pub(crate) fn size(&self) -> f64 {
        f64::from(self.size)
    }

    /// Factor of the derivatives that [`Template::read`] gives, px^2/px^2: they are those at size 1.
    pub(crate) fn slope_factor(&self) -> f32 {
        1.0 / (self.size * self.size)
    }

    /// Place in the table of the squared radius `q_px2`: entry number in the low bits, and the distance to it.
    ///
    /// Adding 2^23 leaves no room for a fraction in the mantissa: it rounds to the nearest whole number and puts that
    /// number into the low bits. Unlike a float-to-integer cast this is done for several pixels at once.
    #[inline(always)]
    pub(crate) fn place(&self, q_px2: f32) -> (u32, f32) {
        let u = (q_px2 * self.entries_per_px2).min((TABLE_LEN - 1) as f32);
        let shifted = u + TWO_TO_23;
        (shifted.to_bits(), u - (shifted - TWO_TO_23))
    }

    /// Value and derivative with respect to the squared radius (1/px^2, over [`Template::slope_factor`]) at a
    /// [`Template::place`].
    #[inline(always)]
    pub(crate) fn read(&self, (entry, t): (u32, f32)) -> (f32, f32) {
        let e = &self.table[entry as usize & (TABLE_LEN - 1)];
        (e[0] + t * e[1], e[2] + t * e[3])
    }

    /// Value and derivative with respect to the squared radius (1/px^2, over [`Template::slope_factor`]) at the squared radius
    /// `q_px2`.
    #[inline(always)]
    pub(crate) fn at(&self, q_px2: f32) -> (f32, f32) {
        self.read(self.place(q_px2))
    }

    /// Entries for four squared radii, number by number, and the distances to them: [`Template::place`] for four pixels.
    #[inline(always)]
    fn entries(&self, q_px2: f32x4) -> ([f32x4; 4], f32x4) {
        let last = f32x4::splat((TABLE_LEN - 1) as f32);
        let u = (q_px2 * f32x4::splat(self.entries_per_px2)).fast_min(last);
        let shifted = u + f32x4::splat(TWO_TO_23);
        let entry = |v: f32| f32x4::from(self.table[v.to_bits() as usize & (TABLE_LEN - 1)]);
        let entries = shifted.to_array().map(entry);
        let distance = u - (shifted - f32x4::splat(TWO_TO_23));
        (f32x4::transpose(entries), distance)
    }

    /// [`Template::at`] for four squared radii.
    #[inline(always)]
    pub(crate) fn at_lanes(&self, q_px2: f32x4) -> (f32x4, f32x4) {
        let (e, t) = self.entries(q_px2);
        (e[0] + t * e[1], e[2] + t * e[3])
    }

    /// Sum of the second derivatives by the two directions at four squared radii, 1/px^2.
    #[inline(always)]
    pub(crate) fn laplacian(&self, q_px2: f32x4) -> f32x4 {
        let (e, t) = self.entries(q_px2);
        let bent = q_px2 * f32x4::splat(self.entries_per_px2) * e[3];
        f32x4::splat(4.0 * self.slope_factor()) * (e[2] + t * e[3] + bent)
    }

    /// Normalised value at the squared radius `q_px2` (px^2).
    #[inline]
    pub fn value_at_squared(&self, q_px2: f32) -> f32 {
        self.at(q_px2).0
    }

    /// Radius of the bead, px.
    pub fn radius_px(&self) -> f64 {
        self.radius_px
    }

    /// Radius beyond which the profile is zero, px.
    pub fn support_px(&self) -> f64 {
        self.support_px
    }

    /// Adds a bead of peak contrast `amplitude` centred at (`x_px`, `y_px`) to an image of `width` pixels per row.
    /// Only the pixels within the profile's support are touched; a centre outside the image is allowed.
    pub fn draw(&self, image: &mut [f32], width: usize, x_px: f64, y_px: f64, amplitude: f64) {
        if width == 0 || !x_px.is_finite() || !y_px.is_finite() {
            return;
        }
        let height = image.len() / width;
        let columns = span(x_px, self.support_px, width);
        let rows = span(y_px, self.support_px, height);
        let (x_px, y_px, amplitude) = (x_px as f32, y_px as f32, amplitude as f32);
        for (j, row) in image
            .chunks_exact_mut(width)
            .enumerate()
            .take(rows.1)
            .skip(rows.0)
        {
            let dy = j as f32 - y_px;
            let Some(part) = row.get_mut(columns.0..columns.1) else {
                continue;
            };
            for (k, pixel) in part.iter_mut().enumerate() {
                let dx = (columns.0 + k) as f32 - x_px;
                *pixel += amplitude * self.at(dx * dx + dy * dy).0;
            }
        }
    }
}

/// First pixel and one past the last within `reach_px` of `centre_px`, clipped to `0..len`.
pub(crate) fn span(centre_px: f64, reach_px: f64, len: usize) -> (usize, usize) {
    // A float-to-integer cast saturates: negative numbers become 0.
    let first = (centre_px - reach_px).ceil() as usize;
    let end = ((centre_px + reach_px).floor() + 1.0) as usize;
    (first.min(len), end.min(len))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn template_agrees_with_its_profile() {
        let ring = RingProfile::new(6.373).unwrap();
        let spot = GaussianProfile::new(1.0).unwrap();
        for (p, t) in [
            (
                &ring as &dyn RadialProfile,
                Template::new(&ring, PixelResponse::Point),
            ),
            (
                &spot as &dyn RadialProfile,
                Template::new(&spot, PixelResponse::Point),
            ),
        ] {
            for i in 0..2000 {
                let r = 0.01 * f64::from(i);
                let (v, g) = t.at((r * r) as f32);
                assert!(
                    (f64::from(v) - p.value(r)).abs() < 3e-4,
                    "value at {r}: {v} {}",
                    p.value(r)
                );
                assert!(
                    (2.0 * r * f64::from(g) - p.slope(r)).abs() < 4e-3,
                    "slope at {r}"
                );
            }
        }
    }

    #[test]
    fn sizes_that_are_not_above_zero_are_refused() {
        for bad in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            assert!(RingProfile::new(bad).is_none() && GaussianProfile::new(bad).is_none());
        }
    }

    #[test]
    fn drawing_clips_at_the_border_and_keeps_the_centre() {
        let t = ProfileSpec::Ring { edge_px: 4.0 }
            .template(PixelResponse::Point)
            .unwrap();
        let mut image = vec![0.0; 20 * 10];
        t.draw(&mut image, 20, 5.0, 5.0, 100.0);
        assert!((image[5 * 20 + 5] - 100.0).abs() < 1e-3);
        t.draw(&mut image, 20, -30.0, 4.0, 100.0);
        t.draw(&mut image, 20, 19.0, 9.9, 100.0);
        t.draw(&mut image, 20, f64::NAN, 4.0, 100.0);
        assert!(image.iter().all(|v| v.is_finite()));
    }
}
