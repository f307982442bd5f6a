//! The camera's part of a model: from a position to a frame's value.

use crate::chain::{ChainError, in_range};
use crate::effects::{Action, Shown};
use crate::model::Model;
use cellpos_numeric::Random;

/// The camera's part of a model.
#[derive(Debug, Clone)]
pub(super) struct Camera {
    pub(super) delay_s: f64,
    pub(super) exposure_s: f64,
    /// `t' = (1 + skew) t`.
    pub(super) skew: f64,
    /// Effects of light, table and sensor on a position.
    pub(super) shown: Vec<Box<dyn Shown>>,
    pub(super) localisation_um: f64,
    pub(super) noise: Option<Random>,
}

impl Camera {
    pub(super) fn new(model: &Model, seed: Option<u64>) -> Result<Self, ChainError> {
        let most = match model.is_in_any_unit() {
            true => f64::MAX,
            false => 100.0,
        };
        let localisation_um = model.noise.localisation_um;
        in_range("localisation_um", localisation_um, "um", 0.0, most)?;
        let mut camera = Self {
            delay_s: 0.0,
            exposure_s: 0.0,
            skew: 0.0,
            shown: Vec::new(),
            localisation_um,
            // A separate stream, so that the Brownian path does not depend on the camera.
            noise: seed.map(|s| Random::new(s ^ 0x9e37_79b9_7f4a_7c15)),
        };
        let mut exposures = 0;
        for effect in model.ordered_effects() {
            match effect.act() {
                Action::Delay(s) => camera.delay_s += s,
                Action::Exposure(s) => {
                    camera.exposure_s = s;
                    exposures += 1;
                }
                Action::Skew(e) => camera.skew += e,
                Action::Show(mut shown) => {
                    if let Some(seed) = seed {
                        shown.seed(seed ^ 0xd1b5_4a32_d192_ed03);
                    }
                    camera.shown.push(shown);
                }
                _ => {}
            }
        }
        if exposures > 1 {
            return Err(ChainError::Repeated {
                id: "exposure-averaging",
            });
        }
        Ok(camera)
    }

    /// From the position that the frame saw to the recorded one.
    pub(super) fn record(&mut self, seen_um: f64, time_s: f64) -> f64 {
        let mut y = seen_um;
        for shown in &mut self.shown {
            y = shown.show(y, time_s);
        }
        if let Some(noise) = &mut self.noise {
            y += self.localisation_um * noise.normal();
        }
        y
    }
}
