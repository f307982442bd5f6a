//! Places of beads from half of their pixels, for what the other half says about the profile.
//!
//! Where noise is as strong as the bead, the template finds the place at which the noise looks like it, and the mean of what is
//! aligned on such places shows the template again, whatever it is: a spike aligned on the maxima of noise stays a spike. More
//! beads do not help, and two halves of the beads confirm it in each other (Henderson, PNAS 110, 18037, 2013, on pictures of
//! particles in noise). So a pixel says nothing about the profile at a place that it has chosen. The pixels have the colours of a
//! chessboard; those of each colour are taken at the places that fit those of the other colour best. Noise that is separate from
//! pixel to pixel then shows nothing, and a bead's two places tell how large the error is.

use crate::config::Polarity;
use crate::fix::squared;
use crate::objects::{Bead, Flat, colour};
use crate::template::Template;
use cellpos_numeric::statistics::median;
use core::f64::consts::LN_2;
use nalgebra::{Matrix4, Vector4};

/// Most steps of a fit.
const STEPS: usize = 8;
/// A step that is shorter ends a fit, px: a tenth of the least error that a fix states.
const SHORT_PX: f64 = 1e-4;

/// A pixel and its grey value without the images of other beads.
type Grey = (f64, f64, f64);

/// How far the two places of a bead may be apart without noise, px: half of the pixels see a narrow bead too coarsely. Places that
/// noise has chosen are a pixel or more apart.
const COARSE_PX: f64 = 0.1;
/// Largest square of the distance of the two places, in what the noise explains. The two places have nothing in common but the bead,
/// so that their distance shows the true error. If it is k times the stated one, a share of 4 Q(5 / k) of the fixes is off by more than
/// five stated standard deviations along row or column, Q being the tail of the normal distribution: one in a thousand at k = 1.44.
pub(super) const MOST_APART: f64 = 1.44 * 1.44;

/// Finds the places of the beads by the pixels of each colour, near those that all pixels have. Square of the distance of the two
/// places of a bead, in what the noise of the pixels explains, by the median of the beads with good fixes: that of a square of two
/// components is ln 2 of its mean.
pub(super) fn place(
    flats: &[Flat],
    beads: &mut [Bead],
    template: &Template,
    (polarity, reach_px): (Polarity, f64),
) -> Option<f64> {
    let mut places = Vec::with_capacity(beads.len());
    let mut apart = Vec::with_capacity(beads.len());
    for frame in beads.chunk_by(|a, b| a.at.frame == b.at.frame) {
        for bead in frame {
            let pixels = alone(flats, (bead, frame), template, reach_px);
            let by = |own: usize| {
                let of_own = |p: &&Grey| colour(p.0, p.1) == own;
                let of_own: Vec<Grey> = pixels.iter().filter(of_own).copied().collect();
                let start = (bead.at.x_px, bead.at.y_px);
                fitted(&of_own, start, template, polarity.sign())
            };
            // The one colour's place is for the other's pixels.
            let found = [by(1), by(0)];
            let [(a, var_a_px2), (b, var_b_px2)] = found;
            places.push([a, b]);
            if bead.image != 0.0
                && let (Some(va), Some(vb)) = (var_a_px2, var_b_px2)
            {
                let explained_px2 = va + vb + COARSE_PX * COARSE_PX;
                apart.push(squared(a.0 - b.0, a.1 - b.1) / explained_px2);
            }
        }
    }
    for (bead, places) in beads.iter_mut().zip(places) {
        bead.places = places;
    }
    (!apart.is_empty()).then(|| median(&apart) / LN_2)
}

/// The pixels of a bead without the images of the others in its frame.
fn alone(
    flats: &[Flat],
    (bead, frame): (&Bead, &[Bead]),
    template: &Template,
    reach_px: f64,
) -> Vec<Grey> {
    let at = &bead.at;
    let away_px2 = |other: &Bead| squared(other.at.x_px - at.x_px, other.at.y_px - at.y_px);
    let near_px2 = (template.support_px() + 2.0 * reach_px).powi(2);
    let near = |other: &&Bead| other.image != 0.0 && (1e-6..near_px2).contains(&away_px2(other));
    let near: Vec<&Bead> = frame.iter().filter(near).collect();
    let pixels = bead.pixels(flats, reach_px).into_iter().flatten();
    let alone = pixels.map(|p| {
        let image = |other: &&Bead| {
            let off_px2 = squared(p.x_px - other.at.x_px, p.y_px - other.at.y_px);
            other.image * f64::from(template.value_at_squared(off_px2 as f32))
        };
        let others: f64 = near.iter().map(image).sum();
        (p.x_px, p.y_px, p.grey - others)
    });
    alone.collect()
}

/// The place that fits the pixels best within half a radius, and its variance along row and column together: the best of a grid, then
/// the nearest least. From the place that all pixels have chosen the nearest least alone would be their choice again.
fn fitted(
    pixels: &[Grey],
    start: (f64, f64),
    template: &Template,
    sign: f64,
) -> ((f64, f64), Option<f64>) {
    let range = (0.5 * template.radius_px()) as i32;
    let steps = (-range..=range).flat_map(|i| (-range..=range).map(move |j| (i, j)));
    let grid = steps
        .filter(|(i, j)| i * i + j * j <= range * range)
        .map(|(i, j)| (start.0 + f64::from(i), start.1 + f64::from(j)));
    let of = |at: (f64, f64)| {
        let fitted = Fitted::new(pixels, at, template);
        (at, fitted.explained(sign), fitted)
    };
    let best = grid.map(of).max_by(|a, b| a.1.total_cmp(&b.1));
    let Some(mut best) = best else {
        return (start, None);
    };
    let mut share = 1.0;
    for _ in 0..STEPS {
        let Some((dx, dy)) = best.2.step() else {
            break;
        };
        let next = of((best.0.0 + share * dx, best.0.1 + share * dy));
        if next.1 > best.1 {
            best = next;
        } else {
            share *= 0.5;
        }
        if share * f64::hypot(dx, dy) < SHORT_PX {
            break;
        }
    }
    (best.0, best.2.variance_px2())
}

/// Sums of products over the pixels of a template at a place, its derivatives by the place, and a level.
struct Fitted {
    normal: Matrix4<f64>,
    right: Vector4<f64>,
    square: f64,
}

impl Fitted {
    fn new(pixels: &[Grey], (x_px, y_px): (f64, f64), template: &Template) -> Self {
        let mut sums = Fitted {
            normal: Matrix4::zeros(),
            right: Vector4::zeros(),
            square: 0.0,
        };
        for (u, v, grey) in pixels {
            let (dx, dy) = (u - x_px, v - y_px);
            let (value, slope) = template.at((dx * dx + dy * dy) as f32);
            let slope = -2.0 * f64::from(slope * template.slope_factor());
            let row = Vector4::new(1.0, f64::from(value), slope * dx, slope * dy);
            sums.normal += row * row.transpose();
            sums.right += row * *grey;
            sums.square += grey * grey;
        }
        sums
    }

    /// Sum of squares that the template explains beside a level; 0 with the other sign.
    fn explained(&self, sign: f64) -> f64 {
        let count = self.normal[(0, 0)].max(1.0);
        let common = self.right[1] - self.right[0] * self.normal[(0, 1)] / count;
        let own = self.normal[(1, 1)] - self.normal[(0, 1)].powi(2) / count;
        if sign * common > 0.0 && own > 0.0 {
            common * common / own
        } else {
            0.0
        }
    }

    /// Gauss-Newton's step of the place, px.
    fn step(&self) -> Option<(f64, f64)> {
        let found = self.normal.cholesky()?.solve(&self.right);
        let (dx, dy) = (found[2] / found[1], found[3] / found[1]);
        (dx.is_finite() && dy.is_finite()).then_some((dx, dy))
    }

    /// Sum of the variances along row and column that the scatter of the pixels about the template explains.
    fn variance_px2(&self) -> Option<f64> {
        let cholesky = self.normal.cholesky()?;
        let found = cholesky.solve(&self.right);
        let left = self.square - self.right.dot(&found);
        let noise = left / (self.normal[(0, 0)] - 4.0).max(1.0);
        let inverse = cholesky.inverse();
        let variance = noise * (inverse[(2, 2)] + inverse[(3, 3)]) / (found[1] * found[1]);
        (variance.is_finite() && variance > 0.0).then_some(variance)
    }
}
