//! Settings of the localiser: made once, checked once, never changed while frames run.

use crate::template::{PixelResponse, ProfileSpec, Template};
use serde::{Deserialize, Serialize};

/// Largest side of the fitted window, px. The buffers are of fixed size.
pub const MAX_WINDOW_PX: usize = 191;

/// Noise of one pixel, grey levels.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum PixelNoise {
    /// The same in every pixel of a window, measured on its border; where the windows of the last fixes agree, from all of them.
    #[default]
    Estimated,
    /// Known: variance `read_sd_grey^2 + shot_grey_per_electron * (grey - black_level_grey)`.
    Known {
        /// Standard deviation without light, grey levels.
        read_sd_grey: f64,
        /// Grey levels per photo-electron; 0 for no shot noise.
        #[serde(default)]
        shot_grey_per_electron: f64,
        /// Grey level without light.
        #[serde(default)]
        black_level_grey: f64,
    },
}

/// Whether beads have a core brighter or darker than the background.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Polarity {
    /// Core brighter than the background.
    #[default]
    Bright,
    /// Core darker than the background.
    Dark,
}

impl Polarity {
    /// 1 for bright cores, -1 for dark ones.
    pub fn sign(self) -> f64 {
        match self {
            Polarity::Bright => 1.0,
            Polarity::Dark => -1.0,
        }
    }
}

/// Learning of the template from the beads themselves.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Learning {
    /// Good fixes averaged into the first learnt template, 5 or more.
    #[serde(default = "defaults::first_fixes")]
    pub first_fixes: u32,
    /// Good fixes between refreshes after that; 0 for no refresh.
    #[serde(default = "defaults::refresh_fixes")]
    pub refresh_fixes: u32,
    /// Largest change of the profile from the configured one that the first template may bring, and a quarter of it the
    /// largest drift by refreshes: RMS over the window, as a fraction of the amplitude. A larger one is refused. Until the first template is
    /// taken, a residual up to this is tolerated in place of `template_tolerance`.
    #[serde(default = "defaults::max_change")]
    pub max_change: f64,
}

impl Default for Learning {
    fn default() -> Self {
        Learning {
            first_fixes: defaults::first_fixes(),
            refresh_fixes: defaults::refresh_fixes(),
            max_change: defaults::max_change(),
        }
    }
}

/// Settings of a [`crate::Localiser`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LocaliserConfig {
    /// Profile of the bead.
    pub profile: ProfileSpec,
    /// Side of the square window fitted, px: odd, 7 to 191, wide enough for the whole ring.
    pub window_px: usize,
    /// Core brighter or darker than the background.
    #[serde(default)]
    pub polarity: Polarity,
    /// What a pixel reads of the profile.
    #[serde(default)]
    pub pixel_response: PixelResponse,
    /// Noise of a pixel.
    #[serde(default)]
    pub noise: PixelNoise,
    /// Peak contrast over the noise of a pixel below which there is no signal.
    #[serde(default = "defaults::min_snr")]
    pub min_snr: f64,
    /// Residual variance over noise variance above which the fit is bad ...
    #[serde(default = "defaults::max_residual_ratio")]
    pub max_residual_ratio: f64,
    /// ... unless the residual is explained by a template wrong by this fraction of the amplitude (RMS over the window).
    #[serde(default = "defaults::template_tolerance")]
    pub template_tolerance: f64,
    /// Passes over the window after which the fit counts as not converged, 3 to 50.
    #[serde(default = "defaults::max_passes")]
    pub max_passes: u32,
    /// Learn the template from the first good fixes and refresh it; left out: the configured profile stays.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub learning: Option<Learning>,
}

mod defaults {
    pub(super) fn min_snr() -> f64 {
        3.0
    }
    pub(super) fn max_residual_ratio() -> f64 {
        1.5
    }
    pub(super) fn template_tolerance() -> f64 {
        0.06
    }
    pub(super) fn first_fixes() -> u32 {
        50
    }
    pub(super) fn refresh_fixes() -> u32 {
        5000
    }
    pub(super) fn max_change() -> f64 {
        0.2
    }
    pub(super) fn max_passes() -> u32 {
        12
    }
}

/// A setting that cannot be used.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[error("{key} = {value}: must be {must_be}")]
pub struct ConfigError {
    /// Name of the setting.
    pub key: &'static str,
    /// Its value.
    pub value: f64,
    /// What would be right, with the unit.
    pub must_be: &'static str,
}

impl ConfigError {
    /// Refuses a setting unless `ok`.
    pub(crate) fn unless(
        ok: bool,
        key: &'static str,
        value: f64,
        must_be: &'static str,
    ) -> Result<(), Self> {
        if ok {
            Ok(())
        } else {
            Err(Self {
                key,
                value,
                must_be,
            })
        }
    }
}

impl LocaliserConfig {
    /// Default settings for a profile: the smallest odd window that holds the bead and its ring, at least 15 px.
    pub fn new(profile: ProfileSpec) -> Self {
        // The dark ring of a bead ends at 1.85 edge radii; four standard deviations hold a Gaussian.
        let reach_px = match profile {
            ProfileSpec::Ring { edge_px } => 1.85 * edge_px,
            ProfileSpec::Gaussian { sigma_px } => 4.0 * sigma_px,
            ProfileSpec::Table { radius_px, .. } => 1.85 * radius_px,
        };
        let window_px = (2 * reach_px.ceil() as usize + 1).clamp(15, MAX_WINDOW_PX);
        LocaliserConfig {
            profile,
            window_px,
            polarity: Polarity::default(),
            pixel_response: PixelResponse::default(),
            noise: PixelNoise::default(),
            min_snr: defaults::min_snr(),
            max_residual_ratio: defaults::max_residual_ratio(),
            template_tolerance: defaults::template_tolerance(),
            max_passes: defaults::max_passes(),
            learning: None,
        }
    }

    /// Checks every setting and tabulates the profile.
    ///
    /// # Errors
    /// Names the first setting that cannot be used.
    pub fn template(&self) -> Result<Template, ConfigError> {
        let (key, size_px) = self.check_size()?;
        self.check_limits()?;
        self.learning.as_ref().map_or(Ok(()), Learning::check)?;
        self.noise.check()?;
        let refused = ConfigError {
            key,
            value: size_px,
            must_be: "a finite size above 0 px",
        };
        self.profile.template(self.pixel_response).ok_or(refused)
    }

    /// The profile's key and size, where size and window go together.
    fn check_size(&self) -> Result<(&'static str, f64), ConfigError> {
        let check = ConfigError::unless;
        let (key, size_px) = match self.profile {
            ProfileSpec::Ring { edge_px } => ("profile.edge_px", edge_px),
            ProfileSpec::Gaussian { sigma_px } => ("profile.sigma_px", sigma_px),
            ProfileSpec::Table { radius_px, .. } => ("profile.radius_px", radius_px),
        };
        check(
            (0.5..=1000.0).contains(&size_px),
            key,
            size_px,
            "between 0.5 and 1000 px",
        )?;
        let side_ok = (7..=MAX_WINDOW_PX).contains(&self.window_px) && self.window_px % 2 == 1;
        check(
            side_ok,
            "window_px",
            self.window_px as f64,
            "an odd number of pixels from 7 to 191",
        )?;
        let wide_enough = self.window_px as f64 >= 2.0 * size_px;
        check(
            wide_enough,
            "window_px",
            self.window_px as f64,
            "at least as wide as the bead, in px",
        )?;
        Ok((key, size_px))
    }

    fn check_limits(&self) -> Result<(), ConfigError> {
        let check = ConfigError::unless;
        check(
            at_least(self.min_snr, 1.0),
            "min_snr",
            self.min_snr,
            "1 or more",
        )?;
        check(
            at_least(self.max_residual_ratio, 1.0),
            "max_residual_ratio",
            self.max_residual_ratio,
            "1 or more",
        )?;
        let tolerance = self.template_tolerance;
        check(
            (0.0..1.0).contains(&tolerance),
            "template_tolerance",
            tolerance,
            "a fraction from 0 to below 1",
        )?;
        let passes = self.max_passes;
        check(
            (3..=50).contains(&passes),
            "max_passes",
            f64::from(passes),
            "between 3 and 50 passes",
        )
    }
}

impl Learning {
    fn check(&self) -> Result<(), ConfigError> {
        let check = ConfigError::unless;
        check(
            self.first_fixes >= 5,
            "learning.first_fixes",
            f64::from(self.first_fixes),
            "5 fixes or more",
        )?;
        let allowed = self.max_change > 0.0 && self.max_change <= 0.5;
        check(
            allowed,
            "learning.max_change",
            self.max_change,
            "a fraction above 0, at most 0.5",
        )
    }
}

impl PixelNoise {
    fn check(&self) -> Result<(), ConfigError> {
        let check = ConfigError::unless;
        let PixelNoise::Known {
            read_sd_grey,
            shot_grey_per_electron: gain,
            black_level_grey,
        } = *self
        else {
            return Ok(());
        };
        let positive = read_sd_grey.is_finite() && read_sd_grey > 0.0;
        check(
            positive,
            "noise.read_sd_grey",
            read_sd_grey,
            "above 0 grey levels",
        )?;
        check(
            at_least(gain, 0.0),
            "noise.shot_grey_per_electron",
            gain,
            "0 grey levels per electron or more",
        )?;
        check(
            black_level_grey.is_finite(),
            "noise.black_level_grey",
            black_level_grey,
            "a finite grey level",
        )
    }
}

fn at_least(value: f64, low: f64) -> bool {
    value.is_finite() && value >= low
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn default_window_for_the_measured_bead_is_25_px() {
        assert_eq!(
            LocaliserConfig::new(ProfileSpec::Ring { edge_px: 6.373 }).window_px,
            25
        );
        assert_eq!(
            LocaliserConfig::new(ProfileSpec::Gaussian { sigma_px: 3.0 }).window_px,
            25
        );
    }

    #[test]
    fn every_bad_setting_is_refused_by_name() {
        let good = LocaliserConfig::new(ProfileSpec::Ring { edge_px: 5.0 });
        assert!(good.template().is_ok());
        let known = |read_sd_grey, shot_grey_per_electron, black_level_grey| PixelNoise::Known {
            read_sd_grey,
            shot_grey_per_electron,
            black_level_grey,
        };
        let cases = [
            (
                LocaliserConfig {
                    profile: ProfileSpec::Ring { edge_px: f64::NAN },
                    ..good.clone()
                },
                "profile.edge_px",
            ),
            (
                LocaliserConfig {
                    profile: ProfileSpec::Gaussian { sigma_px: 0.0 },
                    ..good.clone()
                },
                "profile.sigma_px",
            ),
            (
                LocaliserConfig {
                    window_px: 24,
                    ..good.clone()
                },
                "window_px",
            ),
            (
                LocaliserConfig {
                    window_px: 193,
                    ..good.clone()
                },
                "window_px",
            ),
            (
                LocaliserConfig {
                    window_px: 9,
                    ..good.clone()
                },
                "window_px",
            ),
            (
                LocaliserConfig {
                    min_snr: 0.0,
                    ..good.clone()
                },
                "min_snr",
            ),
            (
                LocaliserConfig {
                    max_residual_ratio: 0.5,
                    ..good.clone()
                },
                "max_residual_ratio",
            ),
            (
                LocaliserConfig {
                    template_tolerance: 1.0,
                    ..good.clone()
                },
                "template_tolerance",
            ),
            (
                LocaliserConfig {
                    max_passes: 1,
                    ..good.clone()
                },
                "max_passes",
            ),
            (
                LocaliserConfig {
                    noise: known(0.0, 0.0, 0.0),
                    ..good.clone()
                },
                "noise.read_sd_grey",
            ),
            (
                LocaliserConfig {
                    noise: known(1.0, -1.0, 0.0),
                    ..good.clone()
                },
                "noise.shot_grey_per_electron",
            ),
            (
                LocaliserConfig {
                    noise: known(1.0, 0.0, f64::NAN),
                    ..good.clone()
                },
                "noise.black_level_grey",
            ),
        ];
        for (config, key) in cases {
            assert_eq!(config.template().unwrap_err().key, key);
        }
    }
}
