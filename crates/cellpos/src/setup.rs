//! Everything that determines the commands of a run, in a form that is written into the run folder and read back by a
//! replay.

use crate::outcome::Failure;
use cellpos_control::design::{
    DesignPlant, DesignRequest, PiSearch, Requested, default_lead, design,
};
use cellpos_control::{ControllerConfig, ControllerFile, ControllerKind, Limits, Profile};
use cellpos_plant::Model;
use cellpos_runtime::{ArmingConfig, Core, CoreError, Timing};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// What the bead is to follow.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum ReferenceSpec {
    /// Go to a position and hold it.
    Hold {
        /// Position, um.
        position_um: f64,
    },
}

impl ReferenceSpec {
    /// The reference to evaluate.
    pub fn profile(&self) -> Profile {
        match *self {
            Self::Hold { position_um } => Profile::Hold { position_um },
        }
    }
}

/// A loop before it is built.
#[derive(Debug, Clone, PartialEq)]
pub struct Setup {
    /// The plant that the controller believes in.
    pub model: Model,
    /// Controller, estimator and limits.
    pub controller: ControllerFile,
    /// The rest.
    pub config: SetupConfig,
}

/// The part of a [`Setup`] that has no file of its own.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SetupConfig {
    /// PZT displacement at the start, um.
    pub displacement_um: f64,
    /// First belief of neutral, um.
    pub neutral_um: f64,
    /// What the bead is to follow.
    pub reference: ReferenceSpec,
    /// Times and counts of the loop.
    pub timing: Timing,
    /// The check before the loop is closed.
    pub arming: ArmingConfig,
}

impl Setup {
    /// Builds the loop.
    pub fn core(&self) -> Result<Core<Profile>, Failure> {
        let loop_config = self
            .controller
            .loop_config(&self.model)
            .map_err(Failure::input)?;
        let sample_s = self.config.timing.period_us * 1e-6;
        let plant =
            DesignPlant::from_model(&self.model, Some(self.controller.delay_ms * 1e-3), sample_s)
                .map_err(Failure::input)?;
        Core::new(
            loop_config,
            self.config.reference.profile(),
            self.config.timing,
            self.config.arming,
            &plant.plant,
            self.config.displacement_um,
            self.config.neutral_um,
        )
        .map_err(|error: CoreError| Failure::input(error))
    }
}

/// A controller by name (`pi`, `lead`: gains found for the model and the delay; `lqg`, `mpc`: the default weights) or
/// from a controller.toml.
pub fn controller(name: &str, model: &Model, timing: &Timing) -> Result<ControllerFile, Failure> {
    let sample_s = timing.period_us * 1e-6;
    let loop_delay_s = timing.camera_delay_ms * 1e-3 + 0.5 * sample_s;
    let mut kind = None;
    let lead = match name {
        "pi" => None,
        "lead" => Some(default_lead(loop_delay_s)),
        // The PI gains found below serve these two as the fallback.
        "lqg" | "mpc" => {
            kind = Some(if name == "lqg" {
                ControllerKind::Lqg
            } else {
                ControllerKind::Mpc
            });
            None
        }
        path if path.ends_with(".toml") => {
            let file = ControllerFile::load(Path::new(path)).map_err(Failure::input)?;
            if (file.delay_ms * 1e-3 - loop_delay_s).abs() > 0.05 * sample_s {
                return Err(Failure::bad_input(
                    format!(
                        "{path}: made for a loop delay of {} ms, the rig has {} ms",
                        file.delay_ms,
                        loop_delay_s * 1e3
                    ),
                    format!(
                        "design it again: cellpos design --delay {}ms",
                        loop_delay_s * 1e3
                    ),
                ));
            }
            return Ok(file);
        }
        other => {
            return Err(Failure::bad_input(
                format!("--controller {other}: not a controller"),
                "write pi, lead, lqg, mpc, or the path of a controller.toml",
            ));
        }
    };
    let plant =
        DesignPlant::from_model(model, Some(loop_delay_s), sample_s).map_err(Failure::input)?;
    let request = DesignRequest {
        plant,
        controller: Requested::SearchPi(PiSearch {
            lead,
            ..PiSearch::default()
        }),
        setpoint_weight: None,
        command_limits: Limits::default(),
        limits: Default::default(),
    };
    let report = design(&request).map_err(Failure::input)?;
    let ControllerConfig::Pi(pi) = report.controller else {
        unreachable!("a search for PI gains gives PI gains")
    };
    let mut file = ControllerFile::from_pi(pi, loop_delay_s);
    if let Some(kind) = kind {
        file.controller = kind;
    }
    file.sample_time_ms = sample_s * 1e3;
    if let Some(config) = &report.config {
        file.estimator = config.estimator;
    }
    Ok(file)
}

/// The tighter of two sets of limits; park as in the first.
pub fn within(limits: Limits, other: [f64; 3]) -> Limits {
    let [low_um, high_um, slew_um_per_s] = other;
    let low_um = limits.low_um.max(low_um);
    let high_um = limits.high_um.min(high_um);
    Limits {
        low_um,
        high_um,
        slew_um_per_s: limits.slew_um_per_s.min(slew_um_per_s),
        park_um: limits
            .park_um
            .clamp(low_um.min(high_um), high_um.max(low_um)),
    }
}
