//! The whole design in one call: what `cellpos design` prints.

use crate::controller::{Controller, ControllerConfig, LoopConfig};
use crate::design::bound::{bound_rms_of_path_um, bound_rms_um};
use crate::design::margins::{Margins, margins};
use crate::design::noise::{NoiseFigures, noise_figures};
use crate::design::plant::{DesignPlant, DesignWarning};
use crate::design::search::{PiSearch, search_pi};
use crate::design::spread::{SpreadRow, spread};
use crate::design::step::{
    DisturbanceFigures, SetUpError, StepFigures, disturbance_figures, step_figures,
};
use crate::error::{BuildError, check};
use crate::estimator::EstimatorConfig;
use crate::limits::Limits;
use crate::linear::LinearLaw;
use crate::pi::{Lead, Pi};
use crate::toml_file::{self, ConfigError, TomlFile};
use cellpos_plant::PlantError;
use serde::Deserialize;
use thiserror::Error;

/// Longest delay that is designed for, samples: twice what the running loop's estimator reaches back. The work grows with its
/// cube.
const LONGEST_DELAY: f64 = 2.0 * crate::estimator::HISTORY as f64;

/// Why a design is not possible.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum DesignError {
    /// The plant cannot be discretised.
    #[error(transparent)]
    Plant(#[from] PlantError),
    /// The controller cannot be built.
    #[error(transparent)]
    Build(#[from] BuildError),
    /// The delay is shorter than the half sample of hold that it contains.
    #[error(
        "delay {delay_ms} ms is below {hold_ms} ms: the loop delay contains half a sample of hold (camera path 2 ms: write 2.5ms)"
    )]
    DelayBelowHold {
        /// Given, ms.
        delay_ms: f64,
        /// Half a sample, ms.
        hold_ms: f64,
    },
    /// The delay is longer than any loop of this program reaches back.
    #[error(
        "delay {delay_ms} ms is more than {most} samples of {sample_ms} ms: no loop reaches back so far; shorten the camera path, or \
         sample more slowly"
    )]
    DelayTooLong {
        /// Given, ms.
        delay_ms: f64,
        /// Sample time, ms.
        sample_ms: f64,
        /// Samples that are designed for.
        most: f64,
    },
    /// No gains keep the limits.
    #[error(
        "no gains keep Ms <= {max_ms} and Mt <= {max_mt} at this delay: allow more, or shorten the delay"
    )]
    NoGains {
        /// Limit on Ms.
        max_ms: f64,
        /// Limit on Mt.
        max_mt: f64,
    },
}

impl From<SetUpError> for DesignError {
    fn from(error: SetUpError) -> Self {
        match error {
            SetUpError::Plant(e) => Self::Plant(e),
            SetUpError::Loop(e) => Self::Build(e),
        }
    }
}

/// Limits that a design must keep; a missing one is not checked. Also the form of a limits file.
#[derive(Debug, Clone, Copy, PartialEq, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DesignLimits {
    /// Largest peak of S.
    pub max_ms: Option<f64>,
    /// Largest peak of T.
    pub max_mt: Option<f64>,
    /// Smallest phase margin, deg.
    pub min_pm_deg: Option<f64>,
    /// Smallest gain margin, dB.
    pub min_gm_db: Option<f64>,
    /// Smallest delay margin, ms.
    pub min_delay_margin_ms: Option<f64>,
    /// Largest predicted hold error, nm RMS.
    pub max_rms_nm: Option<f64>,
    /// Largest overshoot of a 10 um step, percent.
    pub max_overshoot_percent: Option<f64>,
    /// Longest settling of a 10 um step to 5 %, ms.
    pub max_settling_ms: Option<f64>,
    /// Whether every point of the spread must be stable.
    pub stable_over_spread: Option<bool>,
}

impl DesignLimits {
    /// Reads a limits file.
    ///
    /// # Errors
    /// A file that cannot be read, text that is not TOML, unknown keys, wrong types, a number that is not positive.
    pub fn load(path: &std::path::Path) -> Result<Self, ConfigError> {
        toml_file::load(path)
    }
}

impl TomlFile for DesignLimits {
    fn check_values(&self) -> Result<(), BuildError> {
        let values = [
            ("max_ms", "", self.max_ms),
            ("max_mt", "", self.max_mt),
            ("min_pm_deg", "deg", self.min_pm_deg),
            ("min_gm_db", "dB", self.min_gm_db),
            ("min_delay_margin_ms", "ms", self.min_delay_margin_ms),
            ("max_rms_nm", "nm", self.max_rms_nm),
            ("max_overshoot_percent", "%", self.max_overshoot_percent),
            ("max_settling_ms", "ms", self.max_settling_ms),
        ];
        values.into_iter().try_for_each(|(name, unit, value)| {
            value.map_or(Ok(()), |value| {
                check(name, unit, value, value > 0.0, "positive")
            })
        })
    }
}

/// A limit that a design breaks.
#[derive(Debug, Clone, PartialEq, Error)]
#[error("{key}: {value} {unit} against the limit {limit} {unit}")]
pub struct BrokenLimit {
    /// Key of [`DesignLimits`], or `stable`.
    pub key: &'static str,
    /// Reached.
    pub value: f64,
    /// Allowed.
    pub limit: f64,
    /// Unit.
    pub unit: &'static str,
}

/// Which controller is wanted.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Requested {
    /// PI (with lead, if set) with these gains.
    Pi(Pi),
    /// LQG or MPC with these weights.
    Given(ControllerConfig),
    /// PI gains by [`search_pi`].
    SearchPi(PiSearch),
}

/// What to design.
#[derive(Debug, Clone, PartialEq)]
pub struct DesignRequest {
    /// Plant and delay.
    pub plant: DesignPlant,
    /// Controller.
    pub controller: Requested,
    /// Set-point weight, where not the default.
    pub setpoint_weight: Option<f64>,
    /// Limits of the command.
    pub command_limits: Limits,
    /// The estimator, where not the one for the plant's noise.
    pub estimator: Option<EstimatorConfig>,
    /// Limits of the design.
    pub limits: DesignLimits,
}

/// A design and its figures.
#[derive(Debug, Clone, PartialEq)]
pub struct DesignReport {
    /// The controller.
    pub controller: ControllerConfig,
    /// The whole loop, where the running loop can hold the plant.
    pub config: Option<LoopConfig>,
    /// Nominal margins.
    pub margins: Margins,
    /// Step of 10 um.
    pub step: Option<StepFigures>,
    /// Drift of 10 um/s.
    pub disturbance: Option<DisturbanceFigures>,
    /// Predicted hold error; `None` if unstable.
    pub noise: Option<NoiseFigures>,
    /// Minimum-variance bound on it, um.
    pub bound_rms_um: f64,
    /// Margins over the spread.
    pub spread: Vec<SpreadRow>,
    /// Broken limits.
    pub limits_broken: Vec<BrokenLimit>,
    /// What the user must know.
    pub warnings: Vec<DesignWarning>,
}

/// Designs or checks a controller.
///
/// # Errors
/// A plant or controller that cannot be built, or limits that no gains keep.
pub fn design(request: &DesignRequest) -> Result<DesignReport, DesignError> {
    let plant = &request.plant;
    if plant.delay_s.is_nan() || plant.delay_s < 0.0 {
        let hold_ms = 0.5e3 * plant.sample_time_s;
        return Err(DesignError::DelayBelowHold {
            delay_ms: plant.loop_delay_s() * 1e3,
            hold_ms,
        });
    }
    if plant.delay_s > LONGEST_DELAY * plant.sample_time_s {
        return Err(DesignError::DelayTooLong {
            delay_ms: plant.loop_delay_s() * 1e3,
            sample_ms: plant.sample_time_s * 1e3,
            most: LONGEST_DELAY,
        });
    }
    let pi = match request.controller {
        Requested::Pi(pi) => Some(pi),
        Requested::SearchPi(search) => {
            Some(search_pi(plant, search)?.ok_or(DesignError::NoGains {
                max_ms: search.max_ms,
                max_mt: search.max_mt,
            })?)
        }
        Requested::Given(_) => None,
    };
    let controller = match (pi, request.controller) {
        (Some(mut pi), _) => {
            pi.setpoint_weight = request.setpoint_weight.unwrap_or(pi.setpoint_weight);
            pi.validate()?;
            ControllerConfig::Pi(pi)
        }
        (None, Requested::Given(given)) => given,
        (None, _) => {
            return Err(DesignError::NoGains {
                max_ms: f64::NAN,
                max_mt: f64::NAN,
            });
        }
    };
    let estimator = request.estimator.unwrap_or_else(|| estimator_config(plant));
    let law = match controller {
        ControllerConfig::Pi(pi) => LinearLaw::Pi {
            pi,
            sample_time_s: plant.sample_time_s,
        },
        other => other.linear(&estimator, &plant.loop_model()?)?,
    };
    let mut warnings = plant.warnings.clone();
    let config = loop_config(
        plant,
        controller,
        estimator,
        request.command_limits,
        &mut warnings,
    );
    let (step, disturbance) = match &config {
        Some(config) => (
            Some(step_figures(plant, config, 10.0)?),
            Some(disturbance_figures(plant, config, 10.0)?),
        ),
        None => (None, None),
    };
    let spread = spread(plant, &law)?;
    for row in spread.iter().filter(|row| !row.margins.stable) {
        warnings.push(DesignWarning::UnstableInSpread {
            gain_factor: row.gain_factor,
            extra_samples: row.extra_samples,
            why: if row.extra_samples > 0 {
                "the delay margin does not hold the added sample at this gain"
            } else {
                "the gain margin does not hold this factor"
            },
        });
    }
    let mut report = DesignReport {
        controller,
        config,
        margins: margins(plant, &law)?,
        step,
        disturbance,
        noise: noise_figures(plant, &law)?,
        bound_rms_um: bound_um(plant),
        spread,
        limits_broken: Vec::new(),
        warnings,
    };
    report.limits_broken = broken(&report, &request.limits);
    Ok(report)
}

/// The bound of the path; of a plant that the loop cannot hold that of its delay.
fn bound_um(plant: &DesignPlant) -> f64 {
    let (diffusion, noise) = (plant.diffusion_um2_per_s, plant.fix_noise_um);
    match plant.loop_model() {
        Ok(model) => bound_rms_of_path_um(diffusion, noise, &model),
        Err(_) => bound_rms_um(diffusion, noise, plant.delay_s, plant.sample_time_s),
    }
}

fn loop_config(
    plant: &DesignPlant,
    controller: ControllerConfig,
    estimator: EstimatorConfig,
    limits: Limits,
    warnings: &mut Vec<DesignWarning>,
) -> Option<LoopConfig> {
    let built = plant.loop_model().and_then(|model| {
        let config = LoopConfig {
            model,
            estimator,
            controller,
            limits,
        };
        Controller::new(config).map(|_| config)
    });
    built
        .map_err(|error| warnings.push(DesignWarning::NoLoop(error)))
        .ok()
}

/// The estimator for a plant's noise.
pub(super) fn estimator_config(plant: &DesignPlant) -> EstimatorConfig {
    EstimatorConfig {
        diffusion_um2_per_s: positive_or(plant.diffusion_um2_per_s, 0.33),
        fix_noise_um: positive_or(plant.fix_noise_um, 0.020),
        ..EstimatorConfig::default()
    }
}

fn positive_or(value: f64, otherwise: f64) -> f64 {
    if value > 0.0 { value } else { otherwise }
}

fn broken(report: &DesignReport, limits: &DesignLimits) -> Vec<BrokenLimit> {
    let m = &report.margins;
    let mut broken = Vec::new();
    if !m.stable {
        broken.push(BrokenLimit {
            key: "stable",
            value: m.spectral_radius,
            limit: 1.0,
            unit: "(largest pole)",
        });
    }
    let mut most = |key, value: f64, limit: Option<f64>, unit| {
        // A figure that does not exist (NaN) does not keep its limit.
        if let Some(limit) = limit.filter(|&limit| value.is_nan() || value > limit) {
            broken.push(BrokenLimit {
                key,
                value,
                limit,
                unit,
            });
        }
    };
    most("max_ms", m.ms, limits.max_ms, "");
    most("max_mt", m.mt, limits.max_mt, "");
    most(
        "max_rms_nm",
        report.noise.map_or(f64::NAN, |n| n.rms_um * 1e3),
        limits.max_rms_nm,
        "nm",
    );
    let step = report.step;
    most(
        "max_overshoot_percent",
        step.map_or(f64::NAN, |s| s.overshoot_percent),
        limits.max_overshoot_percent,
        "%",
    );
    most(
        "max_settling_ms",
        step.map_or(f64::NAN, |s| s.settling_5_percent_s * 1e3),
        limits.max_settling_ms,
        "ms",
    );
    let unstable = report
        .spread
        .iter()
        .filter(|row| !row.margins.stable)
        .count() as f64;
    most(
        "stable_over_spread",
        unstable,
        (limits.stable_over_spread == Some(true)).then_some(0.0),
        "unstable points",
    );
    let mut least = |key, value: f64, limit: Option<f64>, unit| {
        if let Some(limit) = limit.filter(|&limit| value.is_nan() || value < limit) {
            broken.push(BrokenLimit {
                key,
                value,
                limit,
                unit,
            });
        }
    };
    least("min_pm_deg", m.pm_deg, limits.min_pm_deg, "deg");
    least("min_gm_db", m.gm_db, limits.min_gm_db, "dB");
    least(
        "min_delay_margin_ms",
        m.delay_margin_s * 1e3,
        limits.min_delay_margin_ms,
        "ms",
    );
    broken
}

/// A lead that recovers phase around the crossover of a loop with delay `T`: zero at 1/(2 pi T), pole four times as far.
pub fn default_lead(loop_delay_s: f64) -> Lead {
    let zero_hz = 1.0 / (std::f64::consts::TAU * loop_delay_s);
    Lead {
        zero_hz,
        pole_hz: 4.0 * zero_hz,
    }
}
