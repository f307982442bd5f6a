//! The table `[actuator]`: the device that moves the bead.

use cellpos_plant::Model;
use cellpos_plant::effects::{bubble, driver_lag};
use serde::{Deserialize, Serialize};
use std::f64::consts::TAU;
use std::path::PathBuf;

/// The PZT board.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum ActuatorConfig {
    /// The firmware library in this process.
    Emulated {},
    /// A pressure controller instead of the PZT, in this process: slow commands, a regulator, a tube that stretches. Its unit is um of
    /// PZT displacement.
    EmulatedPressure {
        /// Between two commands, ms: the period of the loop.
        #[serde(default = "command_period_ms")]
        period_ms: f64,
        /// Lag of the regulator (63 % of a step), ms.
        #[serde(default = "regulator_ms")]
        regulator_ms: f64,
        /// Lag of the tube, ms. With one, the model must have no pole-zero pair: the estimator holds two lags.
        #[serde(default)]
        compliance_ms: f64,
    },
    /// A board behind a serial port.
    Serial {
        /// Device, for example /dev/ttyUSB0; a relative path starts at the folder of the file.
        port: String,
        /// Baud rate; a pseudo-terminal takes any.
        #[serde(default = "baud")]
        baud: u32,
        /// After this time without a new command the board moves to the zero-flow displacement and holds it, ms; left out: the board's
        /// own.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        watchdog_ms: Option<u16>,
        /// After holding for this time it parks, ms; left out: the board's own.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        hold_watchdog_ms: Option<u16>,
    },
    /// A program that serves an actuator on a Unix socket in the board's protocol, such as `cellpos.serve_actuator`.
    Program {
        /// Path of the socket.
        socket: PathBuf,
        /// Between two commands, ms: the period of the loop.
        #[serde(default = "command_period_ms")]
        period_ms: f64,
        /// Lag of its regulator (63 % of a step), ms; 0: none, or in the model.
        #[serde(default)]
        regulator_ms: f64,
        /// Lag of the tube that stretches behind it, ms; 0: none, or in the model.
        #[serde(default)]
        compliance_ms: f64,
        /// After this time without a new command it moves to the zero-flow displacement and holds it, ms; left out: its own.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        watchdog_ms: Option<u16>,
        /// After holding for this time it parks, ms; left out: its own.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        hold_watchdog_ms: Option<u16>,
    },
}

impl ActuatorConfig {
    /// Whether it moves the emulated bead.
    pub fn is_emulated(&self) -> bool {
        matches!(self, Self::Emulated {} | Self::EmulatedPressure { .. })
    }

    /// Time between two commands, if the actuator is slower than the board, ms.
    pub fn period_ms(&self) -> Option<f64> {
        match self {
            Self::Program { period_ms, .. } | Self::EmulatedPressure { period_ms, .. } => {
                Some(*period_ms)
            }
            Self::Emulated {} | Self::Serial { .. } => None,
        }
    }

    /// Lags of regulator and tube, ms.
    pub fn lags_ms(&self) -> [f64; 2] {
        match self {
            Self::Program {
                regulator_ms,
                compliance_ms,
                ..
            }
            | Self::EmulatedPressure {
                regulator_ms,
                compliance_ms,
                ..
            } => [*regulator_ms, *compliance_ms],
            Self::Emulated {} | Self::Serial { .. } => [0.0; 2],
        }
    }

    /// The plant behind this actuator. It adds the lags of regulator and tube, unless the model has effects for them or was measured with
    /// the actuator (then it states the delay of its camera path).
    #[must_use]
    pub fn before(&self, mut model: Model) -> Model {
        if model.camera_delay_s.is_some() {
            return model;
        }
        let [regulator_s, compliance_s] = self.lags_ms().map(|ms| ms * 1e-3);
        let lags = [
            (regulator_s > 0.0).then(|| driver_lag(1.0 / (TAU * regulator_s))),
            (compliance_s > 0.0).then(|| bubble(compliance_s, 0.0)),
        ];
        for lag in lags.into_iter().flatten() {
            if model.effects.iter().all(|effect| effect.id() != lag.id()) {
                model.effects.push(lag);
            }
        }
        model
    }
}

/// Of a fast pressure controller, ms.
fn regulator_ms() -> f64 {
    50.0
}

/// Usual command periods of pressure controllers, ms.
pub(super) fn command_period_ms() -> f64 {
    20.0
}

fn baud() -> u32 {
    3_000_000
}
