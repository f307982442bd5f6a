//! What stands out of a frame's smooth background, in either polarity.

use crate::blobs::Blobs;
use crate::config::MAX_WINDOW_PX;
use crate::fix::{Fix, squared};
use crate::frame::{Frame, Pixels};
use crate::seed;
use crate::speckle;
use crate::symmetry::RadialSymmetry;
use crate::template::{Template, span};

/// Contrast of an object over the noise of a mean of 5 x 5 pixels.
const LEAST_SIGMA: f32 = 6.0;
/// Share of the strongest contrast that an object has.
const LEAST_SHARE: f32 = 0.15;

/// Objects refused, by reason.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Refused {
    /// Cut by the border.
    pub at_border: usize,
    /// Of another size or contrast than most.
    pub other: usize,
    /// Not fitted by the mean profile.
    pub bad_fit: usize,
}

/// An object that stands out.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Object {
    pub frame: usize,
    pub x_px: f64,
    pub y_px: f64,
    pub radius_px: f64,
    pub contrast: f64,
    /// Whether the border cuts it: its place is only about right, and nothing is learnt from it.
    pub cut: bool,
}

/// A pixel of a bead.
#[derive(Debug, Clone, Copy)]
pub(crate) struct OfBead {
    pub x_px: f64,
    pub y_px: f64,
    /// Distance from the bead's place for this pixel, px.
    pub r_px: f64,
    pub grey: f64,
}

/// An object that a profile is learnt from.
#[derive(Debug, Clone)]
pub(crate) struct Bead {
    pub at: Object,
    /// Contrast of its image, in those of the others.
    pub contrast: f64,
    /// Contrast of its image with its sign, grey levels; 0 of what has no good fix.
    pub image: f64,
    /// Whether the profile is learnt from it.
    pub counts: bool,
    /// Its place for the pixels of either colour of a chessboard, px: [`Bead::place_for`].
    pub places: [(f64, f64); 2],
    /// Places of the objects about it, px.
    others: Vec<(f64, f64)>,
}

impl Bead {
    /// The object, with those of `all`, in the order of their frames, that may be nearer to a pixel within `reach_px` than it is.
    pub(crate) fn among(at: &Object, all: &[Object], reach_px: f64) -> Self {
        let place = |o: &Object| (o.x_px, o.y_px);
        let first = all.partition_point(|o| o.frame < at.frame);
        let end = all.partition_point(|o| o.frame <= at.frame);
        let near = |o: &&Object| {
            place(o) != place(at)
                && squared(o.x_px - at.x_px, o.y_px - at.y_px) < (2.0 * reach_px).powi(2)
        };
        Bead {
            at: *at,
            contrast: 1.0,
            image: 0.0,
            counts: true,
            places: [place(at); 2],
            others: all[first..end].iter().filter(near).map(place).collect(),
        }
    }

    /// Its place for what a pixel says about its profile: the pixel had no part in finding it ([`crate::suggest`]).
    pub(crate) fn place_for(&self, x_px: f64, y_px: f64) -> (f64, f64) {
        self.places[colour(x_px, y_px)]
    }

    /// The pixels up to `reach_px` along row and column. Those that are nearer to another object are not among them.
    pub(crate) fn pixels<'a>(
        &'a self,
        flats: &'a [Flat],
        reach_px: f64,
    ) -> Option<impl Iterator<Item = OfBead> + 'a> {
        let flat = flats.get(self.at.frame)?;
        let (x_px, y_px) = (self.at.x_px, self.at.y_px);
        let (x0, x1) = span(x_px, reach_px, flat.width);
        let (y0, y1) = span(y_px, reach_px, flat.height);
        let all = (y0..y1).flat_map(move |y| (x0..x1).map(move |x| (x, y)));
        Some(all.filter_map(move |(x, y)| {
            let (u, v) = (x as f64, y as f64);
            let off_px2 = squared(u - x_px, v - y_px);
            let nearest = |(a, b): &(f64, f64)| squared(u - a, v - b) >= off_px2;
            let own = self.others.iter().all(nearest);
            let (bead_x_px, bead_y_px) = self.place_for(u, v);
            own.then(|| OfBead {
                x_px: u,
                y_px: v,
                r_px: f64::hypot(u - bead_x_px, v - bead_y_px),
                grey: f64::from(flat.values[y * flat.width + x]),
            })
        }))
    }
}

/// Which colour a pixel has on a chessboard.
pub(crate) fn colour(x_px: f64, y_px: f64) -> usize {
    (x_px + y_px) as usize % 2
}

/// Fewest frames whose median shows the scene.
const FEWEST_FRAMES: usize = 9;

/// The picture that the frames share: the median of each pixel. It counts where the halves of the frames predict each other better
/// than zero does, and is zero elsewhere. The measure is the mean absolute difference, which a median makes least. `None` if there are
/// too few frames, or their sizes differ.
pub(crate) fn scene(flats: &[Flat]) -> Option<Vec<f32>> {
    let first = flats.first()?;
    let alike = |flat: &Flat| (flat.width, flat.height) == (first.width, first.height);
    if flats.len() < FEWEST_FRAMES || !flats.iter().all(alike) {
        return None;
    }
    let mut greys = Vec::with_capacity(flats.len());
    let mut median = |of: &[f32]| {
        greys.clear();
        greys.extend_from_slice(of);
        let middle = greys.len() / 2;
        *greys.select_nth_unstable_by(middle, f32::total_cmp).1
    };
    let mut values = Vec::with_capacity(flats.len());
    let scene = (0..first.values.len()).map(|pixel| {
        values.clear();
        values.extend(flats.iter().step_by(2).map(|flat| flat.values[pixel]));
        let even = values.len();
        values.extend(
            flats
                .iter()
                .skip(1)
                .step_by(2)
                .map(|flat| flat.values[pixel]),
        );
        let (evens, odds) = values.split_at(even);
        let mut gain = 0.0;
        for (by, of) in [(median(evens), odds), (median(odds), evens)] {
            gain += of
                .iter()
                .map(|v| f64::from(v.abs() - (v - by).abs()))
                .sum::<f64>();
        }
        if gain > 0.0 { median(&values) } else { 0.0 }
    });
    Some(scene.collect())
}

/// A frame as grey levels above its smooth background.
#[derive(Clone)]
pub(crate) struct Flat {
    pub width: usize,
    pub height: usize,
    pub values: Vec<f32>,
    pub noise: f32,
}

impl Flat {
    pub(crate) fn new(frame: &Frame) -> Self {
        let (values, noise) = match frame.pixels {
            Pixels::Mono8(p) => (
                p.iter().map(|v| f32::from(*v)).collect(),
                seed::background(p).1,
            ),
            Pixels::Mono16(p) => (
                p.iter().map(|v| f32::from(*v)).collect(),
                seed::background(p).1,
            ),
        };
        let mut flat = Flat {
            width: frame.width,
            height: frame.height,
            values,
            noise: noise.max(0.29) as f32,
        };
        speckle::clean_picture(&mut flat.values, flat.width, flat.noise);
        flat.flatten();
        flat
    }

    /// Subtracts a parabola fitted to the pixels outside the object.
    pub(crate) fn flatten(&mut self) {
        use nalgebra::{SMatrix, SVector};
        let (width, height) = (self.width.max(1) as f64, self.height.max(1) as f64);
        let terms = |k: usize| {
            let u = (k % self.width) as f64 / width - 0.5;
            let v = (k / self.width) as f64 / height - 0.5;
            SVector::<f64, 6>::from([1.0, u, v, u * u, u * v, v * v])
        };
        let mut limit = f64::INFINITY;
        let mut fitted = SVector::<f64, 6>::zeros();
        for _ in 0..6 {
            let (mut normal, mut right) =
                (SMatrix::<f64, 6, 6>::zeros(), SVector::<f64, 6>::zeros());
            let (mut off, mut n) = (0.0, 0.0_f64);
            for (k, v) in self.values.iter().enumerate().step_by(3) {
                let g = terms(k);
                let residual = f64::from(*v) - fitted.dot(&g);
                if limit.is_infinite() || residual.abs() <= limit {
                    normal += g * g.transpose();
                    right += g * f64::from(*v);
                    off += residual.abs();
                    n += 1.0;
                }
            }
            let Some(cholesky) = normal.cholesky() else {
                break;
            };
            fitted = cholesky.solve(&right);
            limit = if limit.is_infinite() {
                f64::MAX
            } else {
                2.5 * 1.25 * off / n.max(1.0)
            };
        }
        let plane: Vec<f32> = (0..self.values.len())
            .map(|k| fitted.dot(&terms(k)) as f32)
            .collect();
        for (v, p) in self.values.iter_mut().zip(plane) {
            *v -= p;
        }
    }

    /// Subtracts a picture of the same size.
    pub(crate) fn subtract(&mut self, other: &[f32]) {
        self.values.iter_mut().zip(other).for_each(|(v, o)| *v -= o);
    }

    /// Subtracts the image of a bead.
    pub(crate) fn take_out(&mut self, template: &Template, fix: &Fix) {
        let (x0, x1) = span(fix.x_px, template.support_px(), self.width);
        let (y0, y1) = span(fix.y_px, template.support_px(), self.height);
        for (x, y) in (y0..y1).flat_map(|y| (x0..x1).map(move |x| (x, y))) {
            let off_px2 = squared(x as f64 - fix.x_px, y as f64 - fix.y_px);
            self.values[y * self.width + x] -=
                fix.amplitude as f32 * template.value_at_squared(off_px2 as f32);
        }
    }

    /// Mean of the contrast's square over 5 x 5 pixels, as a root.
    pub(crate) fn strength(&self) -> Vec<f32> {
        let (w, h) = (self.width, self.height);
        let mut rows = vec![0.0; w * h];
        for (row, values) in rows.chunks_exact_mut(w).zip(self.values.chunks_exact(w)) {
            for (x, sum) in row.iter_mut().enumerate() {
                let near = &values[x.saturating_sub(2)..(x + 3).min(w)];
                *sum = near.iter().map(|v| v * v).sum::<f32>() / near.len() as f32;
            }
        }
        (0..w * h)
            .map(|k| {
                let (x, y) = (k % w, k / w);
                let near = y.saturating_sub(2)..(y + 3).min(h);
                let count = near.len() as f32;
                (near.map(|j| rows[j * w + x]).sum::<f32>() / count).sqrt()
            })
            .collect()
    }

    pub(crate) fn objects(&self, frame: usize, objects: &mut Vec<Object>, refused: &mut Refused) {
        let strength = self.strength();
        let strongest = strength.iter().fold(0.0_f32, |a, b| a.max(*b));
        // The RMS of noise alone is `noise`, and scatters by a seventh of it.
        let least = self.noise * (1.0 + LEAST_SIGMA / 7.0);
        let threshold = least.max(LEAST_SHARE * strongest);
        let mut blobs = Blobs::new(self.width / 2 + 1, 16 * 1024);
        let row = |y: usize, to: &mut [f32]| {
            to.copy_from_slice(&strength[y * self.width..(y + 1) * self.width]);
        };
        let found = blobs.label((self.width, self.height), threshold, 20.0, row);
        for blob in found {
            refused.at_border += usize::from(blob.at_border);
            // The mean over 5 x 5 pixels has made it wider by two pixels all round.
            let radius_px = ((blob.area_px / core::f64::consts::PI).sqrt() - 2.0).max(1.5);
            let side = (2.0 * 1.2 * radius_px).ceil() as usize | 1;
            let [left, top, right, bottom] = blob.bounds;
            let middle = (
                0.5 * (f64::from(left) + f64::from(right) - 1.0),
                0.5 * (f64::from(top) + f64::from(bottom) - 1.0),
            );
            let whole = !blob.at_border;
            let (x_px, y_px) = whole
                .then(|| self.centre(middle, side.clamp(7, MAX_WINDOW_PX)))
                .flatten()
                .unwrap_or(middle);
            objects.push(Object {
                frame,
                x_px,
                y_px,
                radius_px,
                contrast: blob.peak,
                cut: blob.at_border,
            });
        }
    }

    /// Centre of symmetry near a place.
    pub(crate) fn centre(&self, (x, y): (f64, f64), side: usize) -> Option<(f64, f64)> {
        let scale = 20.0 / self.noise;
        let grey: Vec<u16> = self
            .values
            .iter()
            .map(|v| (32_768.0 + scale * v).clamp(0.0, 65_535.0) as u16)
            .collect();
        let frame = Frame {
            width: self.width,
            height: self.height,
            pixels: Pixels::Mono16(&grey),
        };
        let mut symmetry = RadialSymmetry::new(side);
        let found = symmetry.locate(&frame, x, y)?;
        (f64::hypot(found.0 - x, found.1 - y) < 0.35 * side as f64).then_some(found)
    }
}
