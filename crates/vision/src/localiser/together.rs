//! Positions of beads whose images overlap.

use super::certainty::LEAST_SIGNIFICANCE;
use super::{CONVERGED_PX, Localiser, STRETCHES};
use crate::config::{MAX_WINDOW_PX, PixelNoise};
use crate::fix::{Fix, FixQuality};
use crate::frame::Frame;
use crate::joint::{self, Bead, MOST_TOGETHER, Rest};
use crate::speckle;
use crate::streak::Comb;

/// Two fits nearer to each other than the first, in bead radii, are one image fitted twice. A fit further from its start than the
/// second has gone to another bead.
const APART_RADII: f64 = 0.5;
const ASTRAY_RADII: f64 = 1.5;

/// Places of the beads, px, and the misfit there.
type Places = ([(f64, f64); MOST_TOGETHER], f64);

/// Where one of several beads is looked for.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Start {
    /// Place in the frame, px.
    pub place_px: (f64, f64),
    /// What is known of its peak contrast: mean and standard deviation, grey levels. Two images that nearly coincide tell the
    /// sum of their contrasts only.
    pub contrast: Option<(f64, f64)>,
}

/// Positions found together, of which `count` are used.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Together {
    fixes: [Fix; MOST_TOGETHER],
    count: usize,
}

impl Together {
    /// One fix a bead, in the order of the places given.
    pub fn fixes(&self) -> impl Iterator<Item = &Fix> {
        self.fixes.iter().take(self.count)
    }

    /// Whether every bead's position can be used, or is only cut by the border.
    pub fn all_seen(&self) -> bool {
        self.fixes()
            .all(|f| matches!(f.verdict, FixQuality::Good | FixQuality::AtBorder))
    }

    pub(crate) fn residual_ratio(&self) -> f64 {
        self.fixes[0].residual_ratio
    }
}

impl Localiser {
    /// Positions of two to four beads whose images overlap, near the places given (px), with what is known of their contrasts.
    /// All are drawn out along the streak that is expected. `None` if two fits are one image, or one goes
    /// astray. The template is not learnt from such a fix. Allocates nothing.
    pub fn locate_together(&mut self, frame: &Frame, starts: &[Start]) -> Option<Together> {
        let (mut beads, count) = ([Bead::default(); MOST_TOGETHER], starts.len());
        for (bead, start) in beads.iter_mut().zip(starts) {
            (bead.x_px, bead.y_px) = start.place_px;
            bead.contrast = start.contrast;
        }
        let beads = beads.get_mut(..count)?;
        self.comb = Comb::new(self.streak, self.template.radius_px());
        self.template.stretch_to(1.0);
        if !self.take_all(frame, beads) {
            return None;
        }
        let mut found = self.fit_together(beads)?;
        if !self.comb.is_still() {
            found = self.fit_length_together(beads, found)?;
        }
        let noise = self.noise_sd() as f32;
        if self.ratio_together(&found.1, count) > self.config.max_residual_ratio
            && speckle::clean(&mut self.crop, noise) > 0
        {
            restart(beads, starts);
            found = self.fit_together(beads)?;
        }
        let (converged, rest) = found;
        let radius_px = self.template.radius_px();
        let apart = |a: &Bead, b: &Bead| f64::hypot(a.x_px - b.x_px, a.y_px - b.y_px);
        let pairs = || (0..count).flat_map(|i| (0..i).map(move |k| (i, k)));
        let one = pairs().any(|(i, k)| apart(&beads[i], &beads[k]) < APART_RADII * radius_px);
        let astray = beads.iter().zip(starts).any(|(bead, start)| {
            let (x, y) = start.place_px;
            f64::hypot(bead.x_px - x, bead.y_px - y) > ASTRAY_RADII * radius_px
        });
        (!one && !astray).then(|| self.judge_together(frame, beads, converged, &rest))
    }

    /// Takes the window that holds the windows of all beads.
    fn take_all(&mut self, frame: &Frame, beads: &[Bead]) -> bool {
        let ends = |of: fn(&Bead) -> f64| {
            let all = beads.iter().map(of);
            all.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| {
                (low.min(v), high.max(v))
            })
        };
        let (x, y) = (ends(|b| b.x_px), ends(|b| b.y_px));
        let extent_px = (x.1 - x.0).max(y.1 - y.0);
        if extent_px.is_nan() || extent_px >= MAX_WINDOW_PX as f64 {
            return false;
        }
        let side_px = (self.config.window_px + extent_px.ceil() as usize) | 1;
        let taken = side_px <= MAX_WINDOW_PX
            && self
                .crop
                .take(frame, 0.5 * (x.0 + x.1), 0.5 * (y.0 + y.1), side_px);
        if taken && self.noise_variance.is_none() {
            self.read_noise();
        }
        taken
    }

    /// Gauss-Newton passes until no bead moves; whether they have come to rest.
    fn fit_together(&mut self, beads: &mut [Bead]) -> Option<(bool, Rest)> {
        let reach_px = 0.4 * self.template.radius_px();
        let (mut rest, mut before): (Option<Rest>, Option<Places>) = (None, None);
        for n in 1..=self.config.max_passes {
            self.count_pass(beads.len());
            let weights = self.weights_of(rest.map(|r| (1.0, r.background)));
            let unit = self.weight_unit();
            let found = joint::pass(
                &self.crop,
                &self.template,
                &self.comb,
                beads,
                (weights, unit),
            )?;
            // A step that has made the fit worse was too long. Weights from the model need a model: the first pass has none.
            if let Some((places, misfit)) = before
                && found.at_rest > misfit
                && n < self.config.max_passes
            {
                for (bead, (x_px, y_px)) in beads.iter_mut().zip(places) {
                    (bead.x_px, bead.y_px) = (0.5 * (bead.x_px + x_px), 0.5 * (bead.y_px + y_px));
                }
                continue;
            }
            let weighted = n > 1 || !self.has_shot_noise();
            let mut places = [(0.0, 0.0); MOST_TOGETHER];
            let mut longest_px = 0.0_f64;
            for (bead, place) in beads.iter_mut().zip(&mut places) {
                *place = (bead.x_px, bead.y_px);
                let length_px = f64::hypot(bead.step_px.0, bead.step_px.1);
                let scale = (reach_px / length_px).min(1.0);
                bead.x_px += scale * bead.step_px.0;
                bead.y_px += scale * bead.step_px.1;
                longest_px = longest_px.max(length_px);
            }
            before = weighted.then_some((places, found.at_rest));
            if longest_px < CONVERGED_PX && weighted {
                return Some((true, found));
            }
            rest = Some(found);
        }
        rest.map(|rest| (false, rest))
    }

    /// Refines the common length of the beads' streaks.
    fn fit_length_together(
        &mut self,
        beads: &mut [Bead],
        first: (bool, Rest),
    ) -> Option<(bool, Rest)> {
        let (mut found, mut factor) = (first, 1.0);
        for _ in 0..STRETCHES {
            let all = beads.iter().map(|b| (b.x_px, b.y_px, b.amplitude));
            let Some(better) = self.stretched(factor, all) else {
                break;
            };
            factor = better;
            found = self.fit_together(beads)?;
        }
        Some(found)
    }

    fn ratio_together(&self, rest: &Rest, count: usize) -> f64 {
        let free = (self.crop.width * self.crop.height) as f64 - (3 * count + 1) as f64;
        rest.chi2.max(0.0) / (self.weight_unit() * free.max(1.0))
    }

    fn judge_together(
        &self,
        frame: &Frame,
        beads: &[Bead],
        converged: bool,
        rest: &Rest,
    ) -> Together {
        let unit = self.weight_unit();
        let background = rest.background + f64::from(self.crop.pedestal);
        let noise = self.pixel_variance(background).sqrt();
        let residual_ratio = self.ratio_together(rest, beads.len());
        let snr = |bead: &Bead| self.sign() * bead.amplitude / noise;
        // A template's error is a share of each bead's own light in its own window.
        let side = self.config.window_px as f64;
        let share = side * side / (self.crop.width * self.crop.height) as f64;
        let errors: f64 = (beads.iter())
            .map(|bead| self.tolerated_error(snr(bead)))
            .sum();
        let tolerated = self.config.max_residual_ratio + share * errors;
        let widening = residual_ratio.max(1.0);
        let mut fixes = [Fix::none(0.0, 0.0, FixQuality::NoSignal); MOST_TOGETHER];
        for (fix, bead) in fixes.iter_mut().zip(beads) {
            let variance = unit * widening * bead.amplitude_variance;
            let significance = self.sign() * bead.amplitude / variance.sqrt();
            let verdict = if snr(bead) < self.config.min_snr || significance < LEAST_SIGNIFICANCE {
                FixQuality::NoSignal
            } else if !converged {
                FixQuality::NotConverged
            } else if residual_ratio > tolerated {
                FixQuality::BadFit
            } else {
                self.whole(frame, (bead.x_px, bead.y_px))
            };
            *fix = Fix {
                x_px: bead.x_px,
                y_px: bead.y_px,
                var_x_px2: unit * widening * bead.covariance[(0, 0)],
                var_y_px2: unit * widening * bead.covariance[(1, 1)],
                cov_xy_px2: unit * widening * bead.covariance[(0, 1)],
                amplitude: bead.amplitude,
                background,
                residual_ratio,
                snr: snr(bead),
                range_used: 0.0,
                verdict,
            };
        }
        Together {
            fixes,
            count: beads.len(),
        }
    }

    fn noise_sd(&self) -> f64 {
        self.noise_variance.unwrap_or(1.0).sqrt()
    }

    pub(super) fn has_shot_noise(&self) -> bool {
        matches!(self.config.noise, PixelNoise::Known { shot_grey_per_electron, .. } if shot_grey_per_electron > 0.0)
    }
}

fn restart(beads: &mut [Bead], starts: &[Start]) {
    for (bead, start) in beads.iter_mut().zip(starts) {
        (bead.x_px, bead.y_px) = start.place_px;
    }
}
