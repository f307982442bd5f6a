//! Settings of the emulated world.

use crate::cell::CellConfig;
use crate::error::{WorldError, within};
use crate::faults::Faults;
use crate::look::BeadLook;
use serde::{Deserialize, Serialize};

/// The emulated world, the table `[emulator]` of rig.toml. Every key may be left out.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct WorldConfig {
    /// Fixes every random number.
    pub seed: u64,
    /// Plant and effects: `eq6` or the path of a model.toml.
    pub model: String,
    /// PZT displacement at which the bead is at rest, um. Replaces the model's working point.
    pub neutral_um: f64,
    /// Diffusion coefficient of the bead, um^2/s. Replaces the model's.
    pub diffusion_um2_per_s: f64,
    /// Flow independent of the PZT, um/s; added to a flow-drift of the model.
    pub drift_um_per_s: f64,
    /// Bead position at the start, um from the middle of the frame.
    pub start_um: f64,
    /// Pixels per row.
    pub width_px: u16,
    /// Rows.
    pub height_px: u16,
    /// Size of a pixel in the object plane, um.
    pub pixel_um: f64,
    /// Frames per second, Hz.
    pub rate_hz: f64,
    /// Exposure time, ms.
    pub exposure_ms: f64,
    /// From the middle of an exposure to the delivery of its frame, ms.
    pub latency_ms: f64,
    /// Radius of the bead, um: where its profile first crosses the background; of no effect with a cell.
    pub bead_radius_um: f64,
    /// The look of the bead.
    pub bead_look: BeadLook,
    /// Contrast of the middle of bead or cell against the background, grey levels of 8 bits.
    pub contrast_grey: f64,
    /// Background, grey levels.
    pub background_grey: f64,
    /// Noise without light, grey levels RMS.
    pub read_noise_grey: f64,
    /// Photo-electrons per grey level: shot noise of variance `grey / electrons_per_grey`.
    pub electrons_per_grey: f64,
    /// Localisation noise of positions delivered without pictures, um RMS. Default: as from pictures.
    pub localisation_um: Option<f64>,
    /// Time after which a new bead comes, once the old one has left the frame, ms. Left out: never.
    pub new_bead_after_ms: Option<f64>,
    /// Switches off all `Imperfections` of a real rig, except those whose key is given.
    pub ideal: bool,
    /// `Imperfections::zero_flow_wander_um`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub zero_flow_wander_um: Option<f64>,
    /// `Imperfections::zero_flow_wander_time_s`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub zero_flow_wander_time_s: Option<f64>,
    /// `Imperfections::zero_flow_drift_um_per_s`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub zero_flow_drift_um_per_s: Option<f64>,
    /// `Imperfections::lateral_um`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lateral_um: Option<f64>,
    /// `Imperfections::tilt_deg`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tilt_deg: Option<f64>,
    /// `Imperfections::focus_wander`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub focus_wander: Option<f64>,
    /// `Imperfections::focus_time_s`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub focus_time_s: Option<f64>,
    /// `Imperfections::dust`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub dust: Option<u16>,
    /// `Imperfections::light_slope`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub light_slope: Option<f64>,
    /// `Imperfections::vignette`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub vignette: Option<f64>,
    /// `Imperfections::wall_grey`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub wall_grey: Option<f64>,
    /// `Imperfections::camera_clock_ppm`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub camera_clock_ppm: Option<f64>,
    /// `Imperfections::exposure_jitter_us`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub exposure_jitter_us: Option<f64>,
    /// `Imperfections::arrival_jitter_us`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub arrival_jitter_us: Option<f64>,
    /// A cell and its constriction. Left out: a bead.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cell: Option<CellConfig>,
    /// What goes wrong.
    pub faults: Faults,
}

impl Default for WorldConfig {
    fn default() -> Self {
        Self {
            seed: 1,
            model: "eq6".to_owned(),
            neutral_um: 20.0,
            diffusion_um2_per_s: 0.33,
            drift_um_per_s: 3.0,
            start_um: 0.0,
            width_px: 256,
            height_px: 32,
            pixel_um: 0.1,
            rate_hz: 1000.0,
            exposure_ms: 0.5,
            latency_ms: 2.0,
            bead_radius_um: 0.5,
            bead_look: BeadLook::Ring,
            contrast_grey: 80.0,
            background_grey: 100.0,
            read_noise_grey: 1.0,
            electrons_per_grey: 40.0,
            localisation_um: None,
            new_bead_after_ms: None,
            ideal: false,
            zero_flow_wander_um: None,
            zero_flow_wander_time_s: None,
            zero_flow_drift_um_per_s: None,
            lateral_um: None,
            tilt_deg: None,
            focus_wander: None,
            focus_time_s: None,
            dust: None,
            light_slope: None,
            vignette: None,
            wall_grey: None,
            camera_clock_ppm: None,
            exposure_jitter_us: None,
            arrival_jitter_us: None,
            cell: None,
            faults: Faults::default(),
        }
    }
}

impl WorldConfig {
    /// A rig as in a paper: nothing but the plant, diffusion, drift and the noise of the pictures.
    pub fn ideal() -> Self {
        Self {
            ideal: true,
            ..Self::default()
        }
    }

    /// A rig with the `Imperfections` of a real one.
    pub fn real() -> Self {
        Self {
            ideal: false,
            ..Self::default()
        }
    }

    /// Column of position 0: the middle of the frame, px (pixel centres at whole numbers).
    pub fn origin_x_px(&self) -> f64 {
        0.5 * (f64::from(self.width_px) - 1.0)
    }

    /// Row of the middle line of the frame, px.
    pub fn origin_y_px(&self) -> f64 {
        0.5 * (f64::from(self.height_px) - 1.0)
    }

    /// Position along the channel of a column, um.
    pub fn um_from_px(&self, x_px: f64) -> f64 {
        (x_px - self.origin_x_px()) * self.pixel_um
    }

    /// Column of a position along the channel, px.
    pub fn px_from_um(&self, x_um: f64) -> f64 {
        self.origin_x_px() + x_um / self.pixel_um
    }

    /// Radius of the bead, px.
    pub fn bead_radius_px(&self) -> f64 {
        self.bead_radius_um / self.pixel_um
    }

    /// Time from frame to frame, ns.
    pub fn period_ns(&self) -> i64 {
        (1e9 / self.rate_hz).round() as i64
    }

    /// Checks every value.
    ///
    /// # Errors
    /// [`WorldError::Value`] for the first value that cannot be.
    pub fn validate(&self) -> Result<(), WorldError> {
        self.validate_motion()?;
        self.validate_frame()?;
        self.validate_picture()?;
        self.validate_imperfections()?;
        if let Some(cell) = &self.cell {
            self.validate_cell(cell)?;
        }
        self.faults.validate()
    }

    fn validate_motion(&self) -> Result<(), WorldError> {
        within(
            "neutral_um",
            self.neutral_um,
            -2000.0,
            2000.0,
            "-2000..2000 um",
        )?;
        within(
            "diffusion_um2_per_s",
            self.diffusion_um2_per_s,
            0.0,
            1e4,
            "0..10000 um^2/s",
        )?;
        within(
            "drift_um_per_s",
            self.drift_um_per_s,
            -1e4,
            1e4,
            "-10000..10000 um/s",
        )?;
        within("start_um", self.start_um, -1e4, 1e4, "-10000..10000 um")?;
        Ok(())
    }

    fn validate_frame(&self) -> Result<(), WorldError> {
        within(
            "width_px",
            f64::from(self.width_px),
            8.0,
            4096.0,
            "8..4096 px",
        )?;
        within(
            "height_px",
            f64::from(self.height_px),
            8.0,
            4096.0,
            "8..4096 px",
        )?;
        within("pixel_um", self.pixel_um, 1e-3, 100.0, "0.001..100 um")?;
        within("rate_hz", self.rate_hz, 1.0, 20_000.0, "1..20000 Hz")?;
        let period_ms = 1000.0 / self.rate_hz;
        within(
            "exposure_ms",
            self.exposure_ms,
            0.0,
            period_ms,
            "0 ms to one frame period",
        )?;
        let least_ms = 0.5 * self.exposure_ms;
        within(
            "latency_ms",
            self.latency_ms,
            least_ms,
            100.0 * period_ms,
            "half the exposure to 100 frame periods, in ms",
        )?;
        Ok(())
    }

    fn validate_picture(&self) -> Result<(), WorldError> {
        within(
            "bead_radius_um",
            self.bead_radius_um,
            self.pixel_um,
            100.0 * self.pixel_um,
            "1..100 pixels, in um",
        )?;
        within(
            "contrast_grey",
            self.contrast_grey,
            -255.0,
            255.0,
            "-255..255 grey levels",
        )?;
        within(
            "background_grey",
            self.background_grey,
            0.0,
            255.0,
            "0..255 grey levels",
        )?;
        within(
            "read_noise_grey",
            self.read_noise_grey,
            0.0,
            100.0,
            "0..100 grey levels",
        )?;
        within(
            "electrons_per_grey",
            self.electrons_per_grey,
            1e-3,
            1e9,
            "above 0",
        )?;
        if let Some(um) = self.localisation_um {
            within("localisation_um", um, 0.0, 100.0, "0..100 um")?;
        }
        if let Some(ms) = self.new_bead_after_ms {
            within("new_bead_after_ms", ms, 0.0, 1e9, "0 or more ms")?;
        }
        Ok(())
    }

    fn validate_cell(&self, cell: &CellConfig) -> Result<(), WorldError> {
        cell.validate()?;
        let tilt_deg = self.imperfections().tilt_deg;
        within(
            "tilt_deg",
            tilt_deg,
            0.0,
            0.0,
            "0 degrees with a cell: its constriction is along the rows",
        )?;
        let across_um = f64::from(self.height_px) * self.pixel_um;
        let along_um = f64::from(self.width_px) * self.pixel_um;
        let lateral_um = self.imperfections().lateral_um;
        let room_um = across_um - 2.0 * lateral_um - 2.0 * self.pixel_um;
        within(
            "cell.rest_um",
            cell.rest_um,
            0.1,
            room_um,
            "less than the frame's height less lateral_um and a pixel on either side: enlarge [emulator] height_px",
        )?;
        let most_um = cell.rest_um * cell.stretch_first.max(cell.stretch_last);
        within(
            "cell: rest_um times the larger stretch",
            most_um,
            0.1,
            along_um,
            "less than the frame's width: enlarge [emulator] width_px",
        )?;
        Ok(())
    }

    /// Half of the frame's width, um.
    pub fn half_frame_um(&self) -> f64 {
        0.5 * f64::from(self.width_px) * self.pixel_um
    }

    /// Half of the visible length along the channel, um.
    pub(crate) fn half_length_um(&self, length_um: Option<f64>) -> f64 {
        length_um.map_or(self.bead_radius_um, |um| 0.5 * um)
    }
}
