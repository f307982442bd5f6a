//! Settings of the tracker, and its statements about each frame.

use crate::config::ConfigError;
use crate::fix::{Fix, FixQuality};
use serde::{Deserialize, Serialize};

/// The commanded motion up to the next frame.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Commanded {
    /// Mean flow velocity since the frame before, px/s.
    pub flow_px_per_s: (f64, f64),
    /// Way that the flow goes while the frame is exposed, px: a fast bead's image is drawn out along it. Noughts where the
    /// exposure is not known.
    pub streak_px: (f64, f64),
    /// Length of the second half of that way less the first, px.
    pub turn_px: (f64, f64),
    /// Exposure time, s; 0 if unknown.
    pub exposure_s: f64,
}

impl From<(f64, f64)> for Commanded {
    /// A flow velocity in px/s, and a shutter too fast to matter.
    fn from(flow_px_per_s: (f64, f64)) -> Self {
        Commanded {
            flow_px_per_s,
            streak_px: (0.0, 0.0),
            turn_px: (0.0, 0.0),
            exposure_s: 0.0,
        }
    }
}

/// Settings of a [`crate::Tracker`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrackerConfig {
    /// Diffusion coefficient of the bead, px^2/s.
    pub diffusion_px2_per_s: f64,
    /// How fast the velocity that no command explains may change: px/s per square root of a second.
    pub velocity_walk_px_per_s15: f64,
    /// Share of the commanded displacement per frame that may be wrong, 0 to 2.
    pub flow_error: f64,
    /// A fix is taken within this many standard deviations of the prediction ...
    pub gate_sigma: f64,
    /// ... or within this distance of it, px.
    pub least_gate_px: f64,
    /// Fastest flow that the actuator can drive, px/s. A bead that is alone in the picture is taken wherever such a flow can
    /// have carried it since its last fix.
    pub fastest_flow_px_per_s: f64,
    /// Frames in a row that must agree before a bead counts as tracked.
    pub confirm_frames: u32,
    /// Time without an accepted fix after which a bead is lost, s.
    pub coast_limit_s: f64,
    /// Largest change of the peak contrast, as a fraction of the tracked bead's.
    pub max_amplitude_change: f64,
    /// Largest change of the size, as a fraction of the tracked bead's.
    pub max_size_change: f64,
    /// Largest residual ratio, in multiples of the tracked bead's (at least of 1), unless the bead is alone in the picture.
    pub max_residual_growth: f64,
    /// How much better (difference of minus twice the log likelihood) one reading of the frame must be than another to separate
    /// the bead from a neighbour.
    pub certainty: f64,
    /// Frames between looks for neighbours while none is near.
    pub neighbour_stride: u32,
}

impl Default for TrackerConfig {
    /// For a 1 um bead at 0.1 um/px and 1000 frames/s.
    fn default() -> Self {
        TrackerConfig {
            diffusion_px2_per_s: 33.0,
            velocity_walk_px_per_s15: 300.0,
            flow_error: 0.5,
            gate_sigma: 5.0,
            least_gate_px: 1.0,
            // The stroke of 45 um times the gain of 380 /s.
            fastest_flow_px_per_s: 171_000.0,
            confirm_frames: 3,
            coast_limit_s: 0.05,
            max_amplitude_change: 0.35,
            max_size_change: 0.12,
            max_residual_growth: 4.0,
            certainty: 14.0,
            neighbour_stride: 20,
        }
    }
}

impl TrackerConfig {
    /// The defaults for another size of the pixel: their values in micrometres stay.
    pub fn for_pixel_um(pixel_um: f64) -> Self {
        let scale = 0.1 / pixel_um;
        let default = Self::default();
        TrackerConfig {
            diffusion_px2_per_s: default.diffusion_px2_per_s * scale * scale,
            velocity_walk_px_per_s15: default.velocity_walk_px_per_s15 * scale,
            fastest_flow_px_per_s: default.fastest_flow_px_per_s * scale,
            ..default
        }
    }

    /// Checks every setting.
    ///
    /// # Errors
    /// Names the first that cannot be used.
    pub fn check(&self) -> Result<(), ConfigError> {
        let range = |key, value: f64, low: f64, high: f64, must_be| {
            ConfigError::unless(value >= low && value <= high, key, value, must_be)
        };
        range(
            "diffusion_px2_per_s",
            self.diffusion_px2_per_s,
            0.0,
            1e6,
            "0 to 1e6 px^2/s",
        )?;
        range(
            "velocity_walk_px_per_s15",
            self.velocity_walk_px_per_s15,
            0.0,
            1e6,
            "0 to 1e6 px/s per root second",
        )?;
        range(
            "flow_error",
            self.flow_error,
            0.0,
            2.0,
            "a fraction from 0 to 2",
        )?;
        range(
            "gate_sigma",
            self.gate_sigma,
            2.0,
            20.0,
            "2 to 20 standard deviations",
        )?;
        range(
            "least_gate_px",
            self.least_gate_px,
            0.05,
            100.0,
            "0.05 to 100 px",
        )?;
        range(
            "fastest_flow_px_per_s",
            self.fastest_flow_px_per_s,
            0.0,
            1e9,
            "0 to 1e9 px/s",
        )?;
        range(
            "confirm_frames",
            f64::from(self.confirm_frames),
            1.0,
            1000.0,
            "1 to 1000 frames",
        )?;
        range(
            "coast_limit_s",
            self.coast_limit_s,
            1e-4,
            100.0,
            "0.0001 to 100 s",
        )?;
        range(
            "max_amplitude_change",
            self.max_amplitude_change,
            0.01,
            0.9,
            "a fraction from 0.01 to 0.9",
        )?;
        range(
            "max_size_change",
            self.max_size_change,
            0.01,
            0.9,
            "a fraction from 0.01 to 0.9",
        )?;
        range(
            "max_residual_growth",
            self.max_residual_growth,
            1.0,
            1000.0,
            "1 to 1000",
        )?;
        range("certainty", self.certainty, 1.0, 100.0, "1 to 100")?;
        range(
            "neighbour_stride",
            f64::from(self.neighbour_stride),
            1.0,
            1000.0,
            "1 to 1000 frames",
        )
    }
}

/// Where the tracker stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
#[repr(u8)]
pub enum TrackState {
    /// No bead chosen yet.
    Searching = 0,
    /// The bead is seen in this frame and it is the chosen one.
    Tracking = 1,
    /// Not seen (or not told from another) for less than the coast limit: the position is predicted.
    Coasting = 2,
    /// Not seen for longer. Only a bead that agrees in size, intensity and residual brings it back.
    Lost = 3,
}

impl TrackState {
    /// The state of a number in a record.
    pub fn from_number(number: u8) -> Option<Self> {
        [
            TrackState::Searching,
            TrackState::Tracking,
            TrackState::Coasting,
            TrackState::Lost,
        ]
        .into_iter()
        .find(|state| *state as u8 == number)
    }
}

/// Why a frame was used or not; one per frame, for the record.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
#[repr(u8)]
pub enum Decision {
    /// The fix was taken.
    Accepted = 0,
    /// Nothing bead-like in the frame.
    NothingFound = 1,
    /// A bead was found and is being confirmed.
    Confirming = 2,
    /// The fix's verdict was no signal.
    NoSignal = 3,
    /// The residual says that this is not one bead of this kind: merged with another, or out of focus.
    Merged = 4,
    /// The bead is cut by the frame's border.
    AtBorder = 5,
    /// The fit did not converge.
    NotConverged = 6,
    /// A bead, but further from the prediction than any flow can have carried it, or as far as another bead may be.
    OutsideGate = 7,
    /// A bead at the right place with another intensity, size or residual.
    OtherBead = 8,
    /// Two readings of the frame, one for each of two beads, are equally good.
    Ambiguous = 9,
    /// The fix was taken after coasting.
    Regained = 10,
    /// The fix was taken after the bead had been lost; the record must show it, for it may be another bead.
    Reacquired = 11,
    /// No frame.
    NoFrame = 12,
    /// The frame came twice, out of order or with an old time stamp, and was not looked at.
    Stale = 13,
    /// The object stays in its place while cells pass, or while the PZT moves: dirt, a wall, a bead on the glass.
    Stays = 14,
    /// Another cell touches it, so that its size is not its own.
    InContact = 15,
    /// The fix was taken, but noise, focus or blur near the end of the range that the settings hold for: beyond it there is no fix.
    NearLimit = 16,
    /// The look at the frame before took longer than a frame, and a newer frame had come: not looked at.
    PassedOver = 17,
}

impl Decision {
    /// The decision for a fix that cannot be used.
    pub(super) fn refusing(verdict: FixQuality) -> Self {
        match verdict {
            FixQuality::NoSignal => Decision::NoSignal,
            FixQuality::BadFit => Decision::Merged,
            FixQuality::AtBorder => Decision::AtBorder,
            FixQuality::NotConverged => Decision::NotConverged,
            FixQuality::Good => Decision::OtherBead,
        }
    }

    /// The decision of a number in a record.
    pub fn from_number(number: u8) -> Option<Self> {
        use Decision::*;
        [
            Accepted,
            NothingFound,
            Confirming,
            NoSignal,
            Merged,
            AtBorder,
            NotConverged,
            OutsideGate,
            OtherBead,
            Ambiguous,
            Regained,
            Reacquired,
            NoFrame,
            Stale,
            Stays,
            InContact,
            NearLimit,
            PassedOver,
        ]
        .into_iter()
        .find(|decision| *decision as u8 == number)
    }

    /// Whether the frame's fix was taken as the bead's position.
    pub fn is_accepted(self) -> bool {
        matches!(
            self,
            Decision::Accepted | Decision::Regained | Decision::Reacquired | Decision::NearLimit
        )
    }
}

/// What the tracker made of a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackStep {
    /// State after the frame.
    pub state: TrackState,
    /// Why.
    pub decision: Decision,
    /// The fix considered, taken or not.
    pub fix: Fix,
    /// Filtered position, or predicted when the fix was not taken, px.
    pub x_px: f64,
    /// Filtered position, or predicted when the fix was not taken, px.
    pub y_px: f64,
    /// Standard deviation of that position, the larger axis, px; infinite while searching.
    pub sd_px: f64,
    /// Distance of the fix from the prediction in standard deviations; not a number without a prediction.
    pub innovation_sigma: f64,
    /// Time since the last fix taken, s.
    pub coasted_s: f64,
    /// Other beads known near by.
    pub neighbours: u8,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn states_and_decisions_come_back_from_their_numbers() {
        for number in 0..=255 {
            if let Some(state) = TrackState::from_number(number) {
                assert_eq!(state as u8, number);
            }
            if let Some(decision) = Decision::from_number(number) {
                assert_eq!(decision as u8, number);
            }
        }
        assert_eq!((0..=255).filter_map(TrackState::from_number).count(), 4);
        assert_eq!((0..=255).filter_map(Decision::from_number).count(), 18);
    }

    #[test]
    fn the_defaults_mean_the_same_in_micrometres_whatever_the_pixel() {
        let c = TrackerConfig::for_pixel_um(0.2);
        assert!((c.diffusion_px2_per_s * 0.04 - 0.33).abs() < 1e-12);
        assert!((c.velocity_walk_px_per_s15 * 0.2 - 30.0).abs() < 1e-12);
        assert_eq!(TrackerConfig::for_pixel_um(0.1), TrackerConfig::default());
    }
}
