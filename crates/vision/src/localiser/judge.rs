//! The verdict on a fit, and the variance of its place.

use super::certainty::LEAST_SIGNIFICANCE;
use super::rise::Rise;
use super::{Fitted, Localiser, NARROW_RADII};
use crate::config::PixelNoise;
use crate::fit::Weights;
use crate::fix::{Fix, FixQuality};
use crate::frame::Frame;
use crate::left::Left;
use crate::observed;
use crate::template::Template;

/// Residual ratio from which the residual gives the variance. Noise alone does not reach it.
pub(super) const WIDENED_RATIO: f64 = 1.3;
/// Least residual ratio: of a window without noise.
const LEAST_LEFT: f64 = 1e-3;
/// Residual ratio of the pixels that tell the place, over the last fixes. A narrow bead has few of these pixels; noise alone varies by
/// 0.06.
const WIDENED_LOCALLY: f64 = 1.2;
/// Mean square of the measured ring about its mean in its window of 25 px (`the_measured_bead_fills_its_window...`).
const MEASURED: f64 = 0.135;

/// Radius of a bead that patches of whole pixels do not resolve. Then the residual of the pixels that tell the place counts.
const UNRESOLVED_PX: f64 = 2.5;
/// Square of the least answer of a picture to a motion of the bead, over the template's: below, noise decides.
const LEAST_ANSWER: f64 = 0.04;
/// Fixes by which a look at one window is surer than the mean of the last: one window tells an answer with noise.
const POOLED_FIXES: f64 = 4.0;
/// Share of fixes that something spoils which spoils no others, before the window is looked at.
const SPOILT: f64 = 0.01;
/// Share of a bead's contrast in its window that the template must explain where the rest is the same all round.
const LEAST_EXPLAINED: f64 = 0.5;

impl Localiser {
    /// The verdict of a fit, and its figures.
    pub(super) fn judge(&self, frame: &Frame, fitted: Option<Fitted>, guess: (f64, f64)) -> Fix {
        let Some(f) = fitted else {
            return Fix::none(guess.0, guess.1, FixQuality::NoSignal);
        };
        let amplitude = f.pass.amplitude;
        let background = f.pass.background + f64::from(self.crop.pedestal);
        let pixels = (self.crop.width * self.crop.height) as f64;
        let unit = self.weight_unit();
        let residual_ratio = f.pass.chi2.max(0.0) / (unit * (pixels - 4.0));
        let variance = match self.weights(Some(&f.pass)) {
            Weights::Even { .. } => unit,
            Weights::Shot { base, .. } => f64::from(base),
        };
        let snr = self.sign * amplitude / variance.sqrt();
        let in_window =
            |c: f64, first: usize, len: usize| c >= first as f64 && c <= (first + len - 1) as f64;
        let kept = in_window(f.x_px, self.crop.x0, self.crop.width)
            && in_window(f.y_px, self.crop.y0, self.crop.height);
        let verdict = if snr < self.config.min_snr {
            FixQuality::NoSignal
        } else if !f.converged || !kept {
            FixQuality::NotConverged
        } else if residual_ratio > self.tolerated_now(snr) {
            FixQuality::BadFit
        } else {
            self.whole(frame, (f.x_px, f.y_px))
        };
        Fix {
            x_px: f.x_px,
            y_px: f.y_px,
            var_x_px2: unit * f.pass.covariance[(0, 0)],
            var_y_px2: unit * f.pass.covariance[(1, 1)],
            cov_xy_px2: unit * f.pass.covariance[(0, 1)],
            amplitude,
            background,
            residual_ratio,
            snr,
            range_used: 0.0,
            verdict,
        }
    }

    /// How much of the range for which there is a good fix is used up by a good one whose contrast has a standard deviation.
    pub(super) fn range_used(&self, fix: &Fix, contrast_sd: f64) -> f64 {
        let noise = self.config.min_snr / fix.snr;
        let noise = noise.max(LEAST_SIGNIFICANCE * contrast_sd / (self.sign * fix.amplitude));
        let left = (fix.residual_ratio - 1.0).max(0.0);
        let by_template = left / (self.tolerated(fix.snr) - 1.0);
        let shape = if self.comb.is_still() {
            let (explained, _) = self.explained(fix);
            let by_ring = left / ((1.0 - LEAST_EXPLAINED) * (explained + left));
            // A lopsided rest is not part of the ring; where that was asked, it is known.
            by_template.min(by_ring.max(self.lopsided))
        } else {
            by_template
        };
        noise.max(shape)
    }

    /// The part of the bead's contrast in the window that the template explains, and the part that it leaves, in variances of the noise.
    fn explained(&self, fix: &Fix) -> (f64, f64) {
        let left = (fix.residual_ratio - 1.0).max(0.0);
        (self.contrast_of(fix.snr), left)
    }

    /// Mean square of a bead's contrast in the window, in variances of the noise.
    fn contrast_of(&self, snr: f64) -> f64 {
        let filled = self.filled[usize::from(self.crop.width < self.config.window_px)];
        filled * MEASURED * snr * snr
    }

    /// Residual ratio up to which a template's error explains the residual of a bead of this contrast over the noise.
    fn tolerated(&self, snr: f64) -> f64 {
        self.config.max_residual_ratio + self.tolerated_error(snr)
    }

    /// The same with the share of a bead's contrast that the last good fixes left unexplained. Noise is read off the border of a window,
    /// and a codec leaves less noise there than on a bead. Beyond the settings' own tolerance the template must explain half of the
    /// contrast.
    /// Only for narrow beads: there the last fixes also widen the variance of the contrast, so that no more of the noise passes.
    fn tolerated_now(&self, snr: f64) -> f64 {
        let (by_settings, contrast) = (self.tolerated(snr), self.contrast_of(snr));
        if self.template.radius_px() >= UNRESOLVED_PX {
            return by_settings;
        }
        let usual = self.config.max_residual_ratio * self.unexplained.mean * contrast;
        let half = LEAST_EXPLAINED / (1.0 - LEAST_EXPLAINED) * contrast;
        (by_settings + usual).min(1.0 + half).max(by_settings)
    }

    /// The part of the tolerated residual ratio that is the template's error.
    pub(super) fn tolerated_error(&self, snr: f64) -> f64 {
        let filled = self.filled[usize::from(self.crop.width < self.config.window_px)];
        filled * (self.template_tolerance() * snr).powi(2)
    }

    /// The verdict on a place: good unless the border cuts the bead.
    pub(super) fn whole(&self, frame: &Frame, (x_px, y_px): (f64, f64)) -> FixQuality {
        let margin_px = self.template.radius_px();
        let inside = |c: f64, len: usize| c >= margin_px && c <= len as f64 - 1.0 - margin_px;
        if inside(x_px, frame.width) && inside(y_px, frame.height) {
            FixQuality::Good
        } else {
            FixQuality::AtBorder
        }
    }

    /// Whether something else explains more of the window than the bead of a fix, whose noise is widened.
    pub(super) fn has_rival(&self, fix: &Fix, left: &Left, widening: f64) -> bool {
        let variance = self.pixel_variance(fix.background) * widening;
        let (at, radius_px) = ((fix.x_px, fix.y_px), self.template.radius_px());
        self.comb.is_still() && left.has_rival(&self.crop, at, radius_px, self.sign, variance)
    }

    /// Lets a bad fit pass whose residual is the same all round: a bead in another focus, or blurred. The template has to explain
    /// most of what the bead adds to the window.
    pub(super) fn pardon(&mut self, frame: &Frame, fix: &mut Fix) {
        let variance = self.pixel_variance(fix.background);
        let (explained, left) = self.explained(fix);
        if !self.comb.is_still() || explained < LEAST_EXPLAINED * (explained + left) {
            return;
        }
        let background = fix.background - f64::from(self.crop.pedestal);
        let lopsided = self.residues.lopsided(
            &self.crop,
            &self.template,
            &self.comb,
            (fix.x_px, fix.y_px),
            (fix.amplitude, background),
        );
        self.lopsided = lopsided / variance / self.tolerated(fix.snr);
        if self.lopsided <= 1.0 {
            fix.verdict = self.whole(frame, (fix.x_px, fix.y_px));
        }
    }

    /// Narrows a fix's covariance if the last fixes have left less than the noise of the windows' borders. The end of a ring at the
    /// border counts as noise.
    fn narrow(&mut self, fix: &mut Fix) {
        let pixels = (self.crop.width * self.crop.height) as f64;
        self.ratio
            .take_in(fix.residual_ratio.max(LEAST_LEFT), pixels);
        let (contrast, left) = self.explained(fix);
        self.unexplained.take_in(left / contrast);
        if let PixelNoise::Estimated = self.config.noise {
            let factor = self.ratio.common().unwrap_or(1.0).clamp(0.5, 1.0);
            fix.var_x_px2 *= factor;
            fix.var_y_px2 *= factor;
            fix.cov_xy_px2 *= factor;
        }
    }

    /// Widens a good fix's covariance by the template's residual, and returns the factor.
    pub(super) fn widen(&mut self, fix: &mut Fix, left: &Left) -> f64 {
        if fix.verdict != FixQuality::Good {
            return 1.0;
        }
        // A streak's residual says nothing of others.
        if self.comb.is_still() {
            self.narrow(fix);
            self.add_lines(fix, left);
        }
        let observed = self.observe(fix);
        let here = left.local_variance / self.pixel_variance(fix.background);
        let (own, freedom) = self.by_pixels(here, 0.0);
        let locally = self.local.moderate(own, freedom);
        let more = fix.residual_ratio > WIDENED_RATIO || locally > WIDENED_LOCALLY;
        let (widening, answer) = if more {
            let (widening, of_rings) = self.widening_by_what_is_left(fix, left);
            let by_rings = self.template.radius_px() >= UNRESOLVED_PX || !self.comb.is_still();
            (widening, if by_rings { of_rings } else { observed })
        } else {
            (self.widening_by_pixels(own, freedom), observed)
        };
        // One window tells it with noise; the last fixes have been in a like focus.
        let answer = if self.comb.is_still() || more {
            self.answers.shrink(answer, 1.0, POOLED_FIXES)
        } else {
            1.0
        };
        let all = widening / (answer * answer).max(LEAST_ANSWER);
        fix.var_x_px2 *= all;
        fix.var_y_px2 *= all;
        fix.cov_xy_px2 *= all;
        widening
    }

    /// How much the picture of a bead at rest answers to a motion, over how much the template does. Takes in how much its score
    /// scatters.
    fn observe(&mut self, fix: &Fix) -> f64 {
        if !self.comb.is_still() {
            return 1.0;
        }
        let background = fix.background - f64::from(self.crop.pedestal);
        let parts = (fix.amplitude, background);
        let seen = observed::of(&self.crop, &self.template, (fix.x_px, fix.y_px), parts);
        let variance = self.pixel_variance(fix.background);
        let common = self.noises.common().unwrap_or(variance);
        self.alike.take_scatter(seen.scatter, common, variance);
        seen.answer
    }

    /// Adds what light that rises along row and column may have moved the fix by: whether it is the light that the bead is seen by,
    /// nobody says, and whether it rises evenly, what is left says.
    pub(super) fn add_rise(&self, fix: &mut Fix, rise: &Rise) {
        let moves = |slope: f64| self.shading_px2 * slope / fix.background.max(1.0);
        let (x_px, y_px) = (moves(rise.slope.0), moves(rise.slope.1));
        let [of_x, of_y] = rise.way_px2;
        fix.var_x_px2 += x_px * x_px + of_x;
        fix.var_y_px2 += y_px * y_px + of_y;
    }

    /// The same where it leaves more than noise: what patches and pixels leave besides their mean all round. That mean tells how
    /// much steeper the template is than the bead.
    fn widening_by_what_is_left(&mut self, fix: &Fix, left: &Left) -> (f64, f64) {
        let at = (fix.x_px, fix.y_px);
        let background = fix.background - f64::from(self.crop.pedestal);
        let variance = self.pixel_variance(fix.background);
        // In the noise that windows have in common: what is pooled would vary with that of each window.
        let common = self.noises.common().unwrap_or(variance);
        let bends = left.bends(fix.amplitude);
        let seen = self.residues.widening(
            &self.crop,
            &self.template,
            &self.comb,
            at,
            (fix.amplitude, background),
            (common, bends),
        );
        let (by_patches, bends, is_known) = match seen {
            Some(seen) => (seen.by * common / variance, seen.bends, seen.is_known),
            None => (fix.residual_ratio, bends, false),
        };
        let mut by_patches = by_patches.max(1.0);
        if self.template.radius_px() >= UNRESOLVED_PX && self.comb.is_still() {
            let stated = by_patches * variance / (fix.amplitude * fix.amplitude);
            let bends = bends.map(|bend| bend * bend / stated);
            by_patches *= self.alike.beyond(bends, is_known);
        }
        let (local, answer) = self.residues.besides_the_mean(
            &self.crop,
            &self.template,
            &self.comb,
            at,
            fix.amplitude,
        );
        // A ring's mean takes a part of its pixels: two thirds of one of 2 pi r, at half the radius.
        let by_rings = 2.0 / 3.0 * self.template.radius_px();
        let (own, freedom) = self.by_pixels(local / variance, by_rings);
        let by_pixels = self.widening_by_pixels(own, freedom);
        (by_pixels.max(by_patches), answer)
    }

    /// What the pixels that tell the place leave, over noise, and the degrees of freedom. `taken` is what was fitted besides place
    /// and contrast, in pixels.
    fn by_pixels(&self, left: f64, taken: f64) -> (f64, f64) {
        let radius_px = self.template.radius_px();
        // Of a Gaussian, exactly: the square of the sum of the squared derivatives, over the sum of their squares. Place and
        // contrast take their part.
        let pixels = (core::f64::consts::PI * radius_px * radius_px).max(8.0);
        let freedom = pixels - 3.0 - taken;
        (left * pixels / freedom, freedom)
    }

    /// The variance by them. Of a narrow bead they are few: it is that of the last fixes, or this fix is spoilt, and it is their own.
    /// The posterior of the two weights them. Of a wide bead patches say more.
    fn widening_by_pixels(&mut self, own: f64, freedom: f64) -> f64 {
        if self.comb.is_still() {
            self.local.take_in(own.max(LEAST_LEFT), freedom);
        }
        let radius_px = self.template.radius_px();
        if radius_px >= UNRESOLVED_PX {
            return 1.0;
        }
        let usual = self.local.common().unwrap_or(1.0).max(1.0);
        let ratio = (own / usual).max(1.0);
        let odds = SPOILT * (0.5 * freedom * (ratio - 1.0 - ratio.ln())).exp();
        let spoilt = if odds.is_finite() {
            odds / (1.0 + odds)
        } else {
            1.0
        };
        self.alike.here.max(1.0) * (1.0 + spoilt * (ratio - 1.0))
    }

    /// Part of the whole window that the bead fills, for the tolerance of a template's error: see [`filled`].
    pub(crate) fn filled(&self) -> f64 {
        self.filled[0]
    }
}

/// How much of a window, and of the narrow one, a bead fills, at most 1: the template's square about its mean over that of the
/// measured bead's in its default window. An error that is a fraction of the bead is a smaller one of a window that the
/// bead fills in part.
pub(super) fn filled(template: &Template, window_px: usize) -> [f64; 2] {
    let narrow_px = 2 * (NARROW_RADII * template.radius_px()).ceil() as usize + 1;
    [window_px, narrow_px.min(window_px)].map(|side| {
        let half = (side / 2) as i32;
        let (mut sum, mut square, mut n) = (0.0, 0.0, 0.0);
        for (y, x) in (-half..=half).flat_map(|y| (-half..=half).map(move |x| (y, x))) {
            let f = f64::from(template.value_at_squared((x * x + y * y) as f32));
            (sum, square, n) = (sum + f, square + f * f, n + 1.0);
        }
        ((square / n - sum * sum / (n * n)) / MEASURED).min(1.0)
    })
}

/// Way that a fit goes if the bead's image is multiplied by light that rises by all of itself over a px: the square of the standard
/// deviation for a Gaussian.
pub(super) fn shading_px2(template: &Template, window_px: usize) -> f64 {
    let half = (window_px / 2) as i32;
    let (mut moved, mut place) = (0.0, 0.0);
    for (y, x) in (-half..=half).flat_map(|y| (-half..=half).map(move |x| (y, x))) {
        let (f, by_square) = template.at((x * x + y * y) as f32);
        let (x, f) = (f64::from(x), f64::from(f));
        let by_x = -2.0 * x * f64::from(by_square * template.slope_factor());
        moved += f * x * by_x;
        place += by_x * by_x;
    }
    if place > 0.0 { moved / place } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::LocaliserConfig;
    use crate::profile::RingProfile;
    use crate::template::ProfileSpec;

    #[test]
    fn the_measured_bead_fills_its_window_and_a_small_spot_does_not() {
        let edge_px = RingProfile::MEASURED_EDGE_PX;
        let of = |spec| {
            let localiser = Localiser::new(LocaliserConfig::new(spec)).unwrap();
            localiser.filled()
        };
        let ring = of(ProfileSpec::Ring { edge_px });
        let spot = of(ProfileSpec::Gaussian { sigma_px: 1.0 });
        assert!((0.97..=1.0).contains(&ring), "{ring}");
        assert!(spot < 0.2, "{spot}");
    }
}
