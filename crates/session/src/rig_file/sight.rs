//! Builds the localiser of a bead or a cell for the frames of a rig.

use super::{CameraConfig, RigFile};
use crate::Failure;
use cellpos_drivers::background;
use cellpos_emulator::World;
use cellpos_rig::FrameBuffer;
use cellpos_vision::{CellFinder, Localiser, LocaliserConfig, ProfileSpec};

impl RigFile {
    /// The localiser of cells against the empty channel.
    ///
    /// # Errors
    /// The background is missing or cannot be used.
    pub fn finder(&self) -> Result<CellFinder, Failure> {
        /// Frames of the empty channel that the emulated camera takes first.
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
    /// A real camera without a description of its beads.
    pub fn bead_settings(&self) -> Result<LocaliserConfig, Failure> {
        match (&self.vision, &self.camera) {
            (Some(config), _) => Ok(config.clone()),
            (None, CameraConfig::Emulated {}) => Ok(LocaliserConfig::new(ProfileSpec::Ring {
                edge_px: self.emulator.bead_radius_px(),
            })),
            (None, _) => Err(Failure::bad_input(
                "[vision] is missing: what a bead looks like to this camera is not known",
                "bring a bead into view; cellpos camera --rig RIG --find-beads beads.png finds the settings and writes the table",
            )),
        }
    }

    /// The localiser of beads.
    ///
    /// # Errors
    /// As [`RigFile::bead_settings`], or an invalid value of `[vision]`.
    pub fn localiser(&self) -> Result<Localiser, Failure> {
        Localiser::new(self.bead_settings()?).map_err(|error| {
            Failure::bad_input(format!("[vision] {error}"), "see examples/rig.toml")
        })
    }
}
