//! The template learnt in place: the profile of good fixes, guarded against learning something else.

use crate::config::Learning;
use crate::crop::Crop;
use crate::profile::{clamped_curvatures, spline_value};
use crate::smooth::Rings;
use crate::template::Template;

/// Knots of the learnt profile.
const KNOTS: usize = 48;
/// Fixes of which one is taken, once the first template is learnt: refreshing is slow and must cost next to nothing.
const REFRESH_STRIDE: u32 = 16;
/// Share of a refresh in the profile.
const REFRESH_SHARE: f64 = 0.25;

type Knots = [f64; KNOTS];

/// How far the learning has come.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct LearningReport {
    /// Good fixes taken in so far.
    pub fixes: u64,
    /// Templates taken over, the first included.
    pub taken: u32,
    /// Templates refused because they differed too much.
    pub refused: u32,
    /// Times that the profile in use predicted half of the fixes as well as one learnt from the other half: it stayed.
    pub confirmed: u32,
}

/// Accumulates the radial profile and replaces the template.
#[derive(Debug, Clone)]
pub(crate) struct Learner {
    settings: Learning,
    knot_px: f64,
    rings: Box<Rings>,
    /// The profile in use and the one that refreshes may not drift away from.
    profile: Knots,
    anchor: Knots,
    since: u32,
    report: LearningReport,
}

impl Learner {
    /// For windows of side `window_px`; `template` is the configured one.
    pub(crate) fn new(settings: Learning, window_px: usize, template: &Template) -> Self {
        // The corner of the window is the last pixel that can contribute.
        let reach_px = window_px as f64 / 2.0 * core::f64::consts::SQRT_2;
        let knot_px = reach_px / (KNOTS - 1) as f64;
        let configured = core::array::from_fn(|k| {
            let r_px = k as f64 * knot_px;
            f64::from(template.value_at_squared((r_px * r_px) as f32))
        });
        Learner {
            settings,
            knot_px,
            rings: Box::new(Rings::new(reach_px)),
            profile: configured,
            anchor: configured,
            since: 0,
            report: LearningReport::default(),
        }
    }

    pub(crate) fn max_change(&self) -> f64 {
        self.settings.max_change
    }

    pub(crate) fn report(&self) -> LearningReport {
        self.report
    }

    /// Whether the first profile is still to be learnt.
    pub(crate) fn is_first(&self) -> bool {
        self.report.taken + self.report.confirmed == 0
    }

    /// Takes in a good fix: position in frame coordinates, amplitude and background (above the crop's pedestal).
    pub(crate) fn take_in(
        &mut self,
        crop: &Crop,
        (x_px, y_px): (f64, f64),
        amplitude: f64,
        background: f64,
    ) -> bool {
        self.since = self.since.saturating_add(1);
        let learnt = !self.is_first();
        if learnt
            && (self.settings.refresh_fixes == 0 || !self.since.is_multiple_of(REFRESH_STRIDE))
        {
            return false;
        }
        self.report.fixes += 1;
        self.rings.next_bead();
        let (x, y) = (
            (x_px - crop.x0 as f64) as f32,
            (y_px - crop.y0 as f64) as f32,
        );
        // Even noise of the pixels is noise over the amplitude here.
        let (scale, weight) = (1.0 / amplitude, amplitude * amplitude);
        for (j, row) in crop.rows.iter().enumerate().take(crop.height) {
            let dy = j as f32 - y;
            for (i, p) in row.iter().enumerate().take(crop.width) {
                let dx = i as f32 - x;
                let r_px = f64::from((dx * dx + dy * dy).sqrt());
                self.rings
                    .add(r_px, (f64::from(*p) - background) * scale, weight);
            }
        }
        self.since
            >= if learnt {
                self.settings.refresh_fixes
            } else {
                self.settings.first_fixes
            }
    }

    /// Replaces the template by what has been gathered, if that predicts beads better and does not differ too much.
    /// Allocates nothing.
    pub(crate) fn refresh(&mut self, template: &mut Template) {
        self.since = 0;
        let first = self.is_first();
        template.stretch_to(1.0);
        let learnt = self
            .rings
            .learn_beyond(|r_px| f64::from(template.value_at_squared((r_px * r_px) as f32)));
        self.rings.clear();
        if !learnt.deviates {
            self.report.confirmed = self.report.confirmed.saturating_add(1);
            return;
        }
        let mut fresh = normalised(core::array::from_fn(|k| {
            learnt.value(k as f64 * self.knot_px)
        }));
        let allowed = if first {
            self.settings.max_change
        } else {
            0.25 * self.settings.max_change
        };
        if !first {
            for (f, p) in fresh.iter_mut().zip(&self.profile) {
                *f = p + REFRESH_SHARE * (*f - p);
            }
        }
        let difference = difference(&fresh, &self.anchor);
        if difference.is_nan() || difference > allowed {
            self.report.refused = self.report.refused.saturating_add(1);
            return;
        }
        self.report.taken = self.report.taken.saturating_add(1);
        self.profile = fresh;
        if first {
            self.anchor = fresh;
        }
        let (mut upper, mut curvatures) = ([0.0; KNOTS], [0.0; KNOTS]);
        clamped_curvatures(&fresh, &mut upper, &mut curvatures);
        let knot_px = self.knot_px;
        template.fill(knot_px * (KNOTS - 1) as f64, |r_px| {
            spline_value(&fresh, &curvatures, r_px / knot_px)
        });
    }
}

/// The profile with 1 at the centre and 0 at the last knots.
fn normalised(mut v: Knots) -> Knots {
    // Amplitude and background are free in every fit: the profile's own are fixed here, by means over the area of the
    // first knots and of the outer fifth.
    let mean = |range: core::ops::Range<usize>, v: &Knots| {
        let part = v.iter().enumerate().take(range.end).skip(range.start);
        let (s, w) = part.fold((0.0, 0.0), |(s, w), (k, v)| {
            let n = k as f64 + 0.125;
            (s + v * n, w + n)
        });
        s / w
    };
    let floor = mean(KNOTS * 4 / 5..KNOTS, &v);
    let top = mean(0..4, &v);
    for (k, v) in v.iter_mut().enumerate() {
        let fade = ((KNOTS - 1 - k) as f64 / 4.0).min(1.0);
        *v = fade * (*v - floor) / (top - floor);
    }
    v
}

/// RMS difference of two profiles over the area of the disc, after the best match of scale.
fn difference(a: &Knots, b: &Knots) -> f64 {
    let (mut ab, mut bb, mut aa, mut area) = (0.0, 0.0, 0.0, 0.0);
    for (k, (a, b)) in a.iter().zip(b).enumerate() {
        let w = k as f64;
        ab += w * a * b;
        bb += w * b * b;
        aa += w * a * a;
        area += w;
    }
    ((aa - ab * ab / bb).max(0.0) / area).sqrt()
}
