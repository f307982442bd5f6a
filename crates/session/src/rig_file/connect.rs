//! Opens the devices that a rig file names.

use super::{ActuatorConfig, CameraConfig, ClockKind, Frames, PartnerTable, RigFile};
use crate::Failure;
use cellpos_drivers::program::ProgramLine;
use cellpos_drivers::serial::SerialLine;
use cellpos_drivers::socket::SocketCamera;
use cellpos_drivers::{
    BoardHost, Calibration, CommandedFlow, FlowTap, Followed, Pair, Port, VisionSource,
};
use cellpos_emulator::EmulatedRig;
use cellpos_numeric::units::Hertz;
use cellpos_plant::Model;
use cellpos_rig::{Actuator, Camera, Clock, PositionSource};
use cellpos_vision::{CellTracker, Tracker, TrackerConfig};
use std::time::Duration;

/// The devices of a rig.
pub struct Connected {
    /// Positions.
    pub source: Box<dyn PositionSource>,
    /// The PZT.
    pub actuator: Box<dyn Actuator>,
    /// Its clock.
    pub clock: Clock,
    /// Warnings for the user.
    pub warnings: Vec<String>,
    flow: CommandedFlow,
}

/// Frequency at which the tracker's prediction reads the plant's gain from PZT displacement to bead velocity.
const FLOW_GAIN_AT: Hertz = Hertz(20.0);

impl Connected {
    /// Devices that other code connected.
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

    /// Lets the tracker predict the bead with this plant's gain; before, it uses that of Eq. (6). The prediction
    /// tolerates a gain that is wrong by half.
    pub fn expect(&self, model: &Model) {
        self.flow
            .set_gain_per_s(model.plant.velocity_gain_at(FLOW_GAIN_AT));
    }
}

impl RigFile {
    /// A camera behind the tracker of this rig, which knows no command.
    ///
    /// # Errors
    /// Settings that cannot be used, or no calibration.
    pub fn watch<C: Camera + 'static>(
        &self,
        camera: C,
        clock: &Clock,
    ) -> Result<Box<dyn PositionSource>, Failure> {
        let emulated = || EmulatedRig::calibration_of(&self.emulator);
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
            _ if self.is_emulated() => self.emulate(clock, frames),
            (ActuatorConfig::Serial { .. } | ActuatorConfig::Program { .. }, camera)
                if *camera != (CameraConfig::Emulated {}) =>
            {
                if clock == ClockKind::Virtual || frames == Frames::Off {
                    return Err(Failure::bad_input(
                        "--clock virtual and --frames off are for the emulated rig",
                        "leave them out, or leave out --rig",
                    ));
                }
                self.open()
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
        let model = self.actuator.before(model);
        let (board, world) = (self.board, &self.emulator);
        let emulated = match self.partner.as_ref().map(PartnerTable::emulated) {
            Some(slow) => EmulatedRig::with_partner(board, world, &model, clock.clone(), &slow),
            None => EmulatedRig::new(board, world, &model, clock.clone()),
        }
        .map_err(Failure::input)?;
        let flow = nominal_flow()?;
        let source: Box<dyn PositionSource> = match frames {
            Frames::Off => Box::new(emulated.positions()),
            Frames::On => {
                // A calibration in the file, right or wrong, is used as on a real rig.
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
        let fast = Box::new(FlowTap::new(board, flow.clone(), clock.clone()));
        Ok(Connected {
            source,
            actuator: match &self.partner {
                Some(partner) => {
                    let slow = emulated.partner().map_err(Failure::failed)?;
                    Box::new(Pair::new(fast, Box::new(slow), partner.request()))
                }
                None => fast,
            },
            clock,
            warnings,
            flow,
        })
    }

    /// Lowest and highest position at which the picture shows a bead whole, um; of the emulated camera, the borders of its
    /// picture. A real camera is opened for this and closed again.
    ///
    /// # Errors
    /// There is no calibration, or the camera cannot be opened.
    pub fn whole_bead_um(&self) -> Result<[f64; 2], Failure> {
        if let CameraConfig::Emulated {} = self.camera {
            let half_um = self.emulator.half_frame_um();
            return Ok([-half_um, half_um]);
        }
        let calibration = self.real_calibration()?;
        let info = self.open_camera()?.info();
        let [low_um, high_um] = calibration.field_um(info.width_px, info.height_px);
        let template = self
            .vision
            .as_ref()
            .and_then(|vision| vision.template().ok());
        let radius_um =
            template.map_or(0.0, |template| calibration.pixel_um * template.radius_px());
        Ok([low_um + radius_um, high_um - radius_um])
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
                latency_ms,
            } => {
                use cellpos_drivers::sources::industrial::{IndustrialCamera, IndustrialSettings};
                let settings = IndustrialSettings {
                    address: address.clone(),
                    region: *region,
                    rate_hz: *rate_hz,
                    exposure_us: *exposure_us,
                    bits: *bits,
                    latency_ms: latency_ms.unwrap_or(CameraConfig::LATENCY_MS),
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

    /// The line to the board, or to the program that serves an actuator.
    ///
    /// # Errors
    /// It cannot be opened; the emulated board has none.
    pub fn line(&self) -> Result<Box<dyn Port>, Failure> {
        match &self.actuator {
            ActuatorConfig::Serial { port, baud, .. } => {
                Ok(Box::new(super::port::open(port, *baud)?))
            }
            ActuatorConfig::Program { socket, .. } => {
                let line = ProgramLine::open(socket).map_err(|error| {
                    Failure::bad_input(
                        format!("[actuator] socket = \"{}\": {error}", socket.display()),
                        "start the program that serves the actuator (cellpos.serve_actuator in Python) first",
                    )
                })?;
                Ok(Box::new(line))
            }
            ActuatorConfig::Emulated {} | ActuatorConfig::EmulatedPressure { .. } => Err(
                Failure::bad_input("the emulated board has no line", "name a serial port"),
            ),
        }
    }

    fn open(&self) -> Result<Connected, Failure> {
        let calibration = self.real_calibration()?;
        let line = self.line()?;
        let mut warnings = Vec::new();
        if let ActuatorConfig::Serial { port, .. } = &self.actuator
            && let Some(ms) = SerialLine::latency_timer_ms(port).filter(|&ms| ms > 1)
        {
            warnings.push(format!(
                "the USB adapter of {port} holds answers back for {ms} ms: write 1 to its latency_timer"
            ));
        }
        let board = BoardHost::connect(line, Clock::Real).map_err(Failure::failed)?;
        let flow = nominal_flow()?;
        let camera = self.open_camera()?;
        let fast = Box::new(FlowTap::new(board, flow.clone(), Clock::Real));
        Ok(Connected {
            source: self.tracked(camera, calibration, &Clock::Real, &flow)?,
            actuator: self.paired(fast, &mut warnings),
            clock: Clock::Real,
            warnings,
            flow,
        })
    }

    /// The PZT with its slow partner. If the partner is missing, the PZT runs alone and the user gets a warning.
    fn paired(&self, fast: Box<dyn Actuator>, warnings: &mut Vec<String>) -> Box<dyn Actuator> {
        let Some(partner) = &self.partner else {
            return fast;
        };
        // The reader of the file refuses a table without a socket.
        let socket = partner.socket.clone().unwrap_or_default();
        let line = ProgramLine::open(&socket).map_err(|error| error.to_string());
        let slow = line.and_then(|line| {
            BoardHost::connect(line, Clock::Real).map_err(|error| error.to_string())
        });
        match slow {
            Ok(slow) => Box::new(Pair::new(fast, Box::new(slow), partner.request())),
            Err(error) => {
                warnings.push(format!(
                    "the slow actuator is missing ([partner] socket = \"{}\": {error}): the run goes on within the PZT's stroke; \
                     start the program that serves it, then the run, to have both",
                    socket.display()
                ));
                fast
            }
        }
    }

    /// Camera and board without a tracker, for the LED test.
    pub fn open_for_led(&self) -> Result<(Box<dyn Camera>, BoardHost<SerialLine>), Failure> {
        let ActuatorConfig::Serial { port, baud, .. } = &self.actuator else {
            return Err(Failure::bad_input(
                "the LED test of a rig needs its board and its camera",
                "leave the test out with --led-edges 0",
            ));
        };
        let line = super::port::open(port, *baud)?;
        let board = BoardHost::connect(line, Clock::Real).map_err(Failure::failed)?;
        Ok((self.open_camera()?, board))
    }
}

/// The flow of Eq. (6)'s plant, before any command.
fn nominal_flow() -> Result<CommandedFlow, Failure> {
    let nominal = Model::load("eq6").map_err(Failure::input)?;
    Ok(CommandedFlow::new(
        nominal.plant.velocity_gain_at(FLOW_GAIN_AT),
    ))
}
