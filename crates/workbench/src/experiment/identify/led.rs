//! The LED test: switching times, and brightness of the frames.

use cellpos_ident::delay::{Brightness, DelayEstimate, SeenEdge, delay_from_edges, find_edges};
use cellpos_rig::{FrameBuffer, FrameStamp};
use cellpos_session::rig_file::CameraConfig;
use cellpos_session::{Failure, RigFile};

/// Frames of the test as they come.
#[derive(Debug, Clone, Default)]
pub struct LitFrames {
    mid_s: Vec<f64>,
    exposure_ns: i64,
    grey: Vec<f64>,
}

impl LitFrames {
    /// Takes the next frame; skips one that is stamped before the last.
    pub fn push(&mut self, stamp: &FrameStamp, buffer: &FrameBuffer) {
        let mid_s = stamp.mid_exposure_ns as f64 * 1e-9;
        if self.mid_s.last().is_none_or(|last| mid_s > *last) {
            self.mid_s.push(mid_s);
            self.grey.push(mean_grey(buffer));
            self.exposure_ns = stamp.exposure_ns;
        }
    }
}

/// A delay test and its observations.
pub struct DelayTest {
    /// From the command to the exposure that shows it, by the frames' stamps; [`DelayTest::up_to_the_tick`] adds the age of the frame at
    /// its tick.
    pub estimate: DelayEstimate,
    /// Edges seen.
    pub seen: Vec<SeenEdge>,
    /// When the LED was switched, s of the rig's clock.
    pub switched_s: Vec<f64>,
    /// Middles of the exposures, s.
    pub frame_s: Vec<f64>,
    /// Their mean grey levels.
    pub grey: Vec<f64>,
    /// Time of a command to the board, s: half of a round trip; `None` if not measured.
    pub line_s: Option<f64>,
}

/// Error of time stamps that gives a warning, as a fraction of the period.
const WORTH_SAYING: f64 = 0.1;

impl DelayTest {
    /// The delay between the switching times of the LED and the frames.
    ///
    /// # Errors
    /// Fewer than half of the edges show.
    pub fn evaluate(switched_s: Vec<f64>, frames: LitFrames) -> Result<Self, Failure> {
        let brightness = Brightness {
            mid_s: &frames.mid_s,
            exposure_s: frames.exposure_ns as f64 * 1e-9,
            grey: &frames.grey,
        };
        let seen = find_edges(&switched_s, brightness).map_err(Failure::failed)?;
        let estimate = delay_from_edges(&seen).map_err(Failure::failed)?;
        Ok(Self {
            estimate,
            seen,
            switched_s,
            frame_s: frames.mid_s,
            grey: frames.grey,
            line_s: None,
        })
    }

    /// Remedy for time stamps that are not those of the exposures: the delay of the LED test beyond the line is their error. Call it
    /// before [`DelayTest::up_to_the_tick`].
    pub fn stamps_off(&self, file: &RigFile) -> Option<String> {
        let off_s = self.estimate.delay_s - self.line_s?;
        // The two directions of the line may differ in time.
        let unsure_s = self.line_s? + 0.5 * (self.estimate.ci95_s[1] - self.estimate.ci95_s[0]);
        if off_s.abs() < (WORTH_SAYING * 1e-6 * file.timing.period_us).max(unsure_s) {
            return None;
        }
        let off_ms = off_s * 1e3;
        Some(match &file.camera {
            CameraConfig::Industrial { latency_ms, .. } => {
                let set_ms = latency_ms.unwrap_or(CameraConfig::LATENCY_MS);
                format!(
                    "by the LED the exposures are {off_ms:+.2} ms from their time stamps, which [camera] latency_ms = {set_ms} makes: \
                     write latency_ms = {:.2} and identify again",
                    set_ms + off_ms
                )
            }
            _ => format!(
                "by the LED the exposures are {off_ms:+.2} ms from the time stamps that the camera's server gives them: correct the \
                 server, or find what delays the LED"
            ),
        })
    }

    /// The delay of a record, in which a position belongs to the tick that used it: the age of the frames at their ticks is included.
    pub fn up_to_the_tick(&mut self, age_s: f64) {
        self.estimate.delay_s += age_s;
        self.estimate.ci95_s = self.estimate.ci95_s.map(|end| end + age_s);
    }

    /// The warning if the test leaves the delay open by more than a tenth of a millisecond.
    pub fn vague(&self) -> Option<String> {
        /// 10.8 degrees at 300 Hz.
        const WORTH_SAYING_S: f64 = 1e-4;
        let [low, high] = self.estimate.ci95_s;
        let half_s = 0.5 * (high - low) + self.estimate.not_accounted_s;
        (half_s > WORTH_SAYING_S).then(|| {
            format!(
                "the LED test leaves the delay open by +-{:.2} ms: the machine or the line stalled too often, or too few edges \
                 showed; measure again on an idle machine, or with more --led-edges",
                half_s * 1e3
            )
        })
    }
}

/// Mean grey level of a frame.
fn mean_grey(buffer: &FrameBuffer) -> f64 {
    if buffer.bits > 8 {
        let sum: f64 = buffer.mono16.iter().map(|&p| f64::from(p)).sum();
        sum / buffer.mono16.len().max(1) as f64
    } else {
        let sum: f64 = buffer.mono8.iter().map(|&p| f64::from(p)).sum();
        sum / buffer.mono8.len().max(1) as f64
    }
}
