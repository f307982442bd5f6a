//! Position of one bead in a frame: seed, template fit, covariance, verdict.

use crate::config::{ConfigError, LocaliserConfig, Noise, Polarity};
use crate::crop::Crop;
use crate::fit::{self, Pass, Weights};
use crate::fix::{Fix, Verdict};
use crate::frame::Frame;
use crate::profile::Template;
use crate::seed;

/// A step below this ends the fit, px: what is left after it is of second order in it.
const CONVERGED_PX: f64 = 0.01;
/// Windows centred further than this from the fit are taken anew, px.
const RECENTRE_PX: f64 = 1.0;
/// How often the window may be taken anew.
const MAX_RECENTRES: u32 = 4;
/// Share of a new frame in the running noise estimate.
const NOISE_FORGETTING: f64 = 1.0 / 64.0;
/// Variance of rounding to whole grey levels, grey^2: the least that a pixel's noise can be.
const ROUNDING_VARIANCE: f64 = 1.0 / 12.0;

/// Localises one bead per call. Buffers are made in [`Localiser::new`]; [`Localiser::locate`] allocates nothing.
///
/// The position is the weighted least-squares fit of the template over the whole window in four parameters (x, y,
/// amplitude, background), which reaches the Cramer-Rao bound; the covariance is that bound.
#[derive(Debug, Clone)]
pub struct Localiser {
    config: LocaliserConfig,
    template: Template,
    crop: Crop,
    sign: f64,
    /// Running noise variance of a pixel, grey^2; `None` before the first frame.
    noise_variance: Option<f64>,
}

/// A fit at rest or given up.
struct Fitted {
    x_px: f64,
    y_px: f64,
    pass: Pass,
    converged: bool,
}

impl Localiser {
    /// Makes the buffers and the template.
    ///
    /// # Errors
    /// Names the first setting that cannot be used.
    pub fn new(config: LocaliserConfig) -> Result<Self, ConfigError> {
        let template = config.template()?;
        Ok(Self::with_template(config, template))
    }

    /// The settings.
    pub fn config(&self) -> &LocaliserConfig {
        &self.config
    }

    /// The template in use.
    pub fn template(&self) -> &Template {
        &self.template
    }

    /// Noise variance of a pixel in use at the background, grey^2; `None` before the first frame.
    pub fn noise_variance(&self) -> Option<f64> {
        self.noise_variance
    }

    fn with_template(config: LocaliserConfig, template: Template) -> Self {
        let sign = match config.polarity {
            Polarity::Bright => 1.0,
            Polarity::Dark => -1.0,
        };
        Localiser {
            config,
            template,
            crop: Crop::new(),
            sign,
            noise_variance: None,
        }
    }

    /// Position of the bead nearest to `guess` (px), or of the strongest in the frame when there is no guess.
    ///
    /// A fix whose verdict is not [`Verdict::Good`] carries what was found, for the record; it must not be used as a
    /// position.
    pub fn locate(&mut self, frame: &Frame, guess: Option<(f64, f64)>) -> Fix {
        let start = match guess {
            Some(g) => Some(g),
            None => seed::strongest(
                frame,
                self.sign,
                self.template.radius_px(),
                self.config.min_snr,
            ),
        };
        let Some((x_px, y_px)) = start else {
            return Fix::none(0.0, 0.0, Verdict::NoSignal);
        };
        if !self.crop.take(frame, x_px, y_px, self.config.window_px) {
            return Fix::none(x_px, y_px, Verdict::AtBorder);
        }
        self.update_noise();
        let first = self.fit(frame, x_px, y_px);
        let fix = self.judge(frame, first, (x_px, y_px));
        if matches!(fix.verdict, Verdict::Good | Verdict::AtBorder) {
            return fix;
        }
        // The guess may have been out of the fit's reach: once more from the centroid.
        if !self.crop.take(frame, x_px, y_px, self.config.window_px) {
            return fix;
        }
        let Some((cx_px, cy_px)) = self
            .crop
            .centroid(self.sign as f32, self.template.radius_px())
        else {
            return fix;
        };
        let second = self.fit(frame, cx_px, cy_px);
        let again = self.judge(frame, second, (x_px, y_px));
        if matches!(again.verdict, Verdict::Good | Verdict::AtBorder) {
            again
        } else {
            fix
        }
    }

    fn update_noise(&mut self) {
        self.noise_variance = Some(match self.config.noise {
            Noise::Known { read_sd_grey, .. } => read_sd_grey * read_sd_grey,
            Noise::Estimated => {
                let now = self.crop.noise_variance().max(ROUNDING_VARIANCE);
                match self.noise_variance {
                    Some(before) => before + NOISE_FORGETTING * (now - before),
                    None => now,
                }
            }
        });
    }

    /// Weights for the next pass, given what the pass before found.
    fn weights(&self, before: Option<&Pass>) -> Weights {
        let variance = self.noise_variance.unwrap_or(1.0);
        match (self.config.noise, before) {
            (
                Noise::Known {
                    shot_grey_per_electron: gain,
                    black_level_grey: black,
                    ..
                },
                Some(p),
            ) if gain > 0.0 => {
                let light = p.background + f64::from(self.crop.pedestal) - black;
                Weights::Shot {
                    base: (variance + gain * light.max(0.0)) as f32,
                    gain_times_amplitude: (gain * p.amplitude) as f32,
                    floor: variance as f32,
                }
            }
            _ => Weights::Even {
                variance: variance as f32,
            },
        }
    }

    fn fit(&mut self, frame: &Frame, x_px: f64, y_px: f64) -> Option<Fitted> {
        let shot = matches!(self.config.noise, Noise::Known { shot_grey_per_electron, .. } if shot_grey_per_electron > 0.0);
        let reach_px = 0.4 * self.template.radius_px();
        let (mut x_px, mut y_px) = (x_px, y_px);
        let mut before: Option<Pass> = None;
        let mut recentres = 0;
        for n in 1..=self.config.max_passes {
            let pass = fit::pass(
                &self.crop,
                &self.template,
                x_px,
                y_px,
                self.weights(before.as_ref()),
            )?;
            let length = f64::hypot(pass.step_x_px, pass.step_y_px);
            // Steps are kept within the template's range of attraction.
            let scale = if length > reach_px {
                reach_px / length
            } else {
                1.0
            };
            x_px += scale * pass.step_x_px;
            y_px += scale * pass.step_y_px;
            // Weights from the model need a model: the first pass has none.
            let at_rest = length < CONVERGED_PX && (n > 1 || !shot);
            before = Some(pass);
            let off_centre = f64::max(
                (x_px - self.crop.x0 as f64 - (self.crop.width as f64 - 1.0) / 2.0).abs(),
                (y_px - self.crop.y0 as f64 - (self.crop.height as f64 - 1.0) / 2.0).abs(),
            );
            if off_centre > RECENTRE_PX && recentres < MAX_RECENTRES {
                let (x0, y0) = (self.crop.x0, self.crop.y0);
                if !self.crop.take(frame, x_px, y_px, self.config.window_px) {
                    return Some(Fitted {
                        x_px,
                        y_px,
                        pass,
                        converged: false,
                    });
                }
                recentres += 1;
                if (x0, y0) != (self.crop.x0, self.crop.y0) {
                    continue;
                }
            }
            if at_rest {
                return Some(Fitted {
                    x_px,
                    y_px,
                    pass,
                    converged: true,
                });
            }
        }
        before.map(|pass| Fitted {
            x_px,
            y_px,
            pass,
            converged: false,
        })
    }

    fn judge(&self, frame: &Frame, fitted: Option<Fitted>, guess: (f64, f64)) -> Fix {
        let Some(f) = fitted else {
            return Fix::none(guess.0, guess.1, Verdict::NoSignal);
        };
        let amplitude = f.pass.amplitude;
        let background = f.pass.background + f64::from(self.crop.pedestal);
        let pixels = (self.crop.width * self.crop.height) as f64;
        let residual_ratio = f.pass.chi2.max(0.0) / (pixels - 4.0);
        let variance = match self.weights(Some(&f.pass)) {
            Weights::Even { variance } => f64::from(variance),
            Weights::Shot { base, .. } => f64::from(base),
        };
        let snr = self.sign * amplitude / variance.sqrt();
        let tolerated =
            self.config.max_residual_ratio + (self.config.template_tolerance * snr).powi(2);
        let margin_px = self.template.radius_px();
        let inside = |c: f64, len: usize| c >= margin_px && c <= len as f64 - 1.0 - margin_px;
        let in_window =
            |c: f64, first: usize, len: usize| c >= first as f64 && c <= (first + len - 1) as f64;
        let kept = in_window(f.x_px, self.crop.x0, self.crop.width)
            && in_window(f.y_px, self.crop.y0, self.crop.height);
        let verdict = if snr < self.config.min_snr {
            Verdict::NoSignal
        } else if !f.converged || !kept {
            Verdict::NotConverged
        } else if residual_ratio > tolerated {
            Verdict::BadFit
        } else if !inside(f.x_px, frame.width) || !inside(f.y_px, frame.height) {
            Verdict::AtBorder
        } else {
            Verdict::Good
        };
        Fix {
            x_px: f.x_px,
            y_px: f.y_px,
            var_x_px2: f.pass.covariance[(0, 0)],
            var_y_px2: f.pass.covariance[(1, 1)],
            cov_xy_px2: f.pass.covariance[(0, 1)],
            amplitude,
            background,
            residual_ratio,
            snr,
            verdict,
        }
    }
}
