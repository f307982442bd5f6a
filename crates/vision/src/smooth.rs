//! A radial profile learnt from beads: a parametric profile plus a smooth deviation that beads not seen must confirm.
//!
//! The pixels of the aligned beads are collected by their distance from the centre, in two halves of the beads. What is
//! learnt is the mean reading of a pixel at a distance, so the integration over the pixel's area is part of the profile.
//! The deviation is a cubic spline with a penalty on its roughness (P-spline, Eilers and Marx 1996). How smooth it is
//! decides cross-validation between the halves: a bead whose noise is correlated from pixel to pixel cannot vouch for
//! itself. Faint or few beads leave the parametric profile alone.

use crate::profile::{GaussianProfile, RadialProfile, RingProfile};

/// Bins of the distance: a hundredth of a small bead's radius, so that the profile is level within one.
pub(crate) const BINS: usize = 512;
/// Most knots of the deviation.
const MOST_KNOTS: usize = 32;
/// Least distance of the knots, px: a picture without aliasing shows no period under two pixels, and a cubic spline follows
/// a period with three knots.
const LEAST_KNOT_PX: f64 = 0.7;
/// Penalties tried: a factor of two from one to the next. The largest leaves a constant.
pub(crate) const PENALTIES: i32 = 40;
/// Least gain in predicting the other half, in variances of the noise. With a true parametric profile the best of all penalties
/// gains so much less often than once in 100 draws (`chance_confirms_no_deviation`).
pub(crate) const LEAST_GAIN: f64 = 10.0;

/// Grey values by their distance from the centre, with weights, in the two halves of the beads.
#[derive(Debug, Clone)]
pub(crate) struct Rings {
    reach_px: f64,
    halves: [Half; 2],
    beads: usize,
}

#[derive(Debug, Clone)]
struct Half {
    weight: [f64; BINS],
    sum: [f64; BINS],
    square: f64,
    pixels: f64,
}

impl Half {
    const EMPTY: Half = Half {
        weight: [0.0; BINS],
        sum: [0.0; BINS],
        square: 0.0,
        pixels: 0.0,
    };

    /// Weighted sum of squares that a function leaves.
    fn left(&self, at: &[f64; BINS]) -> f64 {
        let bins = self.weight.iter().zip(&self.sum).zip(at);
        self.square + bins.map(|((w, s), g)| g * (g * w - 2.0 * s)).sum::<f64>()
    }
}

/// A profile as a function of the distance: a table at the bins.
#[derive(Debug, Clone)]
pub(crate) struct Learnt {
    /// Values at the middles of the bins, in the units of what was collected.
    pub at: [f64; BINS],
    pub bin_px: f64,
    /// Whether the beads have confirmed a deviation from the parametric profile.
    pub deviates: bool,
}

impl Learnt {
    /// A parametric profile alone.
    pub(crate) fn of(parametric: Parametric, reach_px: f64) -> Option<Self> {
        let bin_px = reach_px / BINS as f64;
        Some(Learnt {
            at: parametric.at(bin_px)?,
            bin_px,
            deviates: false,
        })
    }

    /// Value at a distance; beyond the last bin its value.
    pub(crate) fn value(&self, r_px: f64) -> f64 {
        let u = (r_px / self.bin_px - 0.5).clamp(0.0, (BINS - 1) as f64);
        let k = (u as usize).min(BINS - 2);
        let t = u - k as f64;
        self.at[k] + t * (self.at[k + 1] - self.at[k])
    }
}

/// A parametric profile fitted to what was collected.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Parametric {
    /// Standard deviation, px.
    Gaussian(f64),
    /// Edge radius, px.
    Ring(f64),
}

impl Parametric {
    fn at(self, bin_px: f64) -> Option<[f64; BINS]> {
        let table =
            |p: &dyn RadialProfile| core::array::from_fn(|k| p.value((k as f64 + 0.5) * bin_px));
        match self {
            Parametric::Gaussian(sigma_px) => GaussianProfile::new(sigma_px).map(|p| table(&p)),
            Parametric::Ring(edge_px) => RingProfile::new(edge_px).map(|p| table(&p)),
        }
    }
}

impl Rings {
    pub(crate) fn new(reach_px: f64) -> Self {
        Rings {
            reach_px,
            halves: [Half::EMPTY; 2],
            beads: 0,
        }
    }

    /// Forgets everything. Allocates nothing.
    pub(crate) fn clear(&mut self) {
        self.halves = [Half::EMPTY; 2];
        self.beads = 0;
    }

    /// The next bead: every other one belongs to the second half.
    pub(crate) fn next_bead(&mut self) {
        self.beads += 1;
    }

    /// A pixel of the bead at hand.
    #[inline]
    pub(crate) fn add(&mut self, r_px: f64, value: f64, weight: f64) {
        let bin = (r_px / self.reach_px * BINS as f64) as usize;
        let half = &mut self.halves[self.beads % 2];
        if let (Some(w), Some(s)) = (half.weight.get_mut(bin), half.sum.get_mut(bin)) {
            *w += weight;
            *s += weight * value;
            half.square += weight * value * value;
            half.pixels += 1.0;
        }
    }

    fn bin_px(&self) -> f64 {
        self.reach_px / BINS as f64
    }

    /// The Gaussian or ring that fits best.
    pub(crate) fn parametric(&self) -> Option<Parametric> {
        let left = |p: Parametric| {
            let at = p.at(self.bin_px())?;
            let fitted = self.scaled(&at, &[0, 1]);
            Some(self.halves.iter().map(|h| h.left(&fitted)).sum::<f64>())
        };
        let best = |kind: fn(f64) -> Parametric| {
            // Sizes from half a pixel on, in steps of 8 %, then finer about the best.
            let (mut size, mut step) = (0.5, 1.08);
            let mut found: Option<(f64, f64)> = None;
            while size < self.reach_px {
                if let Some(l) = left(kind(size))
                    && found.is_none_or(|(_, least)| l < least)
                {
                    found = Some((size, l));
                }
                size *= step;
            }
            while step > 1.0005 {
                step = step.sqrt();
                let (middle, _) = found?;
                for size in [middle / step, middle * step] {
                    if let Some(l) = left(kind(size))
                        && found.is_none_or(|(_, least)| l < least)
                    {
                        found = Some((size, l));
                    }
                }
            }
            found.map(|(size, l)| (kind(size), l))
        };
        let candidates = [best(Parametric::Gaussian), best(Parametric::Ring)];
        let least = |a: &&(Parametric, f64), b: &&(Parametric, f64)| a.1.total_cmp(&b.1);
        let found = candidates.iter().flatten().min_by(least)?;
        found.1.is_finite().then_some(found.0)
    }

    /// The profile: a given function of the distance with free contrast and level, plus the deviation that the halves confirm in
    /// each other.
    pub(crate) fn learn_beyond(&self, prior: impl Fn(f64) -> f64) -> Learnt {
        let bin_px = self.bin_px();
        self.learn(&core::array::from_fn(|k| prior((k as f64 + 0.5) * bin_px)))
    }

    fn learn(&self, prior: &[f64; BINS]) -> Learnt {
        let knots = knots(self.reach_px);
        let priors = [self.scaled(prior, &[0]), self.scaled(prior, &[1])];
        let system = |half: usize, of: usize| System::new(self, &priors[of], &[half], knots);
        // Each half by its own prior, and by the other's.
        let own = [system(0, 0), system(1, 1)];
        let other = [system(1, 0), system(0, 1)];
        let left_by_prior = other[0].left + other[1].left;
        let mut best = (f64::INFINITY, 0.0);
        for n in 0..PENALTIES {
            // Relative to the weight of a knot: from a tiny part of it to a multiple.
            let penalty = own[0].scale.max(own[1].scale) * 2.0_f64.powi(n - 20);
            let left = own.iter().zip(&other).map(|(own, other)| {
                let deviation = own.solve(penalty)?;
                Some(other.left_beyond(&deviation))
            });
            if let Some(left) = left.sum::<Option<f64>>()
                && left < best.0
            {
                best = (left, penalty);
            }
        }
        let pixels: f64 = self.halves.iter().map(|h| h.pixels).sum();
        let variance = best.0 / pixels.max(1.0);
        let prior = self.scaled(prior, &[0, 1]);
        // Without beads in both halves nothing is confirmed.
        let confirmed = self.beads >= 2 && left_by_prior - best.0 > LEAST_GAIN * variance;
        let deviation = confirmed.then(|| {
            let system = System::new(self, &prior, &[0, 1], knots);
            // Twice as many pixels against the same prior belief about the roughness.
            let found = system.solve(best.1);
            found.map(|deviation| system.sum(&deviation))
        });
        let deviation = deviation.flatten();
        Learnt {
            deviates: deviation.is_some(),
            at: deviation.unwrap_or(prior),
            bin_px: self.bin_px(),
        }
    }

    /// A function with the contrast and level that fit the halves asked for best.
    fn scaled(&self, at: &[f64; BINS], halves: &[usize]) -> [f64; BINS] {
        let (mut n, mut g1, mut g2, mut s1, mut sg) = (0.0, 0.0, 0.0, 0.0, 0.0);
        for half in halves.iter().filter_map(|k| self.halves.get(*k)) {
            for ((w, s), g) in half.weight.iter().zip(&half.sum).zip(at) {
                n += w;
                g1 += w * g;
                g2 += w * g * g;
                s1 += s;
                sg += s * g;
            }
        }
        let determinant = n * g2 - g1 * g1;
        if determinant > 1e-12 * n * g2 {
            let contrast = (n * sg - g1 * s1) / determinant;
            let level = (s1 - contrast * g1) / n;
            core::array::from_fn(|k| contrast * at[k] + level)
        } else {
            *at
        }
    }
}

/// The normal equations of the deviation over equally spaced knots: bands of the symmetric matrix and the right side.
struct System {
    knots: usize,
    band: [[f64; 4]; MOST_KNOTS],
    right: [f64; MOST_KNOTS],
    prior: [f64; BINS],
    /// Mean weight of a knot.
    scale: f64,
    /// Weighted sum of squares that the prior leaves.
    left: f64,
}

impl System {
    fn new(rings: &Rings, prior: &[f64; BINS], halves: &[usize], knots: usize) -> Self {
        let mut system = System {
            knots,
            band: [[0.0; 4]; MOST_KNOTS],
            right: [0.0; MOST_KNOTS],
            prior: *prior,
            scale: 0.0,
            left: 0.0,
        };
        let mut total = 0.0;
        for half in halves.iter().filter_map(|k| rings.halves.get(*k)) {
            system.left += half.left(prior);
            for (k, ((w, s), g)) in half.weight.iter().zip(&half.sum).zip(prior).enumerate() {
                if *w <= 0.0 {
                    continue;
                }
                total += w;
                let residual = s - w * g;
                let basis = basis(k, knots);
                for (i, a) in basis {
                    system.right[i] += a * residual;
                    for (j, b) in basis {
                        if j >= i {
                            system.band[i][j - i] += w * a * b;
                        }
                    }
                }
            }
        }
        system.scale = total / knots as f64;
        system
    }

    /// Coefficients for a penalty on the second differences; banded Cholesky.
    fn solve(&self, penalty: f64) -> Option<[f64; MOST_KNOTS]> {
        let n = self.knots;
        let mut band = self.band;
        for row in 0..n {
            let second = [
                (mirrored(row as isize - 1, n), 1.0),
                (row, -2.0),
                (mirrored(row as isize + 1, n), 1.0),
            ];
            for (i, a) in second {
                for (j, b) in second {
                    if j >= i {
                        band[i][j - i] += penalty * a * b;
                    }
                }
            }
        }
        let mut x = self.right;
        for i in 0..n {
            let pivot = band[i][0];
            // What rounding leaves of a matrix without full rank.
            if pivot.is_nan() || pivot <= 1e-12 * self.scale {
                return None;
            }
            for k in 1..4.min(n - i) {
                let factor = band[i][k] / pivot;
                for l in k..4.min(n - i) {
                    band[i + k][l - k] -= factor * band[i][l];
                }
                x[i + k] -= factor * x[i];
            }
        }
        for i in (0..n).rev() {
            for k in 1..4.min(n - i) {
                x[i] -= band[i][k] * x[i + k];
            }
            x[i] /= band[i][0];
        }
        Some(x)
    }

    /// Weighted sum of squares that prior and deviation leave.
    fn left_beyond(&self, deviation: &[f64; MOST_KNOTS]) -> f64 {
        let mut left = self.left;
        for (i, (x, (band, right))) in deviation
            .iter()
            .zip(self.band.iter().zip(&self.right))
            .enumerate()
            .take(self.knots)
        {
            left += x * (band[0] * x - 2.0 * right);
            for (b, y) in band.iter().zip(deviation.iter().skip(i)).skip(1) {
                left += 2.0 * x * b * y;
            }
        }
        left
    }

    /// Prior and deviation at the bins.
    fn sum(&self, deviation: &[f64; MOST_KNOTS]) -> [f64; BINS] {
        core::array::from_fn(|k| {
            let basis = basis(k, self.knots);
            self.prior[k] + basis.iter().map(|(i, b)| b * deviation[*i]).sum::<f64>()
        })
    }
}

/// Knots of a deviation up to a distance.
pub(crate) fn knots(reach_px: f64) -> usize {
    ((reach_px / LEAST_KNOT_PX) as usize).clamp(6, MOST_KNOTS)
}

/// Coefficient `k` of a spline that is even at both ends.
pub(crate) fn mirrored(k: isize, knots: usize) -> usize {
    let last = knots as isize - 1;
    let k = k.abs();
    (if k > last { 2 * last - k } else { k }).max(0) as usize
}

/// The four coefficients that a bin's middle depends on, and how strongly: a cubic B-spline.
pub(crate) fn basis(bin: usize, knots: usize) -> [(usize, f64); 4] {
    let u = (bin as f64 + 0.5) / BINS as f64 * (knots - 1) as f64;
    let k = (u as usize).min(knots - 2);
    let t = u - k as f64;
    let (t2, t3) = (t * t, t * t * t);
    let shares = [
        (1.0 - 3.0 * t + 3.0 * t2 - t3) / 6.0,
        (4.0 - 6.0 * t2 + 3.0 * t3) / 6.0,
        (1.0 + 3.0 * t + 3.0 * t2 - 3.0 * t3) / 6.0,
        t3 / 6.0,
    ];
    core::array::from_fn(|n| (mirrored(k as isize + n as isize - 1, knots), shares[n]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_numeric::Random;

    fn collected(
        beads: usize,
        reach_px: f64,
        noise: f64,
        random: &mut Random,
        profile: impl Fn(f64) -> f64,
    ) -> Rings {
        let mut rings = Rings::new(reach_px);
        let half = reach_px.ceil() as i32 + 1;
        for _ in 0..beads {
            rings.next_bead();
            let (cx, cy) = (random.uniform(), random.uniform());
            for k in 0..(2 * half + 1) * (2 * half + 1) {
                let (x, y) = (k % (2 * half + 1) - half, k / (2 * half + 1) - half);
                let r = f64::hypot(f64::from(x) - cx, f64::from(y) - cy);
                rings.add(r, 0.3 + profile(r) + noise * random.normal(), 1.0);
            }
        }
        rings
    }

    #[test]
    fn chance_confirms_no_deviation() {
        let mut random = Random::new(4);
        let gaussian = |r: f64| (-0.5 * r * r / 2.25).exp();
        let draws = 400;
        let confirmed = (0..draws)
            .filter(|_| {
                let rings = collected(10, 8.0, 0.15, &mut random, gaussian);
                let prior = rings.parametric().unwrap();
                rings.learn(&prior.at(rings.bin_px()).unwrap()).deviates
            })
            .count();
        assert!(confirmed <= 4, "{confirmed} of {draws}");
    }

    #[test]
    fn a_gaussian_in_noise_comes_back_as_that_gaussian() {
        let mut random = Random::new(5);
        for sigma_px in [0.8, 1.5, 4.0] {
            let gaussian = |r: f64| (-0.5 * (r / sigma_px) * (r / sigma_px)).exp();
            let rings = collected(20, 4.0 * sigma_px, 0.1, &mut random, gaussian);
            let Some(Parametric::Gaussian(found)) = rings.parametric() else {
                panic!("{:?}", rings.parametric());
            };
            assert!((found / sigma_px - 1.0).abs() < 0.02, "{sigma_px}: {found}");
        }
    }

    #[test]
    fn a_profile_of_its_own_kind_is_learnt_to_the_noise_and_stays_smooth() {
        let mut random = Random::new(6);
        let disc =
            |r: f64| 1.0 / (1.0 + ((r - 5.0) / 0.7).exp()) + 0.15 * (-(r - 8.0).powi(2)).exp();
        let rings = collected(20, 14.0, 0.1, &mut random, disc);
        let learnt = rings.learn(&rings.parametric().unwrap().at(rings.bin_px()).unwrap());
        assert!(learnt.deviates);
        let off = (0..120)
            .map(|k| 0.1 + 0.1 * f64::from(k))
            .map(|r| (learnt.value(r) - 0.3 - disc(r)).abs())
            .fold(0.0, f64::max);
        // 20 beads: the ring of a pixel at 5 px has 30 pixels each, noise 0.1 / sqrt(600) = 0.004.
        assert!(off < 0.04, "{off}");
    }
}
