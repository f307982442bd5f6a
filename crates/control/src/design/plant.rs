//! The part of a model that the design uses, and the warnings about the rest.

use crate::error::BuildError;
use crate::loop_model::LoopModel;
use cellpos_plant::effects::Action;
use cellpos_plant::{
    DiscretePlant, Hertz, Model, PlantError, ProbablyPerHertz, Seconds, TransferFunction,
    probably_per_hertz,
};
use thiserror::Error;

/// Something that the user must know about a design.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum DesignWarning {
    /// The gain is Eq. (5)'s 63, taken literally.
    #[error("{0}")]
    ProbablyPerHertz(ProbablyPerHertz),
    /// An effect of the model that the linear design does not contain.
    #[error(
        "the effect `{id}` of the model is not part of the linear design: check it with a simulation (`cellpos track --model`)"
    )]
    EffectLeftOut {
        /// Id of the effect.
        id: &'static str,
    },
    /// The loop delay was given and differs from what the model contains.
    #[error(
        "all figures are for the loop delay of {used_ms:.3} ms of the rig file or of --delay; the model's own effects make it {model_ms:.3} ms"
    )]
    DelayDiffers {
        /// Delay designed for, ms.
        used_ms: f64,
        /// Delay of the model's effects with the half sample of hold, ms.
        model_ms: f64,
    },
    /// Neither the model nor the caller states a delay.
    #[error(
        "no delay is given, neither by the model nor asked for: {assumed_ms} ms is assumed (2 ms camera path and half a sample of hold)"
    )]
    DelayAssumed {
        /// Assumed, ms.
        assumed_ms: f64,
    },
    /// A controller that cannot be stable at some point of the spread.
    #[error(
        "unstable at {gain_factor} x the gain with {extra_samples} more samples of delay: {why}"
    )]
    UnstableInSpread {
        /// Factor on the plant's gain.
        gain_factor: f64,
        /// Samples added to the delay.
        extra_samples: u32,
        /// Why.
        why: &'static str,
    },
    /// The predicted figures use a diffusion coefficient or localisation noise of zero.
    #[error("the model's {what} is 0: the predicted hold error and its bound leave it out")]
    NoNoise {
        /// Which one.
        what: &'static str,
    },
    /// The estimator of the running loop cannot hold this plant.
    #[error("figures of the running loop (step, disturbance) are left out: {0}")]
    NoLoop(BuildError),
}

/// A linear plant with a delay, discretised for the loop.
#[derive(Debug, Clone, PartialEq)]
pub struct DesignPlant {
    /// Plant with the model's linear lags.
    pub plant: TransferFunction,
    /// Camera path and other dead time, without the half sample of hold, s.
    pub delay_s: f64,
    /// Sample time, s.
    pub sample_time_s: f64,
    /// Diffusion coefficient, um^2/s.
    pub diffusion_um2_per_s: f64,
    /// Localisation noise, um RMS.
    pub fix_noise_um: f64,
    /// Displacement at which the bead rests, um.
    pub neutral_um: f64,
    /// What the user must know.
    pub warnings: Vec<DesignWarning>,
}

impl DesignPlant {
    /// The linear part of a model, for a loop delay that includes the half sample of hold. `None` takes the delay of the model's
    /// effects and of the camera path with which it was measured.
    ///
    /// # Errors
    /// Lags that make the plant's order too high.
    pub fn from_model(
        model: &Model,
        loop_delay_s: Option<f64>,
        sample_time_s: f64,
    ) -> Result<Self, PlantError> {
        let mut plant = model.plant.clone();
        let mut warnings = Vec::new();
        let mut dead_s = 0.0;
        for effect in model.ordered_effects() {
            match effect.act() {
                Action::Linear(zpk) if zpk.poles.is_empty() && zpk.zeros.is_empty() => {
                    plant = plant.scaled(zpk.gain)?;
                }
                // One pole is one pole, wherever it sits.
                Action::Linear(zpk) if zpk.zeros.is_empty() && zpk.poles.len() == 1 => {
                    let w = -zpk.poles[0].re;
                    plant = plant.series(&TransferFunction::new(
                        vec![zpk.gain / w],
                        vec![1.0 / w, 1.0],
                    )?)?;
                }
                Action::Delay(delay_s) => dead_s += delay_s,
                // Positions are those of mid-exposure: the average adds no delay to the nominal path.
                Action::Exposure(_) => {}
                // Constant drift and range do not change the linear loop; the step figures contain the range.
                Action::Block(_) if effect.id() == "flow-drift" => {}
                _ => warnings.push(DesignWarning::EffectLeftOut { id: effect.id() }),
            }
        }
        let hold_s = 0.5 * sample_time_s;
        let delay_s = match loop_delay_s {
            Some(t) => {
                if dead_s > 0.0 && (t - hold_s - dead_s).abs() > 1e-5 {
                    let model_ms = (dead_s + hold_s) * 1e3;
                    warnings.push(DesignWarning::DelayDiffers {
                        used_ms: t * 1e3,
                        model_ms,
                    });
                }
                t - hold_s
            }
            None => dead_s + model.camera_delay_s.unwrap_or(0.0),
        };
        if let Some(hint) = [1.0, 10.0]
            .iter()
            .find_map(|&f| probably_per_hertz(plant.velocity_gain_at(Hertz(f))))
        {
            warnings.push(DesignWarning::ProbablyPerHertz(hint));
        }
        if model.noise.diffusion_um2_per_s == 0.0 {
            warnings.push(DesignWarning::NoNoise {
                what: "diffusion coefficient",
            });
        }
        if model.noise.localisation_um == 0.0 {
            warnings.push(DesignWarning::NoNoise {
                what: "localisation noise",
            });
        }
        Ok(Self {
            plant,
            delay_s,
            sample_time_s,
            diffusion_um2_per_s: model.noise.diffusion_um2_per_s,
            fix_noise_um: model.noise.localisation_um,
            neutral_um: model.working_point_um,
            warnings,
        })
    }

    /// Eq. (6) with the noise of the rig's description, for a loop delay that includes the half sample of hold.
    pub fn eq6(loop_delay_s: f64) -> Self {
        Self {
            plant: TransferFunction::eq6(),
            delay_s: loop_delay_s - 0.5e-3,
            sample_time_s: 1e-3,
            diffusion_um2_per_s: 0.33,
            fix_noise_um: 0.020,
            neutral_um: 20.0,
            warnings: Vec::new(),
        }
    }

    /// The loop's delay with the half sample of hold, s.
    pub fn loop_delay_s(&self) -> f64 {
        self.delay_s + 0.5 * self.sample_time_s
    }

    /// The same with the gain multiplied and whole samples added to the delay.
    ///
    /// # Errors
    /// A factor of zero or one that is not finite.
    pub fn changed(&self, gain_factor: f64, extra_samples: u32) -> Result<Self, PlantError> {
        Ok(Self {
            plant: self.plant.scaled(gain_factor)?,
            delay_s: self.delay_s + f64::from(extra_samples) * self.sample_time_s,
            ..self.clone()
        })
    }

    /// The plant from command to measurement, delay included.
    ///
    /// # Errors
    /// A sample time or delay out of range.
    pub fn measured(&self) -> Result<DiscretePlant, PlantError> {
        DiscretePlant::new(
            &self.plant,
            Seconds(self.sample_time_s),
            Seconds(self.delay_s),
        )
    }

    /// The plant from command to true position.
    ///
    /// # Errors
    /// A sample time out of range.
    pub fn truth(&self) -> Result<DiscretePlant, PlantError> {
        DiscretePlant::new(&self.plant, Seconds(self.sample_time_s), Seconds(0.0))
    }

    /// The plant as the running loop's estimator sees it.
    ///
    /// # Errors
    /// No integrator, complex or unstable poles, too many modes.
    pub fn loop_model(&self) -> Result<LoopModel, BuildError> {
        LoopModel::from_transfer_function(&self.plant, self.delay_s, self.sample_time_s)
    }
}
