//! The outline of a cell in a picture of signed contrast: a closed contour on the crossing from the rim to the halo.
//!
//! Modelled, not thresholded. A contour of rays about a start ellipse is laid along the strongest consistent step from
//! inside to outside, in either direction, by dynamic programming. Then the profile along the contour's own normals is
//! averaged: that is what rim and halo of this cell look like in this focus. Each normal's profile is fitted by it (shift,
//! amplitude, offset), so that the outline uses the whole width of the rim, and the shift comes with its variance. The
//! outline is the middle of the step that fits the mean profile, or where that passes half of the rim's contrast. Allocates only when made.

mod contour;
mod edge;
mod measure;
mod normals;
mod smear;

/// Most rays.
pub(crate) const MAX_RAYS: usize = 128;
/// Fewest rays.
const MIN_RAYS: usize = 48;
/// Most steps along a ray.
const MAX_STEPS: usize = 48;
/// Rays by which the dynamic programming continues past the start, so that the contour closes: a quarter on either side.
const OVERLAP: usize = 24;
/// Distance of the steps along a normal, px.
const FINE_PX: f64 = 0.5;
/// Most steps along a normal, on one side.
const MAX_FINE: usize = 16;
/// Most passes of the fit along the normals before the last one about the edge, and the shift (RMS, px) after which there is no
/// other.
const PASSES: usize = 3;
const SETTLED_PX: f64 = 0.15;
/// One pixel in fixed point.
const ONE: f64 = (1_u64 << 32) as f64;
/// Cost of a step of the contour from ray to ray, as a share of a typical edge.
const BEND: f32 = 0.08;
/// Cost of what has the body's sign but lies outside, per px and share of its contrast.
const OUTSIDE: f32 = 0.12;
/// Depth over which the rim's contrast is taken, px.
const RIM_PX: f64 = 4.0;
/// Ratio of the half axes up to which a profile is the same all round, so that a model of it gives the edge, and the ratio from
/// which on it is not: the tips of a cell that is pressed thin are all edge.
const ROUND: (f64, f64) = (1.6, 2.6);
/// How far the profiles reach on either side, as a share of the contour's short half axis.
const REACH: f64 = 0.6;
/// Contour points that lie this near to the border are cut by it, px.
const BORDER_PX: f64 = 1.5;

/// Contrast of a frame: grey levels above the background.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Contrast<'a> {
    pub pixels: &'a [f32],
    pub width: usize,
    pub height: usize,
    /// First column and row that belong to the object, and the last: nothing counts beyond.
    pub within: [f32; 4],
    /// Largest contrast that counts, grey levels: a granule or a dead pixel is no edge.
    pub most: f32,
}

impl Contrast<'_> {
    /// Values at steps of `step` px from `start` on: between the pixels linearly, nothing outside.
    fn along(&self, start: (f64, f64), step: (f64, f64), values: &mut [f32]) {
        let [left, top, right, bottom] = self.within.map(f64::from);
        let (right, bottom) = (
            right.min(self.width as f64 - 1.001),
            bottom.min(self.height as f64 - 1.001),
        );
        // The steps that are inside come one after the other.
        let across = steps_between((start.0, step.0), (left, right));
        let down = steps_between((start.1, step.1), (top, bottom));
        let count = values.len();
        let first = (across.0.max(down.0).ceil() as usize).min(count);
        let end = ((across.1.min(down.1).floor() + 1.0) as usize).clamp(first, count);
        let (before, rest) = values.split_at_mut(first);
        let (inside, behind) = rest.split_at_mut(end - first);
        before.fill(0.0);
        behind.fill(0.0);
        let fixed = |v: f64| (v * ONE) as i64;
        let from = |start: f64, step: f64| fixed(start + first as f64 * step);
        let (mut x, mut y) = (from(start.0, step.0), from(start.1, step.1));
        let (dx, dy) = (fixed(step.0), fixed(step.1));
        let share = |v: i64| ((v >> 8) & 0xff_ffff) as i32 as f32 * (1.0 / 16_777_216.0);
        let (most, least) = (self.most, -self.most);
        for value in inside {
            let (u, v) = (share(x), share(y));
            let k = (y >> 32) as usize * self.width + (x >> 32) as usize;
            let rows = (
                self.pixels.get(k..k + 2),
                self.pixels.get(k + self.width..k + self.width + 2),
            );
            if let (Some([a, b]), Some([c, d])) = rows {
                let (upper, lower) = (a + u * (b - a), c + u * (d - c));
                let between = upper + v * (lower - upper);
                let between = if between < most { between } else { most };
                *value = if between > least { between } else { least };
            }
            (x, y) = (x + dx, y + dy);
        }
    }
}

/// The first and the last step (numbers that need not be whole, none if the last is before the first) at which `start` plus a
/// multiple of `step` is between two places.
fn steps_between((start, step): (f64, f64), (low, high): (f64, f64)) -> (f64, f64) {
    // Rounding in fixed point stays inside.
    let (low, high) = (low + 1e-6, high - 1e-6);
    if step.abs() < 1e-9 {
        return if start >= low && start <= high {
            (0.0, f64::MAX)
        } else {
            (f64::MAX, -1.0)
        };
    }
    let (a, b) = ((low - start) / step, (high - start) / step);
    (a.min(b).max(0.0), a.max(b).max(-1.0))
}

/// Where to look: middle, half axes (px) and the long one's angle (rad) of an ellipse about the object with its halo.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Start {
    pub x_px: f64,
    pub y_px: f64,
    pub long_px: f64,
    pub short_px: f64,
    pub angle_rad: f64,
}

/// What the outline encloses.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Outline {
    pub x_px: f64,
    pub y_px: f64,
    /// Of `x_px`, `y_px`, and their covariance, px^2.
    pub place_variances: [f64; 3],
    pub area_px: f64,
    pub area_variance: f64,
    /// Central second moments: x x, x y, y y.
    pub moments_px2: [f64; 3],
    /// Their covariance: of the first with all three, of the second with the last two, of the last.
    pub moment_variances: [f64; 6],
    /// Contrast of the rim, signed.
    pub rim_grey: f64,
    /// Contrast of the halo, signed; of the same sign as the rim, or 0, without a halo.
    pub halo_grey: f64,
    /// Area over that of the convex hull.
    pub solidity: f64,
    /// Depths of the two deepest dents below the convex hull, px.
    pub dents_px: [f64; 2],
    /// Variance of a point of the contour along its normal, px^2.
    pub point_variance: f64,
    /// Length of the longest stretch of the contour that has no edge, px.
    pub open_px: f64,
    /// Width of the edge, from the rim to the halo, px.
    pub edge_px: f64,
    pub at_border: bool,
}

/// Buffers of the outliner.
#[derive(Debug, Clone)]
pub(crate) struct Outliner {
    /// All rays and all passes.
    pub thorough: bool,
    rays: usize,
    steps: usize,
    samples: Vec<[f32; MAX_STEPS]>,
    scores: Vec<[f32; MAX_STEPS]>,
    /// The best that leads to each step of each ray.
    ways: Vec<contour::Way>,
    points: Vec<(f64, f64)>,
    normals: Vec<(f64, f64)>,
    profiles: Vec<normals::Values>,
    shifts: Vec<f64>,
    /// Amplitude of each normal's profile, relative to the mean one.
    amplitudes: Vec<f64>,
    hull: Vec<(f64, f64)>,
    sorted: Vec<(f64, f64)>,
    shapes: edge::Shapes,
    smear: smear::Smear,
    /// Blur of the frame, px.
    blur_px: f64,
}

impl Outliner {
    pub(crate) fn new() -> Self {
        Outliner {
            thorough: false,
            rays: 0,
            steps: 0,
            samples: vec![[0.0; MAX_STEPS]; MAX_RAYS],
            scores: vec![[0.0; MAX_STEPS]; MAX_RAYS],
            ways: vec![contour::NO_WAY; MAX_RAYS + OVERLAP],
            points: Vec::with_capacity(MAX_RAYS),
            normals: Vec::with_capacity(MAX_RAYS),
            profiles: vec![[0.0; 2 * MAX_FINE + 1]; MAX_RAYS],
            shifts: vec![0.0; MAX_RAYS],
            amplitudes: vec![1.0; MAX_RAYS],
            hull: Vec::with_capacity(2 * MAX_RAYS + 2),
            sorted: Vec::with_capacity(MAX_RAYS),
            shapes: edge::Shapes::new(),
            smear: smear::Smear::new(),
            blur_px: 0.0,
        }
    }

    /// Says how far the cells of the next frames go while these are exposed, px.
    pub(crate) fn expect_smear(&mut self, way_px: (f64, f64)) {
        self.smear.way_px = way_px;
    }

    /// Says how much softer than in focus the next frame is: the standard deviation of a Gaussian, px.
    pub(crate) fn expect_blur(&mut self, px: f64) {
        self.blur_px = px;
    }

    /// Points of the last outline, px.
    pub(crate) fn points(&self) -> &[(f64, f64)] {
        &self.points
    }

    /// Outlines the object within `start`; `noise` is the standard deviation of a pixel, grey levels. `None` where there
    /// is no closed step.
    pub(crate) fn outline(
        &mut self,
        contrast: &Contrast,
        start: &Start,
        noise: f64,
    ) -> Option<Outline> {
        let polarity = self.lay(contrast, start, noise)?;
        let (long_px, short_px) = self.half_axes_px();
        let trust = ((ROUND.1 - long_px / short_px.max(1.0)) / (ROUND.1 - ROUND.0)).clamp(0.0, 1.0);
        let reach_px = (REACH * short_px).clamp(3.0, MAX_FINE as f64 * FINE_PX);
        let half = (reach_px / FINE_PX).round() as usize;
        let mut profile = None;
        for _ in 0..PASSES {
            self.find_normals();
            self.sample(contrast, half);
            profile = Some(self.align(half, polarity)?);
            if self.shift_points() < SETTLED_PX && !self.thorough {
                break;
            }
        }
        // The contour may be on a lobe next to the edge: about the edge itself the profile does not depend on the start.
        let near = profile?.edge(self.radius_px(), &self.shapes, 0.0)?;
        self.find_normals();
        self.shift_outwards(near.at_px);
        self.refine();
        self.find_normals();
        self.sample(contrast, half);
        let profile = self.align(half, polarity)?;
        self.shift_points();
        let edge = profile.edge(self.radius_px(), &self.shapes, trust)?;
        self.find_normals();
        self.shift_outwards(edge.at_px);
        let residual = self.residual().max(noise * noise);
        let edge_px = profile.edge_width_px();
        self.measure(contrast, residual, (edge.rim_grey, edge.halo_grey), edge_px)
    }
}
