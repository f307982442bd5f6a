//! rig.toml: which camera, which board, their calibration and limits, and the times of the loop.

use crate::Failure;
use crate::quantities;
use cellpos_control::Limits;
use cellpos_drivers::serial::SerialLine;
use cellpos_drivers::socket::SocketCamera;
use cellpos_drivers::sources::Region;
use cellpos_drivers::{
    BoardHost, Calibration, CalibrationFile, CommandedFlow, FlowTap, Followed, VisionSource,
    background,
};
use cellpos_emulator::BoardConfig;
use cellpos_emulator::EmulatedRig;
use cellpos_emulator::{World, WorldConfig};
use cellpos_plant::Model;
use cellpos_rig::{Actuator, Camera, Clock, FrameBuffer, PositionSource};
use cellpos_runtime::{ArmingConfig, Timing};
use cellpos_script::Sample;
use cellpos_units::Hertz;
use cellpos_vision::{
    CellConfig, CellFinder, CellTracker, Localiser, LocaliserConfig, ProfileSpec, Tracker,
    TrackerConfig,
};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use std::time::Duration;

/// A rig.toml. Every table and key may be left out: what is left is the emulated rig of the paper.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RigFile {
    /// First belief of the PZT displacement at which the bead is at rest, um; the loop finds the rest.
    pub first_neutral_um: f64,
    /// Of several beads in view, the one nearest to this position at the start is followed, um; left out: the most
    /// prominent. The option `--near` of `track` and `run` goes before.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub near_um: Option<f64>,
    /// What is in the channel; a script's own goes before.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sample: Option<Sample>,
    /// The PZT board.
    pub actuator: ActuatorConfig,
    /// The camera.
    pub camera: CameraConfig,
    /// From pixels to micrometres; left out for the emulated camera: its own.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub calibration: Option<Calibration>,
    /// A calibration file instead of `[calibration]`, with date and uncertainty; from the folder of rig.toml.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub calibration_file: Option<PathBuf>,
    /// Localisation; left out: a ring profile for the bead of `[emulator]`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub vision: Option<LocaliserConfig>,
    /// A cell is followed instead of a bead; an emulated rig with `[emulator.cell]` needs no such table.
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

/// How a cell is seen, the table `[cell]`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CellInView {
    /// Recording of the empty channel, as `cellpos background` writes it; from the folder of rig.toml. The emulated camera
    /// brings its own.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub background: Option<PathBuf>,
    /// What counts as a cell.
    pub finder: CellConfig,
}

/// The PZT board.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum ActuatorConfig {
    /// The firmware library in this process.
    Emulated {},
    /// A board behind a serial port.
    Serial {
        /// Device, for example /dev/ttyUSB0; a relative path is meant from the folder of the file.
        port: String,
        /// Baud rate; a pseudo-terminal takes any.
        #[serde(default = "baud")]
        baud: u32,
        /// Without a fresh command for this long the board goes to the zero-flow displacement and holds it, ms; left
        /// out: the board's own.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        watchdog_ms: Option<u16>,
        /// When it has held for this long it parks, ms; left out: the board's own.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        hold_watchdog_ms: Option<u16>,
    },
}

fn baud() -> u32 {
    3_000_000
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
        /// Part of the sensor read out; left out: as the camera is set.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        region: Option<Region>,
        /// Exposure, us; left out: as the camera is set.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        exposure_us: Option<f64>,
        /// 8 or 16 bits per pixel.
        #[serde(default = "bits")]
        bits: u16,
    },
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
            near_um: None,
            sample: None,
            actuator: ActuatorConfig::Emulated {},
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
    /// Render and localise.
    On,
    /// Positions with equivalent noise.
    Off,
}

/// Which clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
pub enum ClockKind {
    /// The machine's.
    Real,
    /// As fast as the machine can; deterministic.
    Virtual,
}

/// The devices of a rig.
pub struct Connected {
    /// Positions.
    pub source: Box<dyn PositionSource>,
    /// The PZT.
    pub actuator: Box<dyn Actuator>,
    /// Its clock.
    pub clock: Clock,
    /// What the user should know.
    pub warnings: Vec<String>,
    flow: CommandedFlow,
}

/// Where a plant's gain from PZT displacement to bead velocity is read for the tracker's prediction.
const FLOW_GAIN_AT: Hertz = Hertz(20.0);

impl Connected {
    /// Devices that were connected by somebody else.
    pub(crate) fn of(
        source: Box<dyn PositionSource>,
        actuator: Box<dyn Actuator>,
        clock: Clock,
    ) -> Result<Self, Failure> {
        Ok(Self {
            source,
            actuator,
            clock,
            warnings: Vec::new(),
            flow: nominal_flow()?,
        })
    }

    /// Lets the tracker predict the bead with this plant's gain; until then it takes that of Eq. (6). The prediction
    /// allows for a gain that is wrong by half.
    pub fn expect(&self, model: &Model) {
        self.flow
            .set_gain_per_s(model.plant.velocity_gain_at(FLOW_GAIN_AT));
    }
}

impl RigFile {
    /// Reads a rig.toml, or the defaults where there is none.
    pub fn load(path: Option<&Path>) -> Result<Self, Failure> {
        let Some(path) = path else {
            return Ok(Self::default());
        };
        let mut file: Self = quantities::read(path)?;
        file.validate(&path.display().to_string())?;
        // Paths in the file are meant from the file's own folder.
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
        if let ActuatorConfig::Serial { port, .. } = &mut file.actuator {
            // A relative path is a link beside the file if there is one, else a name of the system's own (COM5).
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

    fn validate(&self, name: &str) -> Result<(), Failure> {
        let say = |error: &dyn std::fmt::Display| {
            Failure::bad_input(
                format!("{name}: {error}"),
                "see the commented files under examples/",
            )
        };
        self.limits.validate().map_err(|error| say(&error))?;
        self.timing.validate().map_err(|error| say(&error))?;
        self.board.validate().map_err(|error| say(&error))?;
        self.emulator.validate().map_err(|error| say(&error))?;
        if let Some(cell) = &self.cell {
            CellFinder::new(1, 1, cell.finder)
                .map_err(|error| say(&format!("[cell.finder] {error}")))?;
            if matches!(self.camera, CameraConfig::Emulated {}) && self.emulator.cell.is_none() {
                return Err(say(
                    &"[cell]: the emulated rig has a bead; give it a cell with a table [emulator.cell]",
                ));
            }
        }
        if !(self.limits.low_um..=self.limits.high_um).contains(&self.first_neutral_um) {
            return Err(say(&format!(
                "first_neutral_um = {}: must be within the limits, {} to {} um",
                self.first_neutral_um, self.limits.low_um, self.limits.high_um
            )));
        }
        if let Some(near_um) = self.near_um.filter(|um| !um.is_finite()) {
            return Err(say(&format!(
                "near_um = {near_um}: must be a position in view, um"
            )));
        }
        let problem = self.calibration.as_ref().and_then(Calibration::problem);
        if let Some((key, value, must_be)) = problem {
            return Err(say(&format!(
                "[calibration] {key} = {value}: must be {must_be}"
            )));
        }
        if let Some(tracking) = &self.tracking {
            tracking
                .check()
                .map_err(|error| say(&format!("[tracking] {error}")))?;
        }
        Ok(())
    }

    /// Whether all of it is emulated in this process.
    pub fn is_emulated(&self) -> bool {
        matches!(
            (&self.actuator, &self.camera),
            (ActuatorConfig::Emulated {}, CameraConfig::Emulated {})
        )
    }

    /// Whether a cell is followed, so that its length and area are measured.
    pub fn follows_a_cell(&self) -> bool {
        match self.camera {
            CameraConfig::Emulated {} => self.emulator.cell.is_some(),
            _ => self.cell.is_some(),
        }
    }

    /// The file with the empty channel, if cells are seen against one.
    pub fn background(&self) -> Option<&Path> {
        match self.camera {
            CameraConfig::Emulated {} => None,
            _ => self.cell.as_ref()?.background.as_deref(),
        }
    }

    /// What finds cells against the empty channel.
    ///
    /// # Errors
    /// No background, or one that cannot be used.
    pub fn finder(&self) -> Result<CellFinder, Failure> {
        /// Frames of the empty channel that the emulated camera takes beforehand.
        const EMPTY_FRAMES: usize = 100;
        let cell = self.cell.clone().unwrap_or_default();
        match (&self.camera, &cell.background) {
            (CameraConfig::Emulated {}, _) => {
                let frames = World::empty_frames(&self.emulator, EMPTY_FRAMES);
                let (width, height) = (self.emulator.width_px, self.emulator.height_px);
                let buffer = |mono8| FrameBuffer::of_mono8(width.into(), height.into(), mono8);
                let frames: Vec<FrameBuffer> = frames
                    .map_err(Failure::input)?
                    .into_iter()
                    .map(buffer)
                    .collect();
                background::finder(&frames, "emulated camera", cell.finder)
            }
            (_, Some(path)) => background::load(path, cell.finder),
            (_, None) => {
                return Err(Failure::bad_input(
                    "[cell] background: a camera needs frames of the empty channel to see a cell",
                    "record them with cellpos background --rig RIG.toml --out empty.tif, then name that file here",
                ));
            }
        }
        .map_err(|error| {
            Failure::bad_input(error, "record the empty channel again: cellpos background")
        })
    }

    /// Settings of the localiser.
    ///
    /// # Errors
    /// A camera that shows something real, and nobody has said what its beads look like.
    pub fn bead_settings(&self) -> Result<LocaliserConfig, Failure> {
        match (&self.vision, &self.camera) {
            (Some(config), _) => Ok(config.clone()),
            (None, CameraConfig::Emulated {}) => Ok(LocaliserConfig::new(ProfileSpec::Ring {
                edge_px: self.emulator.bead_radius_px(),
            })),
            (None, _) => Err(Failure::bad_input(
                "[vision] is missing: what a bead looks like to this camera is not known",
                "record some frames with a bead in view; cellpos vision RECORDING then prints the table to paste",
            )),
        }
    }

    /// What finds beads in frames.
    ///
    /// # Errors
    /// As [`RigFile::bead_settings`], or a value of `[vision]` that cannot be.
    pub fn localiser(&self) -> Result<Localiser, Failure> {
        Localiser::new(self.bead_settings()?).map_err(|error| {
            Failure::bad_input(format!("[vision] {error}"), "see examples/rig.toml")
        })
    }

    /// A camera behind the tracker of this rig, with no command that it could know of.
    ///
    /// # Errors
    /// Settings that cannot be used, or no calibration.
    pub fn watch<C: Camera + 'static>(
        &self,
        camera: C,
        clock: &Clock,
    ) -> Result<Box<dyn PositionSource>, Failure> {
        let emulated = || {
            let middle_px = 0.5 * f64::from(self.emulator.width_px.saturating_sub(1));
            Calibration::along_rows(self.emulator.pixel_um, middle_px, 1.0)
        };
        let calibration = match self.camera {
            CameraConfig::Emulated {} => self.calibration.unwrap_or_else(emulated),
            _ => self.real_calibration()?,
        };
        self.tracked(camera, calibration, clock, &nominal_flow()?)
    }

    /// A camera with its tracker.
    fn tracked<C: Camera + 'static>(
        &self,
        camera: C,
        calibration: Calibration,
        clock: &Clock,
        flow: &CommandedFlow,
    ) -> Result<Box<dyn PositionSource>, Failure> {
        let config = self
            .tracking
            .unwrap_or_else(|| TrackerConfig::for_pixel_um(calibration.pixel_um));
        let followed: Followed = if self.follows_a_cell() {
            CellTracker::new(self.finder()?, config)
                .map_err(Failure::input)?
                .into()
        } else {
            Tracker::new(self.localiser()?, config)
                .map_err(Failure::input)?
                .into()
        };
        let source = VisionSource::new(camera, followed, calibration, clock.clone());
        let source = source.with_flow(flow.clone());
        Ok(Box::new(match self.near_um {
            Some(position_um) => source.near(position_um),
            None => source,
        }))
    }

    /// Connects camera and board.
    pub fn connect(&self, clock: ClockKind, frames: Frames) -> Result<Connected, Failure> {
        match (&self.actuator, &self.camera) {
            (ActuatorConfig::Emulated {}, CameraConfig::Emulated {}) => self.emulate(clock, frames),
            (ActuatorConfig::Serial { port, baud, .. }, camera)
                if *camera != (CameraConfig::Emulated {}) =>
            {
                if clock == ClockKind::Virtual || frames == Frames::Off {
                    return Err(Failure::bad_input(
                        "--clock virtual and --frames off are for the emulated rig",
                        "leave them out, or leave out --rig",
                    ));
                }
                self.open(port, *baud)
            }
            _ => Err(Failure::bad_input(
                "the emulated board moves the emulated bead only: [actuator] and [camera] must both be emulated, or neither",
                "run firmware-sim to have both behind a serial port and a socket",
            )),
        }
    }

    fn emulate(&self, clock: ClockKind, frames: Frames) -> Result<Connected, Failure> {
        let clock = match clock {
            ClockKind::Real => Clock::Real,
            ClockKind::Virtual => Clock::virtual_at(0),
        };
        let model = Model::load(&self.emulator.model).map_err(Failure::input)?;
        let emulated = EmulatedRig::new(self.board, &self.emulator, &model, clock.clone())
            .map_err(Failure::input)?;
        let flow = nominal_flow()?;
        let source: Box<dyn PositionSource> = match frames {
            Frames::Off => Box::new(emulated.positions()),
            Frames::On => {
                // A calibration of one's own, right or wrong, rehearses one of a real rig.
                let calibration = self.calibration.unwrap_or(emulated.calibration());
                self.tracked(emulated.camera(), calibration, &clock, &flow)?
            }
        };
        let board = emulated.actuator().map_err(Failure::failed)?;
        let mut warnings = Vec::new();
        if (self.emulator.latency_ms - self.timing.camera_delay_ms).abs() > 1e-9 {
            warnings.push(format!(
                "the emulated camera is {} ms late, the loop is set up for {} ms",
                self.emulator.latency_ms, self.timing.camera_delay_ms
            ));
        }
        Ok(Connected {
            source,
            actuator: Box::new(FlowTap::new(board, flow.clone(), clock.clone())),
            clock,
            warnings,
            flow,
        })
    }

    /// The camera of a real rig, running.
    pub fn open_camera(&self) -> Result<Box<dyn Camera>, Failure> {
        match &self.camera {
            CameraConfig::Emulated {} => Err(Failure::bad_input(
                "the emulated camera sees the emulated bead only",
                "write [camera] kind = \"socket\" or \"industrial\"",
            )),
            CameraConfig::Socket { socket, rate_hz } => {
                let (delay_ms, patience) = (self.timing.camera_delay_ms, Duration::from_secs(2));
                let camera = SocketCamera::connect(socket, *rate_hz, delay_ms, patience)
                    .map_err(Failure::failed)?;
                Ok(Box::new(camera))
            }
            #[cfg(feature = "aravis")]
            CameraConfig::Industrial {
                address,
                rate_hz,
                region,
                exposure_us,
                bits,
            } => {
                use cellpos_drivers::sources::industrial::{IndustrialCamera, IndustrialSettings};
                let settings = IndustrialSettings {
                    address: address.clone(),
                    region: *region,
                    rate_hz: *rate_hz,
                    exposure_us: *exposure_us,
                    bits: *bits,
                    latency_ms: self.timing.camera_delay_ms,
                    buffers: 50,
                };
                Ok(Box::new(
                    IndustrialCamera::open(settings).map_err(Failure::failed)?,
                ))
            }
            #[cfg(not(feature = "aravis"))]
            CameraConfig::Industrial { address, .. } => Err(Failure::bad_input(
                format!(
                    "[camera] address = \"{address}\": this program was built without industrial cameras"
                ),
                "install libaravis-dev and libusb-1.0-0-dev, then build with: cargo build --release --features aravis",
            )),
        }
    }

    fn real_calibration(&self) -> Result<Calibration, Failure> {
        self.calibration.ok_or_else(|| {
            Failure::bad_input(
                "a real camera needs a [calibration] with pixel_um, origin_px and sign",
                "measure pixel_um with a stage micrometer; see examples/rig.toml",
            )
        })
    }

    fn open(&self, port: &str, baud: u32) -> Result<Connected, Failure> {
        let calibration = self.real_calibration()?;
        let line = SerialLine::open(port, baud).map_err(|error| {
            Failure::bad_input(
                format!("[actuator] port = \"{port}\": {error}"),
                "is the board plugged in (or firmware-sim running), and may you read and write the device?",
            )
        })?;
        let mut warnings = Vec::new();
        if let Some(ms) = SerialLine::latency_timer_ms(port).filter(|&ms| ms > 1) {
            warnings.push(format!(
                "the USB adapter of {port} holds answers back for {ms} ms: write 1 to its latency_timer"
            ));
        }
        let board = BoardHost::connect(line, Clock::Real).map_err(Failure::failed)?;
        let flow = nominal_flow()?;
        let camera = self.open_camera()?;
        Ok(Connected {
            source: self.tracked(camera, calibration, &Clock::Real, &flow)?,
            actuator: Box::new(FlowTap::new(board, flow.clone(), Clock::Real)),
            clock: Clock::Real,
            warnings,
            flow,
        })
    }

    /// Camera and board without a tracker, for the LED test.
    pub fn open_for_led(&self) -> Result<(Box<dyn Camera>, BoardHost<SerialLine>), Failure> {
        let ActuatorConfig::Serial { port, baud, .. } = &self.actuator else {
            return Err(Failure::bad_input(
                "the LED test of a rig needs its board and its camera",
                "leave the test out with --led-edges 0",
            ));
        };
        let line = SerialLine::open(port, *baud).map_err(Failure::failed)?;
        let board = BoardHost::connect(line, Clock::Real).map_err(Failure::failed)?;
        Ok((self.open_camera()?, board))
    }

    /// Command watchdog and hold watchdog asked of the board, ms; `None` leaves the board's own.
    pub fn watchdogs_ms(&self) -> [Option<u16>; 2] {
        match self.actuator {
            ActuatorConfig::Serial {
                watchdog_ms,
                hold_watchdog_ms,
                ..
            } => [watchdog_ms, hold_watchdog_ms],
            ActuatorConfig::Emulated {} => [None, None],
        }
    }
}

/// The flow of Eq. (6)'s plant, nothing commanded yet.
fn nominal_flow() -> Result<CommandedFlow, Failure> {
    let nominal = Model::load("eq6").map_err(Failure::input)?;
    Ok(CommandedFlow::new(
        nominal.plant.velocity_gain_at(FLOW_GAIN_AT),
    ))
}
