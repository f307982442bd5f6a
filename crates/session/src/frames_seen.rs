//! Rate and age of a camera's frames, before anything is armed.

use crate::failure::Failure;
use crate::setup::{camera_delay_advice, delays_differ};
use cellpos_rig::{Clock, PositionSource};
use cellpos_runtime::Timing;
use cellpos_runtime::realtime::{self, Request};
use serde::Serialize;

/// Rate and age of a camera's frames, from their own ids and time stamps.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FramesSeen {
    /// Frames a second; 0 with fewer than two.
    pub rate_hz: f64,
    /// From the middle of an exposure until the loop can use its frame, vision included; `None` without frames.
    pub age: Option<FrameAge>,
}

/// How old frames are when they can be used, ms. A machine that stalls makes them older, never younger.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct FrameAge {
    /// One in ten is younger: the path itself, without what the machine adds.
    pub early_ms: f64,
    /// The median.
    pub median_ms: f64,
}

impl FrameAge {
    /// Of ages in any order, ms.
    fn of(mut ages_ms: Vec<f64>) -> Option<Self> {
        ages_ms.sort_by(f64::total_cmp);
        let at = |part: usize| ages_ms.get(ages_ms.len() / part).copied();
        Some(Self {
            early_ms: at(10)?,
            median_ms: at(2)?,
        })
    }

    /// The difference from the file, if there is one, and the remedy. A machine that stalls makes frames older: if that alone is worth saying, no
    /// value is advised, and a file that may be right is not blamed.
    pub fn advice(self, timing: &Timing) -> Option<(String, &'static str)> {
        let Self {
            early_ms,
            median_ms,
        } = self;
        let camera_delay_ms = timing.camera_delay_ms;
        let advice = camera_delay_advice(median_ms, timing)?;
        if !delays_differ(median_ms, early_ms, timing) {
            return Some((
                advice,
                "design the controller again, too: cellpos design --rig",
            ));
        }
        let between = (early_ms..=median_ms).contains(&camera_delay_ms);
        if between || !delays_differ(early_ms, camera_delay_ms, timing) {
            return None;
        }
        Some((
            format!(
                "frames are {median_ms:.2} ms old when they are used (median), one in ten less than {early_ms:.2} ms: the machine is too busy \
                 to measure it, but camera_delay_ms = {camera_delay_ms} is wrong"
            ),
            "end other programs and check again: cellpos doctor --why names what is late",
        ))
    }
}

impl FramesSeen {
    /// Watches `source` for `span_ns`; on the real clock from a thread of the priority `request`, as the loop will.
    ///
    /// # Errors
    /// The camera delivers nothing more.
    pub fn of(
        source: &mut dyn PositionSource,
        clock: &Clock,
        span_ns: i64,
        request: &Request,
    ) -> Result<Self, Failure> {
        if matches!(clock, Clock::Virtual(_)) {
            return Self::watched(source, clock, span_ns);
        }
        realtime::with(request, || Self::watched(source, clock, span_ns))
    }

    fn watched(
        source: &mut dyn PositionSource,
        clock: &Clock,
        span_ns: i64,
    ) -> Result<Self, Failure> {
        // The queued frames are old. Where vision is slower than the camera the queue is never empty.
        let begun_ns = clock.now_ns();
        while let Some(m) = source.next(clock.now_ns()).map_err(Failure::failed)? {
            if m.mid_exposure_ns >= begun_ns || clock.now_ns() - begun_ns >= span_ns {
                break;
            }
        }
        let until_ns = clock.now_ns().saturating_add(span_ns);
        let (mut first, mut last) = (None, None);
        let mut ages_ms = Vec::new();
        while clock.now_ns() < until_ns {
            let Some(m) = source.next(until_ns).map_err(Failure::failed)? else {
                continue;
            };
            let at = (m.frame_id, m.mid_exposure_ns);
            first.get_or_insert(at);
            last = Some(at);
            ages_ms.push((m.ready_ns - m.mid_exposure_ns) as f64 * 1e-6);
        }
        let rate_hz = match (first, last) {
            (Some((id, ns)), Some((last_id, last_ns))) if last_ns > ns => {
                last_id.saturating_sub(id) as f64 / ((last_ns - ns) as f64 * 1e-9)
            }
            _ => 0.0,
        };
        Ok(Self {
            rate_hz,
            age: FrameAge::of(ages_ms),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_rig::{CameraError, Measurement, SourceInfo};
    use std::time::Duration;

    /// A camera of 1 kHz before a vision that takes 50 ms: a frame always waits.
    struct Slow {
        clock: Clock,
        frames: u64,
    }

    impl PositionSource for Slow {
        fn next(&mut self, _: i64) -> Result<Option<Measurement>, CameraError> {
            self.frames += 1;
            assert!(self.frames < 100, "the look never ends");
            let mid_exposure_ns = self.clock.now_ns();
            self.clock.sleep(Duration::from_millis(50));
            Ok(Some(Measurement {
                frame_id: self.frames,
                mid_exposure_ns,
                ready_ns: self.clock.now_ns(),
                position_um: 0.0,
                variance_um2: 1e-4,
                verdict: cellpos_vision::FixQuality::Good,
                track: None,
                snr: 10.0,
                length_um: f64::NAN,
                area_um2: f64::NAN,
                length_sd_um: f64::NAN,
                area_sd_um2: f64::NAN,
                true_um: f64::NAN,
                true_pzt_um: f64::NAN,
            }))
        }
        fn info(&self) -> SourceInfo {
            SourceInfo {
                name: "slow".to_owned(),
                width_px: 0,
                height_px: 0,
                rate_hz: 1000.0,
                latency_ms: 0.0,
                exposure_s: 0.0,
                field_um: [-10.0, 10.0],
            }
        }
    }

    #[test]
    fn the_lateness_of_a_busy_machine_is_not_advised_as_the_delay_of_the_camera() {
        let said = |early_ms: f64, median_ms: f64, camera_delay_ms: f64| {
            let timing = Timing {
                camera_delay_ms,
                ..Timing::default()
            };
            let age = FrameAge {
                early_ms,
                median_ms,
            };
            age.advice(&timing).map(|(what, _)| what)
        };
        // An idle machine: the file is right, or the value is said.
        assert_eq!(said(3.18, 3.24, 3.2), None);
        assert!(said(3.18, 3.24, 2.0).is_some_and(|what| what.contains("= 3.24 and design")));
        // Frames of 3.2 ms on a machine that adds 3 ms in the median.
        assert_eq!(said(3.3, 6.3, 3.2), None);
        assert_eq!(said(3.3, 6.3, 5.0), None);
        for camera_delay_ms in [2.0, 7.0] {
            let what = said(3.3, 6.3, camera_delay_ms).expect("a word");
            assert!(
                what.contains("too busy") && !what.contains("write"),
                "{what}"
            );
        }
    }

    #[test]
    fn a_look_ends_although_vision_is_slower_than_the_camera() {
        let clock = Clock::virtual_at(0);
        let mut slow = Slow {
            clock: clock.clone(),
            frames: 0,
        };
        let seen = FramesSeen::of(&mut slow, &clock, 500_000_000, &Request::best_effort());
        let age = seen.expect("frames").age.expect("an age");
        assert_eq!((age.early_ms, age.median_ms), (50.0, 50.0));
        assert!(clock.now_ns() < 1_200_000_000);
    }
}
