//! controller.toml: which controller, its gains, the estimator's noise, the limits of the command.
//!
//! Unknown keys are refused with a suggestion; every number has its unit in the key. The plant is not part of this
//! file: it is the model.toml beside it.

use crate::controller::{Controller, ControllerConfig, LoopConfig};
use crate::design::DesignPlant;
use crate::error::BuildError;
use crate::estimator::EstimatorConfig;
use crate::limits::Limits;
use crate::lqg::Lqg;
use crate::mpc::Mpc;
use crate::pi::{Lead, Pi};
use crate::toml_file::{self, ConfigError, TomlFile};
use cellpos_plant::Model;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Which control law runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ControllerKind {
    /// PI.
    Pi,
    /// PI with lead.
    Lead,
    /// State feedback on the estimate.
    Lqg,
    /// Model predictive control.
    Mpc,
}

impl ControllerKind {
    /// The law of a name, as controller.toml and the command line write it.
    pub fn from_name(name: &str) -> Option<Self> {
        Some(match name {
            "pi" => Self::Pi,
            "lead" => Self::Lead,
            "lqg" => Self::Lqg,
            "mpc" => Self::Mpc,
            _ => return None,
        })
    }

    /// Whether the law follows gain and delay by default. PI and lead are robust without it, and are chosen for that.
    pub fn adapts(self) -> bool {
        matches!(self, Self::Lqg | Self::Mpc)
    }
}

/// Gains of the PI controller as the file writes them.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PiFile {
    /// Proportional gain, um of PZT per um of bead.
    pub kp_um_per_um: f64,
    /// Integral gain, 1/s.
    pub ki_per_s: f64,
    /// Weight of the reference in the proportional path, 0..1.
    #[serde(default = "default_weight")]
    pub setpoint_weight: f64,
    /// Time constant of the anti-windup, ms; left out: half the integral time.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tracking_time_ms: Option<f64>,
    /// Lead on the proportional path; needed by `controller = "lead"`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lead: Option<Lead>,
}

fn default_weight() -> f64 {
    Pi::DEFAULT_SETPOINT_WEIGHT
}

fn default_sample_time_ms() -> f64 {
    1.0
}

/// A controller.toml.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ControllerFile {
    /// Which control law runs.
    pub controller: ControllerKind,
    /// Loop delay it is made for, with the half sample of hold, ms.
    pub delay_ms: f64,
    /// Sample time, ms.
    #[serde(default = "default_sample_time_ms")]
    pub sample_time_ms: f64,
    /// PI gains: the law of `pi` and `lead`, the fallback of the others.
    pub pi: PiFile,
    /// Weights of LQG.
    #[serde(default)]
    pub lqg: Lqg,
    /// Weights, solver and field of view of MPC.
    #[serde(default)]
    pub mpc: Mpc,
    /// Noise and gate of the estimator.
    #[serde(default)]
    pub estimator: EstimatorConfig,
    /// Limits of the command.
    #[serde(default)]
    pub limits: Limits,
}

impl TomlFile for ControllerFile {
    fn check_values(&self) -> Result<(), BuildError> {
        self.validate()
    }
}

impl ControllerFile {
    /// A PI file with defaults for everything else.
    pub fn from_pi(pi: Pi, loop_delay_s: f64) -> Self {
        Self {
            controller: if pi.lead.is_some() {
                ControllerKind::Lead
            } else {
                ControllerKind::Pi
            },
            delay_ms: loop_delay_s * 1e3,
            sample_time_ms: default_sample_time_ms(),
            pi: PiFile {
                kp_um_per_um: pi.kp,
                ki_per_s: pi.ki_per_s,
                setpoint_weight: pi.setpoint_weight,
                tracking_time_ms: Some(pi.tracking_time_s * 1e3),
                lead: pi.lead,
            },
            lqg: Lqg::default(),
            mpc: Mpc::default(),
            estimator: EstimatorConfig::default(),
            limits: Limits::default(),
        }
    }

    /// Reads a controller file.
    ///
    /// # Errors
    /// A file that cannot be read, and all of [`ControllerFile::from_toml_str`].
    pub fn load(path: &Path) -> Result<Self, ConfigError> {
        toml_file::load::<Self>(path)?.with_lead(&path.display().to_string())
    }

    /// Reads the text of a controller file; `file` is for the messages only.
    ///
    /// # Errors
    /// Text that is not TOML, unknown or missing keys, wrong types, values out of range.
    pub fn from_toml_str(text: &str, file: &str) -> Result<Self, ConfigError> {
        toml_file::parse::<Self>(text, file)?.with_lead(file)
    }

    fn with_lead(self, file: &str) -> Result<Self, ConfigError> {
        if self.controller == ControllerKind::Lead && self.pi.lead.is_none() {
            return Err(ConfigError::MissingLead {
                file: file.to_owned(),
            });
        }
        Ok(self)
    }

    /// The file as TOML text; reads back to the same values.
    pub fn to_toml_string(&self) -> String {
        // Serialising plain numbers into TOML cannot fail.
        toml::to_string_pretty(self).unwrap_or_default()
    }

    fn validate(&self) -> Result<(), BuildError> {
        use crate::error::check;
        let ts = self.sample_time_ms;
        check(
            "sample_time_ms",
            "ms",
            ts,
            (0.01..=1000.0).contains(&ts),
            "0.01 to 1000 (1 at 1000 fps)",
        )?;
        let delay_ok = self.delay_ms >= 0.5 * ts && self.delay_ms < 1000.0;
        check(
            "delay_ms",
            "ms",
            self.delay_ms,
            delay_ok,
            "at least half a sample of hold (2.5 for a 2 ms camera path)",
        )?;
        self.pi_config().validate()?;
        self.lqg.validate()?;
        self.mpc.validate()?;
        self.limits.validate()
    }

    /// The PI controller of the file.
    pub fn pi_config(&self) -> Pi {
        let mut pi = Pi {
            setpoint_weight: self.pi.setpoint_weight,
            ..Pi::new(self.pi.kp_um_per_um, self.pi.ki_per_s)
        };
        if let Some(ms) = self.pi.tracking_time_ms {
            pi.tracking_time_s = ms * 1e-3;
        }
        if self.controller == ControllerKind::Lead {
            pi.lead = self.pi.lead;
        }
        pi
    }

    /// The control law of the file.
    pub fn controller_config(&self) -> ControllerConfig {
        match self.controller {
            ControllerKind::Pi | ControllerKind::Lead => ControllerConfig::Pi(self.pi_config()),
            ControllerKind::Lqg => ControllerConfig::Lqg(self.lqg),
            ControllerKind::Mpc => ControllerConfig::Mpc(self.mpc, self.pi_config()),
        }
    }

    /// The loop for a plant: everything that [`crate::Controller::new`] needs.
    ///
    /// # Errors
    /// A plant that cannot be discretised or held by the estimator, a value out of range.
    pub fn loop_config(&self, model: &Model) -> Result<LoopConfig, ConfigError> {
        let sample_time_s = self.sample_time_ms * 1e-3;
        let plant = DesignPlant::from_model(model, Some(self.delay_ms * 1e-3), sample_time_s)?;
        let model = plant
            .loop_model()
            .map_err(ConfigError::build("controller"))?;
        let config = LoopConfig {
            model,
            estimator: self.estimator,
            controller: self.controller_config(),
            limits: self.limits,
        };
        Controller::new(config).map_err(ConfigError::build("controller"))?;
        Ok(config)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const EXAMPLE: &str = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../../examples/controller.toml"
    );

    #[test]
    fn the_example_file_makes_a_loop_for_eq6_and_reads_back_to_itself() {
        let file = ControllerFile::load(Path::new(EXAMPLE)).unwrap();
        let config = file.loop_config(&Model::eq6()).unwrap();
        assert!((config.model.gain_per_s - 428.0).abs() < 1.0);
        assert!((config.model.delay_s - 2e-3).abs() < 1e-12);
        assert_eq!(config.controller, ControllerConfig::Pi(file.pi_config()));
        assert_eq!(
            ControllerFile::from_toml_str(&file.to_toml_string(), "again").unwrap(),
            file
        );
    }

    #[test]
    fn an_unknown_key_is_refused_with_its_place_and_a_suggestion() {
        let text =
            "controller = \"pi\"\ndelay_ms = 2.5\n[pi]\nkp_um_per_um = 0.4\nki_per_sec = 10.0\n";
        let error = ControllerFile::from_toml_str(text, "c.toml").unwrap_err();
        let ConfigError::Text {
            line, suggestion, ..
        } = &error
        else {
            panic!("{error}")
        };
        assert_eq!((*line, suggestion.as_deref()), (5, Some("ki_per_s")));
        assert!(
            error.to_string().starts_with("c.toml:5:1: unknown field"),
            "{error}"
        );
    }

    #[test]
    fn a_value_out_of_range_is_refused_by_its_key() {
        let text =
            "controller = \"pi\"\ndelay_ms = 2.5\n[pi]\nkp_um_per_um = nan\nki_per_s = 10.0\n";
        let error = ControllerFile::from_toml_str(text, "c.toml").unwrap_err();
        assert!(error.to_string().contains("kp"), "{error}");
        let text =
            "controller = \"pi\"\ndelay_ms = 0.2\n[pi]\nkp_um_per_um = 0.4\nki_per_s = 10.0\n";
        let error = ControllerFile::from_toml_str(text, "c.toml").unwrap_err();
        assert!(
            error.to_string().contains("half a sample of hold"),
            "{error}"
        );
    }

    #[test]
    fn lead_without_its_frequencies_is_refused() {
        let text =
            "controller = \"lead\"\ndelay_ms = 2.5\n[pi]\nkp_um_per_um = 0.4\nki_per_s = 10.0\n";
        let error = ControllerFile::from_toml_str(text, "c.toml").unwrap_err();
        assert_eq!(
            error,
            ConfigError::MissingLead {
                file: "c.toml".to_owned()
            }
        );
    }
}
