//! The LED test: switching times, and brightness of the frames.

use cellpos_drivers::{BoardHost, Port};
use cellpos_ident::delay::{Brightness, DelayEstimate, SeenEdge, delay_test, dithered_edges};
use cellpos_rig::clock::monotonic_ns;
use cellpos_rig::{Camera, Clock, FrameBuffer, FrameStamp};
use cellpos_session::rig_file::CameraConfig;
use cellpos_session::{Failure, RigFile};
use std::time::Duration;

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
    /// The frames show the LED at one instant of their exposure.
    shows_instants: bool,
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
        let (seen, estimate) = delay_test(&switched_s, brightness).map_err(Failure::failed)?;
        Ok(Self {
            shows_instants: estimate.not_accounted_s > 0.0,
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
        let half_s = 0.5 * (self.estimate.ci95_s[1] - self.estimate.ci95_s[0]);
        let unsure_s = self.line_s? + half_s + self.estimate.not_accounted_s;
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
        let why = if self.shows_instants {
            "its frames show the LED at one instant of their exposure and not over all of it, as those of a simulated camera may"
        } else if self.estimate.not_accounted_s > WORTH_SAYING_S {
            "the line or the board lets messages wait for as long, some more than others"
        } else {
            "the machine or the line stalled too often, or too few edges showed; measure again on an idle machine, or with more \
             --led-edges"
        };
        let half_ms = half_s * 1e3;
        let said = format!("the LED test leaves the delay open by +-{half_ms:.2} ms: {why}");
        (half_s > WORTH_SAYING_S).then_some(said)
    }
}

/// Switches an LED on and off at `edges_s`, and takes frames until `end_ns`: when it was switched, s, and the frames.
///
/// Only frames that have arrived are asked for. A camera's own wait may end with the next frame alone, and edges that follow a frame fall
/// at one place of the exposure: the brightness of few frames would tell their time.
pub(crate) fn switch(
    camera: &mut dyn Camera,
    mut led: impl FnMut(bool) -> Result<(), Failure>,
    edges_s: &[f64],
    end_ns: i64,
) -> Result<(Vec<f64>, LitFrames), Failure> {
    /// Time between two looks for frames, ns.
    const LOOK_NS: i64 = 200_000;
    let mut buffer = FrameBuffer::default();
    let (mut seen, mut switched_s) = (LitFrames::default(), Vec::new());
    let mut waiting = edges_s.iter().map(|s| (s * 1e9).round() as i64).peekable();
    loop {
        let now_ns = monotonic_ns();
        if now_ns >= end_ns {
            return Ok((switched_s, seen));
        }
        if waiting.next_if(|edge_ns| now_ns >= *edge_ns).is_some() {
            switched_s.push(monotonic_ns() as f64 * 1e-9);
            led(switched_s.len() % 2 == 1)?;
        }
        while let Some(stamp) = camera
            .next_frame(&mut buffer, now_ns)
            .map_err(Failure::failed)?
        {
            seen.push(&stamp, &buffer);
        }
        let edge_ns = waiting.peek().copied().unwrap_or(end_ns);
        Clock::Real.sleep_until_ns(edge_ns.min(now_ns + LOOK_NS));
    }
}

/// Round trips to the board at dithered times, s.
pub(crate) fn dithered_trips<P: Port>(
    board: &mut BoardHost<P>,
    seed: u64,
) -> Result<Vec<f64>, Failure> {
    const PINGS: u32 = 101;
    /// Longer than a board's step, and no multiple of it.
    const APART_S: f64 = 1.37e-3;
    const STEP_S: f64 = 1e-3;
    let start_s = monotonic_ns() as f64 * 1e-9 + APART_S;
    let at_s = dithered_edges(PINGS as usize, APART_S, STEP_S, start_s, seed);
    let mut trips_s = Vec::new();
    for (token, at_s) in (0..).zip(at_s) {
        Clock::Real.sleep_until_ns((at_s * 1e9) as i64);
        let trip = board.ping(token, Duration::from_millis(50));
        trips_s.extend(
            trip.map_err(Failure::failed)?
                .map(|(trip, _)| trip.as_secs_f64()),
        );
    }
    Ok(trips_s)
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

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_rig::{CameraError, SourceInfo};

    /// A camera at 1 kHz whose wait ends with the next frame alone, as that of a socket does on a kernel with coarse time-outs.
    struct Coarse {
        next_ns: i64,
    }

    impl Camera for Coarse {
        fn next_frame(
            &mut self,
            _: &mut FrameBuffer,
            deadline_ns: i64,
        ) -> Result<Option<FrameStamp>, CameraError> {
            let now_ns = monotonic_ns();
            if self.next_ns > now_ns {
                if deadline_ns <= now_ns {
                    return Ok(None);
                }
                Clock::Real.sleep_until_ns(self.next_ns);
            }
            self.next_ns += 1_000_000;
            Ok(Some(FrameStamp {
                id: 0,
                mid_exposure_ns: self.next_ns - 1_500_000,
                exposure_ns: 0,
                arrival_ns: now_ns,
                true_um: f64::NAN,
                true_pzt_um: f64::NAN,
            }))
        }

        fn info(&self) -> SourceInfo {
            SourceInfo {
                name: "coarse".to_string(),
                width_px: 0,
                height_px: 0,
                rate_hz: 1000.0,
                latency_ms: 1.0,
                exposure_s: 0.0,
                field_um: [-1.0, 1.0],
            }
        }
    }

    #[test]
    fn edges_fall_anywhere_between_two_frames_whatever_the_cameras_wait() {
        let start_ns = monotonic_ns();
        let mut camera = Coarse { next_ns: start_ns };
        let edges_s = dithered_edges(80, 0.003, 1e-3, start_ns as f64 * 1e-9 + 0.01, 2);
        // Long after the last edge: the machine may stall.
        let end_ns = start_ns + 600_000_000;
        let (switched_s, frames) = switch(&mut camera, |_| Ok(()), &edges_s, end_ns).unwrap();
        assert_eq!(switched_s.len(), edges_s.len());
        assert!(frames.mid_s.len() > 200, "{}", frames.mid_s.len());
        // Edges that wait for frames are late by 0 to 1 period, evenly: a quarter by less than a quarter. A busy machine makes edges late,
        // none early.
        let late_s: Vec<f64> = (switched_s.iter().zip(&edges_s))
            .map(|(switched_s, edge_s)| switched_s - edge_s)
            .collect();
        let [quarter_s] = cellpos_numeric::statistics::quantiles(&late_s, [0.25]);
        assert!(quarter_s < 0.125e-3, "{late_s:?}");
    }
}
