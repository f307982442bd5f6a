//! The table `[partner]`: a slow actuator alongside the PZT.

use super::actuator::command_period_ms;
use cellpos_control::{BuildError, Limits, Partner, PartnerConfig};
use cellpos_drivers::PartnerRequest;
use cellpos_emulator::{BoardConfig, PressureConfig};
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// What moves the partner.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PartnerKind {
    /// A pressure controller in this process, of the emulated rig.
    EmulatedPressure,
    /// A program that serves an actuator on a Unix socket, such as `cellpos.serve_actuator`.
    Program,
}

/// The slow partner of the PZT: it takes over lasting displacement, and so returns the PZT to the middle of its stroke. Lengths
/// are in um on its own scale unless stated otherwise.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PartnerTable {
    /// What moves it.
    pub kind: PartnerKind,
    /// `program`: path of the socket.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub socket: Option<PathBuf>,
    /// Between two commands, ms.
    #[serde(default = "command_period_ms")]
    pub period_ms: f64,
    /// Smallest command, um.
    #[serde(default)]
    pub low_um: f64,
    /// Largest command, um.
    #[serde(default = "high_um")]
    pub high_um: f64,
    /// Its slew limit, um/s.
    #[serde(default = "slew_um_per_s")]
    pub slew_um_per_s: f64,
    /// Where it rests unattended, um; left out: the middle of its range.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub park_um: Option<f64>,
    /// PZT displacement with the effect of 1 um of this actuator; `cellpos rig partner` measures it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub gain: Option<f64>,
    /// Half width of the gain's 95 % interval.
    #[serde(default)]
    pub gain_ci95: f64,
    /// Lag of regulator and tube (63 % of a step), ms.
    #[serde(default)]
    pub lag_ms: f64,
    /// Dead time before it, ms.
    #[serde(default)]
    pub delay_ms: f64,
    /// PZT displacement to which the PZT is returned, um; left out: the middle of `[limits]`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mid_um: Option<f64>,
    /// Silence after which it holds its position, ms; left out: five periods.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub watchdog_ms: Option<u16>,
    /// Time that it then holds before it parks, ms; left out: its own.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub hold_watchdog_ms: Option<u16>,
    /// `emulated-pressure`: its true gain.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub emulated_gain: Option<f64>,
    /// `emulated-pressure`: its regulator's lag, ms; left out: 50.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub emulated_regulator_ms: Option<f64>,
    /// `emulated-pressure`: its tube's lag, ms; left out: 0.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub emulated_compliance_ms: Option<f64>,
}

fn high_um() -> f64 {
    1000.0
}

fn slew_um_per_s() -> f64 {
    100.0
}

impl PartnerTable {
    /// Where it rests unattended, um.
    pub fn park_um(&self) -> f64 {
        self.park_um.unwrap_or(0.5 * (self.low_um + self.high_um))
    }

    /// How it is armed.
    pub fn request(&self) -> PartnerRequest {
        let periods = (5.0 * self.period_ms).round().clamp(1.0, 10_000.0);
        PartnerRequest {
            park_um: self.park_um(),
            limits: [self.low_um, self.high_um, self.slew_um_per_s],
            watchdogs_ms: [
                Some(self.watchdog_ms.unwrap_or(periods as u16)),
                self.hold_watchdog_ms,
            ],
        }
    }

    /// The partner of the emulated rig.
    pub fn emulated(&self) -> PressureConfig {
        PressureConfig {
            board: BoardConfig {
                serial: 2,
                low_um: self.low_um,
                high_um: self.high_um,
                slew_um_per_s: self.slew_um_per_s,
                ramp_um_per_s: self.slew_um_per_s,
                power_up_um: self.park_um(),
                park_um: self.park_um(),
                // Half a millisecond: the time of a controller's own loop.
                update_us: 500,
                ..BoardConfig::default()
            },
            gain: self.emulated_gain.unwrap_or(1.0),
            lags_ms: [
                self.emulated_regulator_ms.unwrap_or(50.0),
                self.emulated_compliance_ms.unwrap_or(0.0),
            ],
        }
    }

    /// The partner as the loop knows it, for a PZT with these limits. `None`: its gain was not measured yet.
    pub fn config(&self, limits: &Limits) -> Option<PartnerConfig> {
        Some(PartnerConfig {
            period_ms: self.period_ms,
            low_um: self.low_um,
            high_um: self.high_um,
            slew_um_per_s: self.slew_um_per_s,
            gain: self.gain?,
            gain_ci95: self.gain_ci95,
            lag_ms: self.lag_ms,
            delay_ms: self.delay_ms,
            step_um: 0.0,
            mid_um: self
                .mid_um
                .unwrap_or(0.5 * (limits.low_um + limits.high_um)),
            probe: None,
        })
    }

    /// Checks every value.
    pub(super) fn validate(&self, limits: &Limits, sample_s: f64) -> Result<(), String> {
        let problem = |error: BuildError| format!("[partner] {error}");
        let measured = Self {
            gain: Some(self.gain.unwrap_or(1.0)),
            ..self.clone()
        };
        if let Some(config) = measured.config(limits) {
            Partner::new(config, limits, sample_s).map_err(problem)?;
        }
        let park_um = self.park_um();
        if !(self.low_um..=self.high_um).contains(&park_um) {
            return Err(format!(
                "[partner] park_um = {park_um}: must be within low_um and high_um"
            ));
        }
        let emulated = [
            ("emulated_gain", self.emulated_gain, -1e3),
            ("emulated_regulator_ms", self.emulated_regulator_ms, 0.0),
            ("emulated_compliance_ms", self.emulated_compliance_ms, 0.0),
        ];
        for (key, value, least) in emulated {
            match (self.kind, value) {
                (PartnerKind::Program, Some(_)) => {
                    return Err(format!(
                        "[partner] {key}: is for kind = \"emulated-pressure\""
                    ));
                }
                (_, Some(value)) if !(least..=10_000.0).contains(&value) => {
                    return Err(format!(
                        "[partner] {key} = {value}: must be {least} to 10000"
                    ));
                }
                _ => {}
            }
        }
        match (self.kind, &self.socket) {
            (PartnerKind::Program, None) => {
                Err("[partner] socket: kind = \"program\" needs the path of a socket".to_owned())
            }
            (PartnerKind::EmulatedPressure, Some(_)) => {
                Err("[partner] socket: is for kind = \"program\"".to_owned())
            }
            _ => Ok(()),
        }
    }
}
