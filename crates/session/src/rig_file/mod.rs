//! rig.toml: camera and board, their calibration and limits, and the times of the loop.

mod actuator;
mod connect;
mod partner;
mod port;
mod sight;
mod unused;

pub use actuator::ActuatorConfig;
pub use connect::Connected;
pub use partner::{PartnerKind, PartnerTable};

use crate::{Failure, quantities};
use cellpos_control::Limits;
use cellpos_drivers::sources::Region;
use cellpos_drivers::{Calibration, CalibrationFile};
use cellpos_emulator::{BoardConfig, WorldConfig};
use cellpos_runtime::{ArmingConfig, Timing};
use cellpos_script::Sample;
use cellpos_vision::{CellConfig, CellFinder, LocaliserConfig, TrackerConfig};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// A rig.toml. Every table may be left out; the defaults are the emulated rig of the paper. Within a table, keys without a default, such
/// as `kind` of a device or `pixel_um` of a calibration, are required.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RigFile {
    /// First estimate of the PZT displacement at which the bead is at rest, um; the loop then finds it.
    pub first_neutral_um: f64,
    /// Zero flow at the end of the run before on this rig, um: newer than what any file states. It is no key of the file.
    #[serde(skip)]
    pub rested_um: Option<f64>,
    /// Of several beads in view, the one nearest to this position at the start is followed, um; left out: the most prominent. The option
    /// `--near` of `track` and `run` overrides it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub near_um: Option<f64>,
    /// Contents of the channel; a script's own entry overrides it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sample: Option<Sample>,
    /// The PZT board.
    pub actuator: ActuatorConfig,
    /// A slow actuator alongside the PZT; left out: none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub partner: Option<PartnerTable>,
    /// The camera.
    pub camera: CameraConfig,
    /// From pixels to micrometres; left out for the emulated camera: its own.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub calibration: Option<Calibration>,
    /// A calibration file instead of `[calibration]`, with date and uncertainty; its path starts at the folder of rig.toml.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub calibration_file: Option<PathBuf>,
    /// Localisation; left out: a ring profile for the bead of `[emulator]`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub vision: Option<LocaliserConfig>,
    /// Tracks a cell instead of a bead; an emulated rig with `[emulator.cell]` needs no such table.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cell: Option<CellInView>,
    /// Tracking; left out: for a 1 um bead in water.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tracking: Option<TrackerConfig>,
    /// Limits of the command, within those of the board.
    pub limits: Limits,
    /// Times and counts of the loop.
    pub timing: Timing,
    /// The check before the loop is closed.
    pub arming: ArmingConfig,
    /// The emulated board.
    pub board: BoardConfig,
    /// The emulated world.
    pub emulator: WorldConfig,
}

/// The table `[cell]`: how vision finds a cell.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CellInView {
    /// Recording of the empty channel, as written by `cellpos background`; its path starts at the folder of rig.toml. The emulated camera
    /// has its own.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub background: Option<PathBuf>,
    /// Criteria for a cell.
    pub finder: CellConfig,
}

/// The camera.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum CameraConfig {
    /// Rendered in this process.
    Emulated {},
    /// A camera process behind a Unix socket.
    Socket {
        /// Path of the socket.
        socket: PathBuf,
        /// Frame rate, Hz.
        #[serde(default = "rate_hz")]
        rate_hz: f64,
    },
    /// A GigE or USB3 Vision camera; needs a program built with the feature `aravis`.
    Industrial {
        /// IP address of a GigE camera, or the identifier of another (`cellpos camera` lists both).
        address: String,
        /// Frame rate, Hz.
        #[serde(default = "rate_hz")]
        rate_hz: f64,
        /// Part of the sensor that is read out; left out: the camera's own setting.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        region: Option<Region>,
        /// Exposure, us; left out: the camera's own setting.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        exposure_us: Option<f64>,
        /// 8 or 16 bits per pixel.
        #[serde(default = "bits")]
        bits: u16,
        /// From the middle of an exposure to its fastest arrival, ms. It converts the camera's time stamps to this machine's clock. The
        /// LED test measures it; left out: [`CameraConfig::LATENCY_MS`].
        #[serde(default, skip_serializing_if = "Option::is_none")]
        latency_ms: Option<f64>,
    },
}

impl CameraConfig {
    /// First guess for half an exposure, the readout of a sensor at 1 kHz and the network together, ms.
    pub const LATENCY_MS: f64 = 1.5;
}

fn bits() -> u16 {
    8
}

fn rate_hz() -> f64 {
    1000.0
}

impl Default for RigFile {
    fn default() -> Self {
        Self {
            first_neutral_um: 20.0,
            rested_um: None,
            near_um: None,
            sample: None,
            actuator: ActuatorConfig::Emulated {},
            partner: None,
            camera: CameraConfig::Emulated {},
            calibration: None,
            calibration_file: None,
            vision: None,
            cell: None,
            tracking: None,
            limits: Limits {
                low_um: 0.0,
                high_um: 40.0,
                slew_um_per_s: 40_000.0,
                park_um: 20.0,
            },
            timing: Timing::default(),
            arming: ArmingConfig::default(),
            board: BoardConfig::default(),
            emulator: WorldConfig::default(),
        }
    }
}

/// Whether positions come from rendered frames or are drawn with the noise that frames would give.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
pub enum Frames {
    /// Render frames and find the bead in them.
    On,
    /// Positions with equivalent noise: faster.
    Off,
}

/// Which clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
pub enum ClockKind {
    /// The clock of this machine.
    Real,
    /// As fast as the machine can; a seed fixes every bit.
    Virtual,
}

impl RigFile {
    /// Time from one frame of the camera to the next, s.
    pub fn frame_s(&self) -> f64 {
        1.0 / match self.camera {
            CameraConfig::Emulated {} => self.emulator.rate_hz,
            CameraConfig::Socket { rate_hz, .. } | CameraConfig::Industrial { rate_hz, .. } => {
                rate_hz
            }
        }
    }

    /// Reads a rig.toml; without one, the defaults.
    pub fn load(path: Option<&Path>) -> Result<Self, Failure> {
        let Some(path) = path else {
            return Ok(Self::default());
        };
        let mut file: Self = quantities::read(path)?;
        file.validate(path)?;
        let text = std::fs::read_to_string(path).unwrap_or_default();
        for said in file.unused(&text) {
            tracing::warn!("{}:{said}", path.display());
        }
        // Paths in the file start at the file's own folder.
        let folder = path.parent().unwrap_or(Path::new(""));
        if let Some(calibration) = &mut file.calibration_file {
            *calibration = folder.join(&*calibration);
            if file.calibration.is_some() {
                return Err(Failure::bad_input(
                    format!(
                        "{}: both calibration_file and [calibration]",
                        path.display()
                    ),
                    "keep the one that holds for this camera",
                ));
            }
            let read = CalibrationFile::read(calibration).map_err(Failure::input)?;
            file.calibration = Some(read.calibration());
        }
        if let Some(background) = file.cell.as_mut().and_then(|cell| cell.background.as_mut()) {
            *background = folder.join(&*background);
        }
        if let CameraConfig::Socket { socket, .. } = &mut file.camera {
            *socket = folder.join(&*socket);
        }
        if let ActuatorConfig::Program { socket, .. } = &mut file.actuator {
            *socket = folder.join(&*socket);
        }
        if let Some(socket) = (file.partner.as_mut()).and_then(|partner| partner.socket.as_mut()) {
            *socket = folder.join(&*socket);
        }
        if let Some(period_ms) = file.actuator.period_ms() {
            file.keep_the_pace_of(period_ms * 1e3);
        }
        if let ActuatorConfig::Serial { port, .. } = &mut file.actuator {
            // A relative path is a link next to the file if it exists, else a name of the system (COM5).
            let beside = folder.join(&*port);
            if beside.exists() {
                *port = beside.display().to_string();
            }
        }
        if file.emulator.model != "eq6" {
            file.emulator.model = folder.join(&file.emulator.model).display().to_string();
        }
        Ok(file)
    }

    /// Runs the loop at the period of an actuator that is slower than the camera. The arming pulse keeps its duration as far as the
    /// period allows.
    fn keep_the_pace_of(&mut self, period_us: f64) {
        let own = Self::default();
        if self.timing.period_us == own.timing.period_us {
            self.timing.period_us = period_us;
        }
        if self.arming.pulse_ticks == own.arming.pulse_ticks {
            let pulse_us = f64::from(own.arming.pulse_ticks) * own.timing.period_us;
            self.arming.pulse_ticks = (pulse_us / period_us).round().max(1.0) as u32;
        }
    }

    /// Runs the loop at the rate of a camera that is slower than the loop; returns the loop's own period, us, or `None` if the camera keeps
    /// pace. The arming pulse keeps its duration as far as the period allows.
    pub fn keep_the_pace_of_its_camera(&mut self) -> Option<f64> {
        /// Relative difference below which two periods count as equal.
        const EQUAL: f64 = 1e-3;
        const LONGEST_US: f64 = 1e6;
        let (own_us, frame_us) = (self.timing.period_us, 1e6 * self.frame_s());
        let is_slower = frame_us > (1.0 + EQUAL) * own_us && frame_us <= LONGEST_US;
        // The period of an actuator program is its own.
        if !is_slower || self.actuator.period_ms().is_some() {
            return None;
        }
        self.timing.period_us = frame_us;
        let pulse_us = f64::from(self.arming.pulse_ticks) * own_us;
        self.arming.pulse_ticks = (pulse_us / frame_us).round().max(1.0) as u32;
        Some(own_us)
    }

    fn validate(&self, path: &Path) -> Result<(), Failure> {
        let say = |table: &str, error: &dyn std::fmt::Display| {
            let message = error.to_string();
            let text = std::fs::read_to_string(path).unwrap_or_default();
            let line = quantities::line_named(&text, table, &message)
                .map_or_else(String::new, |line| format!(":{line}"));
            Failure::bad_input(
                format!("{}{line}: {message}", path.display()),
                "docs/rig-toml.md has every key; see the commented files under examples/, too",
            )
        };
        self.limits
            .validate()
            .map_err(|error| say("limits", &error))?;
        self.timing
            .validate()
            .map_err(|error| say("timing", &error))?;
        if let Some(period_ms) = self.actuator.period_ms() {
            let period_us = period_ms * 1e3;
            let one_ms = Self::default().timing.period_us;
            if !(1.0..=1000.0).contains(&period_ms) {
                return Err(say(
                    "actuator",
                    &format!("period_ms = {period_ms}: must be 1 to 1000 ms"),
                ));
            }
            let lags_ms = self.actuator.lags_ms();
            for (key, ms) in ["regulator_ms", "compliance_ms"].iter().zip(lags_ms) {
                if !(0.0..=10_000.0).contains(&ms) {
                    return Err(say(
                        "actuator",
                        &format!("{key} = {ms}: must be 0 to 10000 ms"),
                    ));
                }
            }
            if ![one_ms, period_us].contains(&self.timing.period_us) {
                return Err(say(
                    "timing",
                    &format!(
                        "period_us = {}: the actuator takes a command each {period_us} us; leave period_us out",
                        self.timing.period_us
                    ),
                ));
            }
        }
        self.validate_partner()
            .map_err(|problem| say("partner", &problem))?;
        self.board
            .validate()
            .map_err(|error| say("board", &error))?;
        self.emulator
            .validate()
            .map_err(|error| say("emulator", &error))?;
        if let Some(cell) = &self.cell {
            CellFinder::new(1, 1, cell.finder)
                .map_err(|error| say("cell.finder", &format!("[cell.finder] {error}")))?;
            if matches!(self.camera, CameraConfig::Emulated {}) && self.emulator.cell.is_none() {
                return Err(say(
                    "",
                    &"[cell]: the emulated rig has a bead; give it a cell with a table [emulator.cell]",
                ));
            }
        }
        if !(self.limits.low_um..=self.limits.high_um).contains(&self.first_neutral_um) {
            return Err(say(
                "",
                &format!(
                    "first_neutral_um = {}: must be within the limits, {} to {} um",
                    self.first_neutral_um, self.limits.low_um, self.limits.high_um
                ),
            ));
        }
        if let Some(near_um) = self.near_um.filter(|um| !um.is_finite()) {
            return Err(say(
                "",
                &format!("near_um = {near_um}: must be a position in view, um"),
            ));
        }
        let problem = self.calibration.as_ref().and_then(Calibration::problem);
        if let Some((key, value, must_be)) = problem {
            return Err(say(
                "calibration",
                &format!("[calibration] {key} = {value}: must be {must_be}"),
            ));
        }
        if let Some(tracking) = &self.tracking {
            tracking
                .check()
                .map_err(|error| say("tracking", &format!("[tracking] {error}")))?;
        }
        Ok(())
    }

    fn validate_partner(&self) -> Result<(), String> {
        let Some(partner) = &self.partner else {
            return Ok(());
        };
        partner.validate(&self.limits, self.timing.period_us * 1e-6)?;
        if (partner.kind == PartnerKind::EmulatedPressure) != self.is_emulated() {
            return Err("[partner] kind: \"emulated-pressure\" is of the emulated rig, \"program\" of a real one".to_owned());
        }
        Ok(())
    }

    /// Overrides seed and imperfections of the emulated rig; None leaves them.
    ///
    /// # Errors
    /// The rig is not emulated, and the call sets its imperfections.
    pub fn emulate_as(&mut self, seed: Option<u64>, ideal: Option<bool>) -> Result<(), Failure> {
        if let Some(seed) = seed {
            self.emulator.seed = seed;
        }
        if ideal.is_some() && !self.is_emulated() {
            return Err(Failure::bad_input(
                "--ideal is for the emulated rig: a real one is as it is",
                "leave it out; firmware-sim has its own --ideal",
            ));
        }
        self.emulator.ideal = ideal.unwrap_or(self.emulator.ideal);
        Ok(())
    }

    /// Whether the whole rig is emulated in this process.
    pub fn is_emulated(&self) -> bool {
        self.actuator.is_emulated() && self.camera == CameraConfig::Emulated {}
    }

    /// Whether the rig tracks a cell, so that its length and area are measured.
    pub fn follows_a_cell(&self) -> bool {
        match self.camera {
            CameraConfig::Emulated {} => self.emulator.cell.is_some(),
            _ => self.cell.is_some(),
        }
    }

    /// The file with the empty channel, if cells are found against one.
    pub fn background(&self) -> Option<&Path> {
        match self.camera {
            CameraConfig::Emulated {} => None,
            _ => self.cell.as_ref()?.background.as_deref(),
        }
    }

    /// Command watchdog and hold watchdog requested from the board by the file, ms. Without the first, a run requests
    /// [`Timing::board_watchdog_ms`]; without the second, the board's own is left.
    pub fn watchdogs_ms(&self) -> [Option<u16>; 2] {
        match self.actuator {
            ActuatorConfig::Serial {
                watchdog_ms,
                hold_watchdog_ms,
                ..
            }
            | ActuatorConfig::Program {
                watchdog_ms,
                hold_watchdog_ms,
                ..
            } => [watchdog_ms, hold_watchdog_ms],
            ActuatorConfig::Emulated {} => {
                let own_ms = self.board.watchdog_ms;
                let asked = own_ms != BoardConfig::default().watchdog_ms;
                [asked.then_some(own_ms), None]
            }
            // Five periods, as for a program: the board's own 20 ms would expire between two commands.
            ActuatorConfig::EmulatedPressure { period_ms, .. } => {
                [Some((5.0 * period_ms).round() as u16), None]
            }
        }
    }
}
