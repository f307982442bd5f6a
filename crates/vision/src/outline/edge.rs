//! Where in the mean profile the edge is.
//!
//! Where a blurred step with the lobes of a phase edge and a rim describes the profile nearly wholly, the edge is that step's
//! middle. Real rims and halos are richer, and there the rim tells: the edge is at half of the rim's contrast or, the more the
//! halo is like the rim (both lobes of one phase edge), of the body's. Without a halo of the other sign the profile may still
//! have two lobes, the outer one of the body's own sign (a body that absorbs, on the other side of the focus): then the step
//! with lobes is looked for farther away.

use super::normals::{Profile, dot};
use super::{FINE_PX, MAX_FINE, RIM_PX};

/// If an object is hardly larger than the width of its edge, it loses contrast to the blur, and half of the rest is outside of it.
/// From this ratio of the edge's width to the radius on; share of the rim's contrast per ratio; at most.
const BLURRED: (f64, f64, f64) = (0.15, 1.8, 0.25);
/// The edge's width is taken between these shares of the swing from halo to rim, times this number.
const WIDTH: (f64, f64, f64) = (0.15, 0.85, 1.4);
/// A halo weaker than this share of the rim does not count.
const NO_HALO: f64 = 0.06;
/// Share of the profile (RMS) that a fitted phase edge may leave.
const MOST_LEFT: f64 = 0.12;
/// Lobes, as a share of the step, from which on the fitted edge counts, and from which on it alone counts.
const LOBES: (f64, f64) = (0.1, 0.18);
/// Largest residual of a step with lobes, as a share of that without lobes.
const LESS_LEFT: f64 = 0.3;
/// Farthest that the middle of a phase edge is looked for, px.
const REACH_PX: f64 = 4.5;
/// How much more than that the best step that is tried may leave (squares), and the share of the least lobes that it has.
const ROUGHLY: (f64, f64) = (4.0, 0.5);
/// Widths of the blur that are tried, px.
const BLURS_PX: [f64; 5] = [0.7, 1.0, 1.4, 2.0, 2.8];
/// About the best of those tried; from a guessed start; about the best of that.
const NEAR: Search = Search {
    step_px: 0.5 * FINE_PX,
    factor: 1.19,
    stride: 1,
    rounds: 3,
};
const COARSE: Search = Search {
    step_px: FINE_PX,
    factor: 1.2,
    stride: 2,
    rounds: 3,
};
const FINE: Search = Search {
    step_px: 0.25 * FINE_PX,
    factor: 1.1,
    stride: 1,
    rounds: 1,
};
/// What a blurred step with lobes and rim may leave of the profile (RMS share): up to here its middle alone counts, from
/// there on it does not.
const MODEL_LEFT: (f64, f64) = (0.02, 0.04);
/// How far this middle may lie from where the level is, in widths of the blur: up to here it counts, from there on not.
const MODEL_AWAY: (f64, f64) = (0.25, 0.4);
/// How many widths of the blur an edge seems wide, with strong lobes and without any.
const WIDTHS: [(f64, With); 2] = [(1.9, With::LobesAndRim), (2.9, With::Rim)];
/// Squares that a plain step leaves, over those that one with lobes leaves: up to here there are no lobes, from there on
/// there are.
const PLAIN: (f64, f64) = (4.0, 12.0);
/// How far the lowest point of a parabola may lie, in steps, and by how much the next round is closer.
const FARTHEST: f64 = 1.5;
const CLOSER: f64 = 0.3;

/// The edge of a mean profile.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Edge {
    /// Distance outside the profile's middle, px.
    pub at_px: f64,
    /// Contrast of the rim, signed.
    pub rim_grey: f64,
    /// Contrast of the halo, signed; 0 without one.
    pub halo_grey: f64,
}

/// Blurred step, phase lobes and rim over the distance from the edge in widths of the blur.
#[derive(Debug, Clone)]
pub(super) struct Shapes {
    values: Vec<[f64; 3]>,
    /// For each blur that is tried, at the places that are.
    tried: Vec<Tried>,
}

/// Places along a normal relative to an edge that is tried, in steps.
const TRIED: usize = 2 * (MAX_FINE + (REACH_PX / FINE_PX) as usize) + 1;

/// The shapes of one blur about an edge in the middle, and sums of their products up to each place: step with itself, with lobes,
/// with rim, lobes with themselves, rim with itself.
#[derive(Debug, Clone)]
struct Tried {
    blur_px: f64,
    shapes: [[f32; TRIED]; 3],
    products: [[f64; 5]; TRIED + 1],
}

impl Shapes {
    const PER_WIDTH: f64 = 32.0;
    const REACH: f64 = 6.0;
    /// Distance of a rim from the edge.
    const RIM: f64 = 3.0;

    pub(super) fn new() -> Self {
        let value = |k: usize| {
            let u = k as f64 / Self::PER_WIDTH - Self::REACH;
            // The logistic function with the slope of a Gaussian's integral; the Gaussian's slope, extremes of 1 and -1.
            let step = 1.0 / (1.0 + (1.702 * u).exp());
            let rim = (-0.5 * (u + Self::RIM).powi(2)).exp();
            [step, -u * (0.5 - 0.5 * u * u).exp(), rim]
        };
        let count = (2.0 * Self::REACH * Self::PER_WIDTH) as usize + 1;
        let mut shapes = Shapes {
            values: (0..count).map(value).collect(),
            tried: Vec::new(),
        };
        shapes.tried = BLURS_PX.map(|blur_px| shapes.tried(blur_px)).to_vec();
        shapes
    }

    fn tried(&self, blur_px: f64) -> Tried {
        let mut shapes = [[0.0; TRIED]; 3];
        let mut products = [[0.0; 5]; TRIED + 1];
        for k in 0..TRIED {
            let place_px = (k as f64 - (TRIED / 2) as f64) * FINE_PX;
            let [step, lobes, rim] = self.at(place_px / blur_px);
            for (row, value) in shapes.iter_mut().zip([step, lobes, rim]) {
                row[k] = value as f32;
            }
            let pairs = [
                step * step,
                step * lobes,
                step * rim,
                lobes * lobes,
                rim * rim,
            ];
            let before = products[k];
            products[k + 1] = std::array::from_fn(|n| before[n] + pairs[n]);
        }
        Tried {
            blur_px,
            shapes,
            products,
        }
    }

    #[inline(always)]
    fn at(&self, widths: f64) -> [f64; 3] {
        let last = self.values.len() - 1;
        let k = (widths + Self::REACH) * Self::PER_WIDTH + 0.5;
        let k = (k.max(0.0) as usize).min(last);
        self.values.get(k).copied().unwrap_or([0.0; 3])
    }
}

impl Profile {
    /// The edge of an object of the radius `radius_px`; `trust`, 0 to 1, says how far a model of the profile may tell it.
    /// `None` where inside and outside are alike.
    pub(super) fn edge(&self, radius_px: f64, shapes: &Shapes, trust: f64) -> Option<Edge> {
        let body = -self.polarity;
        let (rim_at, halo_at) = (self.rim(), self.halo());
        let value = |k: usize| body * self.values[k];
        let most = (0..=self.half).map(value).fold(0.0, f64::max);
        let least = (self.half..=2 * self.half).map(value).fold(0.0, f64::min);
        let swing = most - least;
        if swing <= 0.0 {
            return None;
        }
        // The rim begins where the soft edge ends.
        let begin = (rim_at..=halo_at)
            .rev()
            .find(|k| value(*k) >= 0.9 * most)
            .unwrap_or(rim_at);
        let end = begin.saturating_sub((RIM_PX / FINE_PX) as usize);
        // Between the mean and that weighted with the values themselves: a rim thinner than this depth counts in part.
        let (first, second) = (end..=begin)
            .map(|k| value(k).max(0.0))
            .fold((0.0, 0.0), |(first, second), v| (first + v, second + v * v));
        // Out of focus the body's own contrast may hide the rim: then the halo is all that shows of the edge.
        let rim = if first > 0.0 {
            0.5 * (second / first + first / (begin - end + 1) as f64)
        } else {
            0.0
        };
        let halo = -least;
        let ratio = halo / rim.max(1e-9);
        let found = |at_px| Edge {
            at_px,
            rim_grey: body * rim.max(0.5 * swing),
            halo_grey: -body * halo,
        };
        let fitted = (ratio < NO_HALO).then(|| self.phase_edge(shapes)).flatten();
        let crossing = |level: f64| {
            let passes = |k: &usize| value(*k) >= level && value(k + 1) < level;
            let k = (rim_at..halo_at)
                .filter(passes)
                .min_by_key(|k| k.abs_diff(self.half))?;
            Some(k as f64 + (value(k) - level) / (value(k) - value(k + 1)))
        };
        let (low, high, times) = WIDTH;
        let share = |s: f64| least + s * swing;
        let width_px = match (crossing(share(high)), crossing(share(low))) {
            (Some(inner), Some(outer)) => times * (outer - inner) * FINE_PX,
            _ => (halo_at - rim_at) as f64 * FINE_PX,
        };
        let blurred = (BLURRED.1 * (width_px / radius_px - BLURRED.0)).clamp(0.0, BLURRED.2);
        // A halo as strong as the rim is the other lobe of one phase edge, in whose middle half of the body's own contrast is.
        let depth = (self.half / 4).max(1);
        let body_grey = (0..depth).map(value).sum::<f64>() / depth as f64;
        let phase = ratio.min(1.0);
        let level =
            0.5 * (rim + phase * (body_grey - rim)) + rim * blurred * (2.0 * ratio).min(1.0);
        let at = crossing(level).unwrap_or(self.half as f64);
        let at_px = (at - self.half as f64) * FINE_PX;
        let (fitted_px, weight) = fitted.unwrap_or((at_px, 0.0));
        let at_px = at_px + weight * (fitted_px - at_px);
        if trust <= 0.0 {
            return Some(found(at_px));
        }
        let (model_px, weight) = self.model(shapes, (at_px, width_px));
        Some(found(at_px + trust * weight * (model_px - at_px)))
    }

    /// Middle of the blurred step with lobes and rim near a place and of about a width (px), px outside the profile's middle, and
    /// its credibility, 0 to 1. If it leaves next to nothing of the profile, no level is more exact.
    fn model(&self, shapes: &Shapes, (near_px, width_px): (f64, f64)) -> (f64, f64) {
        let values = self.values.iter().take(2 * self.half + 1);
        let power: f64 = values.map(|v| v * v).sum();
        let tried = WIDTHS.map(|(widths, with)| {
            let start = PhaseEdge {
                at_px: near_px,
                blur_px: width_px / widths,
                ..PhaseEdge::NONE
            };
            let coarse = self.refined(shapes, start, with, COARSE);
            if coarse.left > ROUGHLY.0 * MODEL_LEFT.1 * MODEL_LEFT.1 * power {
                return coarse;
            }
            self.refined(shapes, coarse, with, FINE)
        });
        let [lobes, plain] = tried;
        let within =
            |(from, to): (f64, f64), value: f64| ((to - value) / (to - from)).clamp(0.0, 1.0);
        let own = within(PLAIN, plain.left / lobes.left.max(1e-9));
        let mixed = |lobes: f64, plain: f64| lobes + own * (plain - lobes);
        let (best_px, blur_px) = (
            mixed(lobes.at_px, plain.at_px),
            mixed(lobes.blur_px, plain.blur_px),
        );
        let left = mixed(lobes.left, plain.left).max(0.0) / power.max(1e-9);
        let away = (best_px - near_px).abs() / blur_px;
        let weight = within(MODEL_LEFT, left.sqrt()) * within(MODEL_AWAY, away);
        (best_px, weight)
    }

    /// Middle of the blurred step that fits the profile with an outer lobe of the step's own sign, px outside the profile's
    /// middle, and its credibility, 0 to 1; `None` if no step does.
    fn phase_edge(&self, shapes: &Shapes) -> Option<(f64, f64)> {
        let values = self.values.iter().take(2 * self.half + 1);
        let power: f64 = values.map(|v| v * v).sum();
        let rough = self.tried(shapes, With::Lobes);
        let lobes = -rough.lobes / rough.step;
        if rough.left > ROUGHLY.0 * MOST_LEFT * MOST_LEFT * power
            || lobes < ROUGHLY.1 * LOBES.0
            || lobes.is_nan()
        {
            return None;
        }
        let best = self.refined(shapes, rough, With::Lobes, NEAR);
        if best.left > MOST_LEFT * MOST_LEFT * power {
            return None;
        }
        let weight = ((-best.lobes / best.step - LOBES.0) / (LOBES.1 - LOBES.0)).clamp(0.0, 1.0);
        if weight <= 0.0 || weight.is_nan() {
            return None;
        }
        // A rim inside would be taken for a part of the inner lobe.
        let best = self.refined(shapes, best, With::LobesAndRim, NEAR);
        let rough = self.tried(shapes, With::Rim);
        let plain = self.refined(shapes, rough, With::Rim, NEAR);
        (best.left < LESS_LEFT * plain.left).then_some((best.at_px, weight))
    }

    /// The best fit of a blurred step among those tried.
    fn tried(&self, shapes: &Shapes, with: With) -> PhaseEdge {
        let reach_px = REACH_PX.min(0.5 * self.half as f64 * FINE_PX + 1.0);
        let places = (reach_px / FINE_PX) as usize;
        let count = 2 * self.half + 1;
        let mut values = [0.0_f32; 2 * MAX_FINE + 1];
        for (to, from) in values.iter_mut().zip(&self.values).take(count) {
            *to = *from as f32;
        }
        let values = values.get(..count).unwrap_or(&[]);
        let power = f64::from(dot(values, values));
        let mut best = PhaseEdge::NONE;
        for tried in &shapes.tried {
            for place in 0..=2 * places {
                // The farther out the edge, the farther in the profile lies.
                let from = TRIED / 2 + places - self.half - place;
                let Some(mut sums) = tried.sums(values, from) else {
                    continue;
                };
                sums.power = power;
                let at_px = (place as f64 - places as f64) * FINE_PX;
                best = best.or(sums.fitted((at_px, tried.blur_px), 1, with));
            }
        }
        best
    }

    /// The best about a start, by parabolas over place and logarithm of the blur, closer by once one lies between.
    fn refined(&self, shapes: &Shapes, start: PhaseEdge, with: With, search: Search) -> PhaseEdge {
        let (mut step_px, mut wider) = (search.step_px, search.factor.ln());
        let stride = search.stride;
        let at = |from: &PhaseEdge, (i, j): (f64, f64), (step_px, wider): (f64, f64)| {
            let place = (from.at_px + i * step_px, from.blur_px * (j * wider).exp());
            self.phase_edge_at(shapes, place, stride, with)
        };
        let mut best = self.phase_edge_at(shapes, (start.at_px, start.blur_px), stride, with);
        for _ in 0..search.rounds {
            let (from, steps) = (best, (step_px, wider));
            let [left, right, narrow, wide, corner] =
                [(-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0), (1.0, 1.0)]
                    .map(|way| at(&from, way, steps));
            let (gx, gy) = (
                0.5 * (right.left - left.left),
                0.5 * (wide.left - narrow.left),
            );
            let xx = right.left + left.left - 2.0 * from.left;
            let yy = wide.left + narrow.left - 2.0 * from.left;
            let xy = corner.left - right.left - wide.left + from.left;
            for next in [left, right, narrow, wide, corner] {
                best = best.or(next);
            }
            let determinant = xx * yy - xy * xy;
            let mut inside = false;
            if xx > 0.0 && determinant > 0.0 {
                let (i, j) = (
                    (gy * xy - gx * yy) / determinant,
                    (gx * xy - gy * xx) / determinant,
                );
                inside = i.abs() <= 1.0 && j.abs() <= 1.0;
                let most = |v: f64| v.clamp(-FARTHEST, FARTHEST);
                best = best.or(at(&from, (most(i), most(j)), steps));
            }
            if inside {
                (step_px, wider) = (CLOSER * step_px, CLOSER * wider);
            }
        }
        best
    }

    /// A step at a place with lobes or a rim or both, fitted to every `stride`th value.
    fn phase_edge_at(
        &self,
        shapes: &Shapes,
        (at_px, blur_px): (f64, f64),
        stride: usize,
        with: With,
    ) -> PhaseEdge {
        let scale = 1.0 / blur_px;
        let first = (-(self.half as f64) * FINE_PX - at_px) * scale;
        let values = self.values.iter().take(2 * self.half + 1);
        let mut sums = Sums::default();
        for (k, v) in values.enumerate().step_by(stride) {
            let [step, lobes, rim] = shapes.at(first + k as f64 * FINE_PX * scale);
            let [aa, ab, ac, bb, bc, cc] = &mut sums.normal;
            *aa += step * step;
            *ab += step * lobes;
            *ac += step * rim;
            *bb += lobes * lobes;
            *bc += lobes * rim;
            *cc += rim * rim;
            sums.right[0] += step * v;
            sums.right[1] += lobes * v;
            sums.right[2] += rim * v;
            sums.power += v * v;
        }
        sums.fitted((at_px, blur_px), stride, with)
    }
}

impl Tried {
    /// Sums for a profile that begins at the place `from`.
    fn sums(&self, values: &[f32], from: usize) -> Option<Sums> {
        let to = from + values.len();
        let [step, lobes, rim] = &self.shapes;
        let (low, high) = (self.products.get(from)?, self.products.get(to)?);
        let [aa, ab, ac, bb, cc] = std::array::from_fn(|n| high[n] - low[n]);
        let product = |shape: &[f32]| shape.get(from..to).map(|s| f64::from(dot(values, s)));
        Some(Sums {
            // Lobes and rim are not tried together.
            normal: [aa, ab, ac, bb, 0.0, cc],
            right: [product(step)?, product(lobes)?, product(rim)?],
            power: 0.0,
        })
    }
}

/// Sums of the least squares of step, lobes and rim.
#[derive(Debug, Clone, Copy, Default)]
struct Sums {
    /// The upper triangle, row by row.
    normal: [f64; 6],
    right: [f64; 3],
    /// Of the profile's squares.
    power: f64,
}

impl Sums {
    /// The step at a place and of a blur that fits best.
    fn fitted(&self, (at_px, blur_px): (f64, f64), stride: usize, with: With) -> PhaseEdge {
        let [aa, ab, ac, bb, bc, cc] = self.normal;
        let [a, b, c] = self.right;
        let two = |other: f64, mixed: f64, right: f64| {
            let determinant = aa * other - mixed * mixed;
            let solved = (
                (a * other - right * mixed) / determinant,
                (right * aa - a * mixed) / determinant,
            );
            (determinant > 1e-12 * aa * other).then_some(solved)
        };
        let fitted = match with {
            With::Lobes => two(bb, ab, b).map(|(step, lobes)| [step, lobes, 0.0]),
            With::Rim => two(cc, ac, c).map(|(step, rim)| {
                // A rim is stronger than the body, not weaker.
                if rim * step < 0.0 {
                    [a / aa, 0.0, 0.0]
                } else {
                    [step, 0.0, rim]
                }
            }),
            With::LobesAndRim => {
                // What the step leaves of the others.
                let (l, r) = (ab / aa, ac / aa);
                let (bb, bc, cc) = (bb - l * ab, bc - l * ac, cc - r * ac);
                let (b, c) = (b - l * a, c - r * a);
                let determinant = bb * cc - bc * bc;
                (aa > 0.0 && bb > 0.0 && determinant > 1e-12 * bb * cc).then(|| {
                    let lobes = (b * cc - c * bc) / determinant;
                    let rim = (c * bb - b * bc) / determinant;
                    [a / aa - l * lobes - r * rim, lobes, rim]
                })
            }
        };
        let Some([step, lobes, rim]) = fitted else {
            return PhaseEdge::NONE;
        };
        PhaseEdge {
            left: stride as f64 * (self.power - step * a - lobes * b - rim * c),
            at_px,
            blur_px,
            step,
            lobes,
        }
    }
}

/// How the best step about a start is looked for.
#[derive(Debug, Clone, Copy)]
struct Search {
    /// First steps to either side: of the place, and factor of the blur.
    step_px: f64,
    factor: f64,
    /// Every which value of the profile counts.
    stride: usize,
    rounds: usize,
}

/// The columns that are fitted together with the step.
#[derive(Debug, Clone, Copy)]
enum With {
    Lobes,
    Rim,
    LobesAndRim,
}

/// A blurred step with phase lobes.
#[derive(Debug, Clone, Copy)]
struct PhaseEdge {
    /// What it leaves of the profile, grey^2.
    left: f64,
    at_px: f64,
    blur_px: f64,
    /// Contrast of the body and of the lobes, grey levels.
    step: f64,
    lobes: f64,
}

impl PhaseEdge {
    const NONE: PhaseEdge = PhaseEdge {
        left: f64::INFINITY,
        at_px: 0.0,
        blur_px: 1.0,
        step: 0.0,
        lobes: 0.0,
    };

    fn or(self, other: PhaseEdge) -> PhaseEdge {
        if other.left < self.left { other } else { self }
    }
}
