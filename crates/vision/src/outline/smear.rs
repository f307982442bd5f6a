//! How the mean profile looks along a normal if the cell moves while the frame is exposed.
//!
//! At the time t, from -1/2 to 1/2 of the exposure, the cell is t v from its mean place. A point on a normal n, at the distance s
//! outside a contour of the radius of curvature R, is then |(R + s) n - t v| - R outside the contour. The smeared profile is the mean
//! of the profile at rest over these distances. Along the motion that is the mean over the way. Across the motion the edge of a round
//! cell recedes on both sides of the middle of the exposure.

use super::normals::Profile;
use super::{FINE_PX, MAX_FINE, Outliner};

/// Number of ways along a normal for a smeared cell.
pub(super) const WAYS: usize = 8;
/// A smear of a cell below this does not count, px: it widens an edge by a twelfth of its square.
const LEAST_SMEAR_PX: f64 = 1.0;
/// Rounds in which the mean profile is freed of the smear.
const SHARPENED: usize = 6;
/// Neighbours over which the contour's curvature is taken, points on either side.
const CURVED: usize = 4;
/// Most steps of a profile.
const STEPS: usize = 2 * MAX_FINE + 1;

/// The mean profile as it is smeared along normals that make more or less of an angle with the motion.
#[derive(Debug, Clone)]
pub(super) struct Smear {
    /// Way of the cell during the exposure, px.
    pub(super) way_px: (f64, f64),
    /// The mean profile along normals across the motion, smeared over none of the way up to all of it.
    pub(super) profiles: Vec<Profile>,
    /// What makes each of them of the profile at rest.
    weights: Vec<Weights>,
}

/// A smeared profile's values as sums over those at rest.
#[derive(Debug, Clone)]
struct Weights {
    rows: [[f32; STEPS]; STEPS],
    /// The first and the last step at rest that each smeared one has a share of.
    spans: [(usize, usize); STEPS],
    /// Steps by which the edge becomes wider on either side.
    wider: usize,
}

impl Weights {
    const NONE: Weights = Weights {
        rows: [[0.0; STEPS]; STEPS],
        spans: [(0, 0); STEPS],
        wider: 0,
    };

    /// For a way along the normal and across it (px), and a contour of a curvature (1/px). Beyond its ends a profile keeps the end
    /// values.
    fn set(&mut self, (along, across): (f64, f64), curvature: f64, half: usize) {
        let radius_px = 1.0 / curvature.max(1e-3);
        let distance_px = |s_px: f64, t: f64| {
            // Not `hypot`: it is a call of a library.
            let (outwards, aside) = (radius_px + s_px - t * along, t * across);
            (outwards * outwards + aside * aside).sqrt() - radius_px
        };
        let last = 2 * half;
        // One time of the exposure for each step of the way.
        let times = (f64::hypot(along, across) / FINE_PX).ceil().max(1.0);
        let share = 1.0 / times as f32;
        let rows = self.rows.iter_mut().zip(&mut self.spans).enumerate();
        for (k, (row, span)) in rows.take(last + 1) {
            *row = [0.0; STEPS];
            *span = (last, 0);
            let s_px = (k as f64 - half as f64) * FINE_PX;
            for n in 0..times as usize {
                let t = (n as f64 + 0.5) / times - 0.5;
                let at = (distance_px(s_px, t) / FINE_PX + half as f64).clamp(0.0, last as f64);
                let first = (at as usize).min(last - 1);
                let second = (at - first as f64) as f32;
                row[first] += share * (1.0 - second);
                row[first + 1] += share * second;
                *span = (span.0.min(first), span.1.max(first + 1));
            }
        }
        let farthest_px = distance_px(0.0, 0.5)
            .abs()
            .max(distance_px(0.0, -0.5).abs());
        self.wider = (farthest_px / FINE_PX).ceil() as usize;
    }

    fn smeared(&self, profile: &Profile) -> Profile {
        let mut values = profile.values;
        let rows = values.iter_mut().zip(&self.rows).zip(&self.spans);
        for ((value, row), (first, last)) in rows.take(2 * profile.half + 1) {
            let pairs = row.iter().zip(&profile.values).take(last + 1).skip(*first);
            *value = pairs.map(|(w, v)| f64::from(*w) * v).sum();
        }
        Profile::new(values, profile.half, profile.polarity, self.wider)
    }
}

impl Smear {
    pub(super) fn new() -> Self {
        Smear {
            way_px: (0.0, 0.0),
            profiles: Vec::with_capacity(WAYS + 1),
            weights: vec![Weights::NONE; WAYS + 1],
        }
    }

    fn length_px(&self) -> f64 {
        let length_px = f64::hypot(self.way_px.0, self.way_px.1);
        // The comparison also refuses a NaN.
        if length_px > LEAST_SMEAR_PX && length_px < MAX_FINE as f64 {
            length_px
        } else {
            0.0
        }
    }

    /// Standard deviation of the contour's shift by the smear of an object of a radius, px. The model takes the profile to be the
    /// same all round. Of recorded beads it is not, and the outline keeps an error of up to a 24th of the squared way over the radius,
    /// as much as the edge recedes by. One and a half times as much is stated.
    pub(super) fn left_px(&self, radius_px: f64) -> f64 {
        self.length_px().powi(2) / (16.0 * radius_px.max(1.0))
    }

    /// Which of the profiles is that along a normal.
    pub(super) fn which(&self, normal: &(f64, f64)) -> usize {
        let length_px = self.length_px();
        if length_px <= 0.0 {
            return 0;
        }
        let along = (self.way_px.0 * normal.0 + self.way_px.1 * normal.1).abs();
        ((along / length_px * WAYS as f64).round() as usize).min(WAYS)
    }

    /// Takes in the contour's mean curvature at the normals of each angle, 1/px.
    fn bend(&mut self, curvatures: &[f64; WAYS + 1], half: usize) {
        let length_px = self.length_px();
        for (k, (weights, curvature)) in self.weights.iter_mut().zip(curvatures).enumerate() {
            let cosine = k as f64 / WAYS as f64;
            let sine = (1.0 - cosine * cosine).sqrt();
            weights.set((length_px * cosine, length_px * sine), *curvature, half);
        }
    }

    /// Takes the mean profile for each angle.
    fn spread(&mut self, profile: &Profile) {
        self.profiles.clear();
        if self.length_px() <= 0.0 {
            self.profiles.push(*profile);
            return;
        }
        let smeared = self.weights.iter().map(|weights| weights.smeared(profile));
        self.profiles.extend(smeared);
    }
}

impl Outliner {
    /// The contour's mean curvature at the normals of each angle with the motion, 1/px.
    fn curvatures(&self) -> [f64; WAYS + 1] {
        let n = self.points.len();
        let (mut turned, mut length) = ([0.0; WAYS + 1], [0.0; WAYS + 1]);
        if n <= 2 * CURVED {
            return turned;
        }
        for (i, own) in self.normals.iter().enumerate().take(n) {
            let (before, after) = ((i + n - CURVED) % n, (i + CURVED) % n);
            let (a, b) = (self.points[before], self.points[after]);
            let (from, to) = (self.normals[before], self.normals[after]);
            let which = self.smear.which(own);
            turned[which] += from.0 * to.1 - from.1 * to.0;
            length[which] += f64::hypot(b.0 - a.0, b.1 - a.1);
        }
        core::array::from_fn(|k| turned[k] / length[k].max(1.0))
    }

    /// The mean profile, into `smear` as it looks along each angle with the motion. Smeared, it leaves nothing of the normals'
    /// profiles on average (Van Cittert's iteration, which few rounds keep smooth).
    pub(super) fn mean(&mut self, half: usize, polarity: f64) -> Profile {
        let count = 2 * half + 1;
        // Sums over the normals of each angle, and their numbers.
        let mut sums = [[0.0; STEPS]; WAYS + 1];
        let mut numbers = [0.0; WAYS + 1];
        let rows = self.profiles.iter().zip(&self.normals);
        for (row, normal) in rows.take(self.points.len()) {
            let which = self.smear.which(normal);
            for (sum, v) in sums[which].iter_mut().zip(row).take(count) {
                *sum += f64::from(*v);
            }
            numbers[which] += 1.0;
        }
        let over = 1.0 / f64::max(numbers.iter().sum(), 1.0);
        let mut values = [0.0; STEPS];
        for sums in &sums {
            for (value, sum) in values.iter_mut().zip(sums) {
                *value += over * sum;
            }
        }
        let mut profile = Profile::new(values, half, polarity, 0);
        if self.smear.length_px() > 0.0 {
            let curvatures = self.curvatures();
            self.smear.bend(&curvatures, half);
        }
        self.smear.spread(&profile);
        if self.smear.profiles.len() <= 1 {
            return profile;
        }
        for _ in 0..SHARPENED {
            for ((sums, number), smeared) in sums.iter().zip(numbers).zip(&self.smear.profiles) {
                for ((value, sum), own) in values.iter_mut().zip(sums).zip(&smeared.values) {
                    *value += over * (sum - number * own);
                }
            }
            profile = Profile::new(values, half, polarity, 0);
            self.smear.spread(&profile);
        }
        profile
    }
}
