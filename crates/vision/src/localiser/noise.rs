//! Noise of the pixels, and the weights of a fit that follow from it.

use super::Localiser;
use crate::config::PixelNoise;
use crate::fit::{Pass, Weights};

/// Share of a new frame in the running noise estimate.
const NOISE_FORGETTING: f64 = 1.0 / 64.0;
/// Variance of rounding to whole grey levels, grey^2: the least that a pixel's noise can be.
const ROUNDING_VARIANCE: f64 = 1.0 / 12.0;

impl Localiser {
    pub(super) fn update_noise(&mut self) {
        self.noise_variance = Some(match self.config.noise {
            PixelNoise::Known { read_sd_grey, .. } => read_sd_grey * read_sd_grey,
            PixelNoise::Estimated => {
                let now = self.crop.noise_variance().max(ROUNDING_VARIANCE);
                match self.noise_variance {
                    Some(before) => before + NOISE_FORGETTING * (now - before),
                    None => now,
                }
            }
        });
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
