//! One bead position on its way from vision to the loop.

use cellpos_vision::{Decision, FixQuality, TrackState};

/// A bead position as it travels through the measurement ring. Times are nanoseconds of the run's clock.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measurement {
    /// Id of the frame, unwrapped: rises by one per exposed frame, so that a gap means lost frames.
    pub frame_id: u64,
    /// Middle of the exposure.
    pub mid_exposure_ns: i64,
    /// When the position was ready to be used.
    pub ready_ns: i64,
    /// Position along the channel, um; NaN without one.
    pub position_um: f64,
    /// Variance of the position, um^2; NaN without a position.
    pub variance_um2: f64,
    /// Verdict of vision on the fix itself.
    pub verdict: FixQuality,
    /// State of the tracker after this frame, and its decision; `None` without a tracker. A good fix that the tracker
    /// refuses (another bead, too far from the prediction) has no position.
    pub track: Option<(TrackState, Decision)>,
    /// Peak contrast over pixel noise; NaN without picture.
    pub snr: f64,
    /// Length of the cell along the channel, um; NaN for a bead, or when it is not measured.
    pub length_um: f64,
    /// Projected area of the cell, um^2; NaN for a bead, or when it is not measured.
    pub area_um2: f64,
    /// Standard deviation of `length_um`, um; NaN without one.
    pub length_sd_um: f64,
    /// Standard deviation of `area_um2`, um^2; NaN without one.
    pub area_sd_um2: f64,
    /// True bead position at `ready_ns`, um (emulated rig only, else NaN).
    pub true_um: f64,
    /// True PZT displacement at `ready_ns`, um (emulated rig only, else NaN).
    pub true_pzt_um: f64,
}

impl Measurement {
    /// Whether the loop may use the position: a good fix of the tracked bead.
    pub fn is_usable(&self) -> bool {
        self.verdict == FixQuality::Good && self.position_um.is_finite()
    }
}
