//! Noise of the pixels, and the weights of a fit that follow from it.

use super::{Fitted, Localiser};
use crate::config::PixelNoise;
use crate::fit::{Pass, Weights};

/// Degrees of freedom of the noise in the smallest window that a frame may hold, 5 x 5 px.
const LEAST_FREEDOM: f64 = 8.0;
/// A fit explains the border if it leaves less than this share of its variance: chance and specks take off less.
const EXPLAINED: f64 = 0.3;

impl Localiser {
    /// Puts the noise about the bead into force: that of its own window, as far as the windows of the last fixes differ.
    pub(super) fn read_noise(&mut self) {
        self.noise_variance = Some(match self.config.noise {
            PixelNoise::Known { read_sd_grey, .. } => read_sd_grey * read_sd_grey,
            PixelNoise::Estimated => {
                let (variance, freedom) = self.crop.noise_variance(|_, _| 0.0);
                self.noise_here = (variance, freedom.max(LEAST_FREEDOM));
                self.noises.moderate(self.noise_here.0, self.noise_here.1)
            }
        });
    }

    /// Reads the noise off the residual of a fit if the bead makes most of the differences along the border: a bead that reaches the
    /// border is no noise. A window that is not whole has the bead on its border, and no noise of its own. It is read in place of that
    /// of the last whole one, which may have a speck there: the smaller of the two is the likelier.
    pub(super) fn explain_noise(&mut self, f: Option<&Fitted>, is_whole: bool) {
        let most = if is_whole { EXPLAINED } else { 1.0 };
        if let (PixelNoise::Estimated, Some(f)) = (self.config.noise, f) {
            let (variance, freedom) = self.noise_left_by(f);
            let left = (variance, freedom.max(LEAST_FREEDOM));
            let less = if left.0 < most * self.noise_here.0 {
                left
            } else {
                self.noise_here
            };
            self.noise_variance = Some(self.noises.moderate(less.0, less.1));
            if is_whole {
                self.noise_here = less;
            }
        }
    }

    /// Reads the noise of a window anew from which a speck's light was taken off.
    pub(super) fn read_noise_beside(&mut self, f: &Fitted) {
        if let PixelNoise::Estimated = self.config.noise {
            let (variance, freedom) = self.noise_left_by(f);
            self.noise_here = (variance, freedom.max(LEAST_FREEDOM));
            self.noise_variance = Some(self.noises.moderate(variance, self.noise_here.1));
        }
    }

    /// Noise variance that the last windows had in common, grey^2; `None` if the noise is known or no window was seen.
    pub(super) fn usual_noise(&self) -> Option<f64> {
        match self.config.noise {
            PixelNoise::Estimated => self.noises.common(),
            PixelNoise::Known { .. } => None,
        }
    }

    /// Noise variance of a fit's residual along the border, and its degrees of freedom.
    fn noise_left_by(&self, f: &Fitted) -> (f64, f64) {
        let x = (f.x_px - self.crop.x0 as f64) as f32;
        let y = (f.y_px - self.crop.y0 as f64) as f32;
        let amplitude = f.pass.amplitude as f32;
        self.crop.noise_variance(|j, i| {
            let (dx, dy) = (i as f32 - x, j as f32 - y);
            amplitude * self.template.value_at_squared(dx * dx + dy * dy)
        })
    }

    /// Takes in the noise of the window at hand, whatever the verdict: a noise that is thought too large would never be corrected by fixes
    /// that it makes none.
    pub(super) fn keep_noise(&mut self) {
        if let PixelNoise::Estimated = self.config.noise {
            self.noises.take_in(self.noise_here.0, self.noise_here.1);
        }
    }

    /// Weights for the next pass, given what the pass before found: relative to [`Localiser::weight_unit`].
    pub(super) fn weights(&self, before: Option<&Pass>) -> Weights {
        self.weights_of(before.map(|p| (p.amplitude, p.background)))
    }

    /// The same, given the contrast that the model's values are multiplied by and the background.
    pub(super) fn weights_of(&self, before: Option<(f64, f64)>) -> Weights {
        match (self.config.noise, before) {
            (
                PixelNoise::Known {
                    read_sd_grey,
                    shot_grey_per_electron: gain,
                    black_level_grey: black,
                },
                Some((amplitude, background)),
            ) if gain > 0.0 => {
                let variance = read_sd_grey * read_sd_grey;
                let light = background + f64::from(self.crop.pedestal) - black;
                Weights::Shot {
                    base: (variance + gain * light.max(0.0)) as f32,
                    gain_times_amplitude: (gain * amplitude) as f32,
                    floor: variance as f32,
                }
            }
            _ => Weights::Even { variance: 1.0 },
        }
    }

    /// Noise variance that a weight of 1 stands for: even weights are relative, those with shot noise absolute.
    pub(super) fn weight_unit(&self) -> f64 {
        match self.config.noise {
            PixelNoise::Known {
                shot_grey_per_electron,
                ..
            } if shot_grey_per_electron > 0.0 => 1.0,
            _ => self.noise_variance.unwrap_or(1.0),
        }
    }

    /// Noise variance of a pixel at a grey level, grey^2.
    pub(super) fn pixel_variance(&self, grey: f64) -> f64 {
        let shot = match self.config.noise {
            PixelNoise::Known {
                shot_grey_per_electron: gain,
                black_level_grey: black,
                ..
            } => gain * (grey - black).max(0.0),
            PixelNoise::Estimated => 0.0,
        };
        self.noise_variance.unwrap_or(1.0) + shot
    }
}
