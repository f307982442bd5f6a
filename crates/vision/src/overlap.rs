//! The radial profile of beads whose images overlap: all beads of a frame explain each pixel together.
//!
//! The picture is linear in the profile, so one profile that all beads share is found in one step, wherever their images overlap.
//! As in [`crate::smooth`] it is a parametric profile and a smooth deviation that the halves of the beads confirm in each other.
//! Each bead's surroundings have a separate level; the deviation ends with the profile, so that no level is part of it.

use crate::fix::squared;
use crate::objects::{Bead, Flat};
use crate::smooth::{BINS, LEAST_GAIN, Learnt, PENALTIES, Parametric, basis, knots, mirrored};
use nalgebra::{DMatrix, DVector};

/// Sums of products over the pixels of a half of the beads: the coefficients of the deviation, the parametric profile, and last
/// the grey value.
struct Sums {
    products: DMatrix<f64>,
    pixels: f64,
}

impl Sums {
    fn prior(&self) -> usize {
        self.products.nrows() - 2
    }

    fn grey(&self) -> usize {
        self.products.nrows() - 1
    }

    /// Contrast of the parametric profile that fits best.
    fn contrast(&self) -> f64 {
        let prior = self.prior();
        self.products[(prior, self.grey())] / self.products[(prior, prior)]
    }

    /// Sum of squares that the parametric profile leaves at a contrast, and what each coefficient has in common with that.
    fn beyond(&self, contrast: f64) -> (f64, DVector<f64>) {
        let (p, v) = (self.prior(), self.grey());
        let g = &self.products;
        let left = g[(v, v)] - contrast * (2.0 * g[(p, v)] - contrast * g[(p, p)]);
        let right = DVector::from_fn(p, |k, _| g[(k, v)] - contrast * g[(k, p)]);
        (left, right)
    }

    fn normal(&self) -> DMatrix<f64> {
        let n = self.prior();
        self.products.view((0, 0), (n, n)).into_owned()
    }

    /// Coefficients for a penalty on the second differences.
    fn solve(&self, contrast: f64, penalty: f64) -> Option<DVector<f64>> {
        let mut normal = self.normal();
        // The last coefficient, at the end, is 0 and not among these.
        let knots = normal.nrows() + 1;
        for row in 0..knots {
            let near = |k: isize| mirrored(row as isize + k, knots);
            let second = [(near(-1), 1.0), (row, -2.0), (near(1), 1.0)];
            for (i, a) in second {
                for (j, b) in second {
                    if let Some(sum) = normal.get_mut((i, j)) {
                        *sum += penalty * a * b;
                    }
                }
            }
        }
        Some(normal.cholesky()?.solve(&self.beyond(contrast).1))
    }

    /// Sum of squares that the parametric profile and a deviation leave.
    fn left(&self, contrast: f64, deviation: &DVector<f64>) -> f64 {
        let (left, right) = self.beyond(contrast);
        left - 2.0 * deviation.dot(&right) + deviation.dot(&(self.normal() * deviation))
    }
}

/// The profile of beads, up to a distance.
pub(crate) fn learn(
    flats: &[Flat],
    beads: &[Bead],
    parametric: Parametric,
    reach_px: f64,
) -> Option<Learnt> {
    let prior = Learnt::of(parametric, reach_px)?;
    let knots = knots(reach_px);
    let mut halves = [0, 1].map(|_| Sums {
        products: DMatrix::zeros(knots + 1, knots + 1),
        pixels: 0.0,
    });
    let frames = beads.chunk_by(|a, b| a.at.frame == b.at.frame);
    let numbered = frames.flat_map(|frame| frame.iter().map(move |bead| (bead, frame)));
    let numbered = numbered.filter(|(bead, _)| bead.counts);
    for (k, (bead, frame)) in numbered.enumerate() {
        add(&mut halves[k % 2], flats, (bead, frame), &prior, knots);
    }
    let [a, b] = &halves;
    let penalty = |n: i32| a.normal().trace().max(b.normal().trace()) * 2.0_f64.powi(n - 20);
    let left_of = |n: i32| {
        let half = |own: &Sums, other: &Sums| {
            let found = own.solve(own.contrast(), penalty(n))?;
            Some(other.left(own.contrast(), &found))
        };
        Some((half(a, b)? + half(b, a)?, penalty(n)))
    };
    let tried = (0..PENALTIES).filter_map(left_of);
    let best = tried.min_by(|a, b| a.0.total_cmp(&b.0))?;
    let by_prior = b.beyond(a.contrast()).0 + a.beyond(b.contrast()).0;
    let both = Sums {
        products: &a.products + &b.products,
        pixels: a.pixels + b.pixels,
    };
    let gain = (by_prior - best.0) / (best.0 / both.pixels.max(1.0));
    let deviation = (beads.len() >= 2 && gain > LEAST_GAIN)
        .then(|| both.solve(both.contrast(), best.1))
        .flatten();
    let value = |bin: usize, x: &DVector<f64>| {
        let parts = basis(bin, knots);
        parts
            .iter()
            .map(|(k, b)| b * x.get(*k).unwrap_or(&0.0))
            .sum::<f64>()
    };
    let at = core::array::from_fn(|bin| {
        both.contrast() * prior.at[bin] + deviation.as_ref().map_or(0.0, |x| value(bin, x))
    });
    Some(Learnt {
        at,
        deviates: deviation.is_some(),
        ..prior
    })
}

/// Adds the pixels that are a bead's own.
fn add(
    sums: &mut Sums,
    flats: &[Flat],
    (bead, frame): (&Bead, &[Bead]),
    prior: &Learnt,
    knots: usize,
) {
    let reach_px = prior.bin_px * BINS as f64;
    let Some(pixels) = bead.pixels(flats, reach_px) else {
        return;
    };
    let near_px2 = (3.0 * reach_px).powi(2);
    let off_px2 = |b: &Bead| squared(b.at.x_px - bead.at.x_px, b.at.y_px - bead.at.y_px);
    let near = |b: &&Bead| off_px2(b) < near_px2;
    let near: Vec<&Bead> = frame.iter().filter(near).collect();
    let (prior_at, grey_at) = (knots - 1, knots);
    let mut parts = vec![0.0; knots + 1];
    let mut of = Vec::with_capacity(knots + 1);
    let mut total: DVector<f64> = DVector::zeros(knots + 1);
    let mut count = 0.0;
    for pixel in pixels {
        of.clear();
        parts.fill(0.0);
        for other in &near {
            let (x_px, y_px) = other.place_for(pixel.x_px, pixel.y_px);
            let r_px = f64::hypot(pixel.x_px - x_px, pixel.y_px - y_px);
            let bin = (r_px / prior.bin_px) as usize;
            if bin >= BINS {
                continue;
            }
            parts[prior_at] += other.contrast * prior.at[bin];
            for (k, b) in basis(bin, knots) {
                // The last one is 0: its place is the parametric profile's.
                if k == prior_at || b == 0.0 {
                    continue;
                }
                if parts[k] == 0.0 {
                    of.push(k);
                }
                parts[k] += other.contrast * b;
            }
        }
        parts[grey_at] = pixel.grey;
        of.extend([prior_at, grey_at]);
        for i in &of {
            total[*i] += parts[*i];
            for j in &of {
                sums.products[(*i, *j)] += parts[*i] * parts[*j];
            }
        }
        count += 1.0;
    }
    sums.pixels += count;
    if count > 0.0 {
        sums.products -= &total * total.transpose() / count;
    }
}
