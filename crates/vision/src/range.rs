//! The range of settings, found by trying: beads of the template are drawn larger, smaller, blurred and in more noise, until the
//! localiser no longer finds nine in ten.

use crate::config::LocaliserConfig;
use crate::fix::FixQuality;
use crate::frame::{Frame, Pixels};
use crate::localiser::Localiser;
use cellpos_numeric::Random;

/// Beads of a trial, and the least number to be found.
const BEADS: usize = 20;
const FOUND: usize = 18;
/// Each range is tried with the same beads.
const SEED: u64 = 1;
/// Contrast and background of the beads drawn, grey levels.
const CONTRAST: f32 = 4000.0;
const BACKGROUND: f32 = 20_000.0;
/// Steps in which the range is tried, and the farthest that is asked for: size as a fraction, blur in radii of the bead, noise as a
/// factor.
const SIZE: (f64, f64) = (0.05, 0.5);
const BLUR: (f64, f64) = (0.1, 2.0);
const NOISE: (f64, f64) = (1.25, 20.0);

/// The range of settings: nine in ten beads are a good fix, each changed alone.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Range {
    /// Smallest and largest image of the bead, as another focus makes it, relative to the template.
    pub size: (f64, f64),
    /// Blur, px: standard deviation of a Gaussian.
    pub blur_px: f64,
    /// Contrast over the noise of a pixel down to which beads are found.
    pub snr: f64,
}

/// How a bead is drawn.
#[derive(Debug, Clone, Copy)]
struct Drawn {
    size: f64,
    blur_px: f64,
    snr: f64,
}

impl Range {
    /// The range of settings for beads of a contrast over the noise. `None` if they do not find such beads.
    pub fn of(config: &LocaliserConfig, snr: f64) -> Option<Self> {
        let radius_px = config.template().ok()?.radius_px();
        let own = Drawn {
            size: 1.0,
            blur_px: 0.0,
            snr,
        };
        let trial = Trial::new(config)?;
        if !trial.holds(own) {
            return None;
        }
        let farthest = |(step, most): (f64, f64), changed: &dyn Fn(f64) -> Drawn| {
            let count = (most / step).round() as usize;
            let amounts = (1..=count).map(|k| k as f64 * step);
            let held = amounts.take_while(|amount| trial.holds(changed(*amount)));
            held.last().unwrap_or(0.0)
        };
        let smaller = farthest(SIZE, &|by| Drawn {
            size: 1.0 - by,
            ..own
        });
        let larger = farthest(SIZE, &|by| Drawn {
            size: 1.0 + by,
            ..own
        });
        let blur = farthest(BLUR, &|radii| Drawn {
            blur_px: radii * radius_px,
            ..own
        });
        let steps = (1.0, (NOISE.1.ln() / NOISE.0.ln()).round());
        let noise = farthest(steps, &|step| Drawn {
            snr: snr / NOISE.0.powf(step),
            ..own
        });
        Some(Range {
            size: (1.0 - smaller, 1.0 + larger),
            blur_px: blur * radius_px,
            snr: snr / NOISE.0.powf(noise),
        })
    }
}

/// Draws beads and looks for them.
struct Trial {
    config: LocaliserConfig,
    side: usize,
    beads: Vec<Bead>,
}

/// Where a bead is drawn and looked for, and the noise about it: the same in every trial, so that only what is changed decides.
struct Bead {
    place: (f64, f64),
    guess: (f64, f64),
    /// Standard normal deviates, one for each pixel.
    noise: Vec<f32>,
}

impl Trial {
    fn new(config: &LocaliserConfig) -> Option<Self> {
        let mut config = config.clone();
        config.learning = None;
        // Grey levels of a camera that was calibrated are not those drawn here.
        config.noise = crate::PixelNoise::Estimated;
        let side = 2 * config.window_px + 5;
        if side >= 1000 {
            return None;
        }
        let mut random = Random::new(SEED);
        let middle = 0.5 * (side - 1) as f64;
        let bead = |_| {
            let place = within_a_pixel(&mut random, (middle, middle));
            let noise = (0..side * side).map(|_| random.normal() as f32).collect();
            Bead {
                place,
                noise,
                // As a loop that expects the bead to within a pixel.
                guess: within_a_pixel(&mut random, place),
            }
        };
        Some(Trial {
            config,
            side,
            beads: (0..BEADS).map(bead).collect(),
        })
    }

    fn holds(&self, drawn: Drawn) -> bool {
        let Ok(mut localiser) = Localiser::new(self.config.clone()) else {
            return false;
        };
        let mut missed = 0;
        for bead in &self.beads {
            let pixels = self.picture(&localiser, bead, drawn);
            let frame = Frame {
                width: self.side,
                height: self.side,
                pixels: Pixels::Mono16(&pixels),
            };
            let fix = localiser.locate(&frame, Some(bead.guess));
            let off_px = f64::hypot(fix.x_px - bead.place.0, fix.y_px - bead.place.1);
            let near = off_px < 0.5 * localiser.template().radius_px();
            missed += usize::from(fix.verdict != FixQuality::Good || !near);
            if missed > BEADS - FOUND {
                return false;
            }
        }
        true
    }

    fn picture(&self, localiser: &Localiser, bead: &Bead, drawn: Drawn) -> Vec<u16> {
        let (side, template, (x, y)) = (self.side, localiser.template(), bead.place);
        let contrast = CONTRAST * localiser.sign() as f32;
        let mut light: Vec<f32> = (0..side * side)
            .map(|k| {
                let (dx, dy) = ((k % side) as f64 - x, (k / side) as f64 - y);
                let r2 = (dx * dx + dy * dy) / (drawn.size * drawn.size);
                contrast * template.value_at_squared(r2 as f32)
            })
            .collect();
        if drawn.blur_px > 0.0 {
            blur(&mut light, side, drawn.blur_px);
        }
        let noise = CONTRAST / drawn.snr as f32;
        (light.iter().zip(&bead.noise))
            .map(|(v, deviate)| (BACKGROUND + v + noise * deviate).round() as u16)
            .collect()
    }
}

/// A place less than half a pixel from another, along each axis.
fn within_a_pixel(random: &mut Random, (x, y): (f64, f64)) -> (f64, f64) {
    (x + random.uniform() - 0.5, y + random.uniform() - 0.5)
}

/// Blurs a square picture with nothing beyond its border by a Gaussian.
fn blur(light: &mut [f32], side: usize, sd_px: f64) {
    let reach = (3.0 * sd_px).ceil() as usize;
    let weight = |d: usize| (-0.5 * (d as f64 / sd_px).powi(2)).exp() as f32;
    let weights: Vec<f32> = (0..=reach).map(weight).collect();
    let sum = 2.0 * weights.iter().skip(1).sum::<f32>() + 1.0;
    let mut line = vec![0.0_f32; side];
    for (along, across) in [(1, side), (side, 1)] {
        for k in 0..side {
            for (n, v) in line.iter_mut().enumerate() {
                *v = light[k * across + n * along];
            }
            for n in 0..side {
                let near = n.saturating_sub(reach)..(n + reach + 1).min(side);
                let mean: f32 = near.map(|m| weights[m.abs_diff(n)] * line[m]).sum();
                light[k * across + n * along] = mean / sum;
            }
        }
    }
}
