//! Whether there is a bead at all: its contrast against noise, and against lines through it.

use super::Localiser;
use crate::dust;
use crate::fit::Pass;
use crate::lines;

/// Contrast of a bead over its own standard deviation. Noise alone exceeds it in one of 10^10 places: once in 10,000 frames
/// of 500 x 500 px, whatever the size of the beads.
pub(super) const LEAST_SIGNIFICANCE: f64 = 6.4;
/// The same beyond the explanation by the lines through it: few places have one, and noise was asked before.
const BEYOND_LINES: f64 = 5.5;
/// From so much on, lines are not asked: they would have to be as strong as the bead.
const BEYOND_DOUBT: f64 = 5.0 * LEAST_SIGNIFICANCE;
/// Standard deviations by which chance makes the noise of a window larger than that of the others: one window in 700.
const CHANCE_SIGMAS: f64 = 3.0;

impl Localiser {
    /// Whether a fit's contrast is beyond noise, and beyond the part that the rows and columns through the bead explain. Whatever
    /// widens the variance of the place widens that of the contrast.
    pub(super) fn is_certain(&self, pass: &Pass, at: (f64, f64), widening: f64) -> bool {
        let unit = self.weight_unit();
        let widening = widening.max(self.noise_alike());
        let variance = unit * widening * pass.amplitude_variance;
        let exceeds = |contrast: f64, variance: f64, sigmas: f64| {
            contrast > 0.0 && contrast * contrast > sigmas * sigmas * variance
        };
        let contrast = self.sign * pass.amplitude;
        if !exceeds(contrast, variance, LEAST_SIGNIFICANCE) {
            return false;
        }
        if exceeds(contrast, variance, BEYOND_DOUBT) {
            return true;
        }
        let pixel = self.pixel_variance(pass.background + f64::from(self.crop.pedestal));
        let lines = lines::explained(
            &self.crop,
            &self.template,
            &self.comb,
            at,
            (pass.amplitude, pass.background),
        );
        lines.iter().all(|line| {
            let beyond = contrast - self.sign * line.contrast;
            exceeds(beyond, variance + pixel * line.variance, BEYOND_LINES)
        })
    }

    /// By how much the noise of this window makes contrasts vary more than white noise of its variance. What it has beyond the noise of
    /// the last windows, and beyond chance, is the light of something else, which is alike over some pixels.
    fn noise_alike(&self) -> f64 {
        let own = self.noise_variance.unwrap_or(1.0);
        let Some(usual) = self.usual_noise() else {
            return 1.0;
        };
        let chance = 1.0 + CHANCE_SIGMAS * (2.0 / self.noise_here.1).sqrt();
        let beyond = (1.0 - chance * usual / own).max(0.0);
        1.0 + (dust::alike_px(self.template.radius_px()) - 1.0) * beyond
    }
}
