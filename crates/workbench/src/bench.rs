//! The devices of a rig file, without a tracker.

use cellpos_drivers::{BoardHost, Port};
use cellpos_emulator::EmulatedRig;
use cellpos_plant::Model;
use cellpos_rig::{Camera, Clock};
use cellpos_session::rig_file::CameraConfig;
use cellpos_session::{Failure, RigFile};

/// Board and camera on the machine's clock; each is opened at its first use.
pub struct Bench {
    file: RigFile,
    emulated: Option<EmulatedRig>,
}

/// A board at the end of any port.
pub(crate) type Board = BoardHost<Box<dyn Port>>;

impl Bench {
    /// A bench with the devices of a rig file. Opens nothing yet.
    ///
    /// # Errors
    /// An invalid value of the emulated rig.
    pub fn of(file: RigFile) -> Result<Self, Failure> {
        let emulated =
            if file.actuator.is_emulated() || matches!(file.camera, CameraConfig::Emulated {}) {
                let model = Model::load(&file.emulator.model).map_err(Failure::input)?;
                let model = file.actuator.before(model);
                let rig = EmulatedRig::new(file.board, &file.emulator, &model, Clock::Real);
                Some(rig.map_err(Failure::input)?)
            } else {
                None
            };
        Ok(Self { file, emulated })
    }

    /// The rig file.
    pub fn file(&self) -> &RigFile {
        &self.file
    }

    /// Opens the board.
    ///
    /// # Errors
    /// The port cannot be opened, or no board answers.
    pub fn board(&self) -> Result<Board, Failure> {
        BoardHost::connect(self.line()?, Clock::Real).map_err(Failure::failed)
    }

    /// The line to the board; no message was sent yet.
    ///
    /// # Errors
    /// The port cannot be opened.
    pub fn line(&self) -> Result<Box<dyn Port>, Failure> {
        match &self.emulated {
            Some(rig) if self.file.actuator.is_emulated() => Ok(Box::new(rig.port())),
            _ => self.file.line(),
        }
    }

    /// Opens the camera.
    ///
    /// # Errors
    /// The camera is not there, or delivers nothing.
    pub fn camera(&self) -> Result<Box<dyn Camera>, Failure> {
        match (&self.file.camera, &self.emulated) {
            (CameraConfig::Emulated {}, Some(rig)) => Ok(Box::new(rig.camera())),
            _ => self.file.open_camera(),
        }
    }
}
