//! Rate and age of a camera's frames, before anything is armed.

use crate::failure::Failure;
use cellpos_rig::{Clock, PositionSource};

/// Rate and age of a camera's frames, from their own ids and time stamps.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FramesSeen {
    /// Frames a second; 0 with fewer than two.
    pub rate_hz: f64,
    /// From the middle of an exposure until the loop can use its frame, vision included, ms, median.
    pub age_ms: Option<f64>,
}

impl FramesSeen {
    /// Watches `source` for `span_ns`.
    ///
    /// # Errors
    /// The camera delivers nothing more.
    pub fn of(
        source: &mut dyn PositionSource,
        clock: &Clock,
        span_ns: i64,
    ) -> Result<Self, Failure> {
        // The queued frames are old.
        while source
            .next(clock.now_ns())
            .map_err(Failure::failed)?
            .is_some()
        {}
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
        ages_ms.sort_by(f64::total_cmp);
        let rate_hz = match (first, last) {
            (Some((id, ns)), Some((last_id, last_ns))) if last_ns > ns => {
                last_id.saturating_sub(id) as f64 / ((last_ns - ns) as f64 * 1e-9)
            }
            _ => 0.0,
        };
        Ok(Self {
            rate_hz,
            age_ms: ages_ms.get(ages_ms.len() / 2).copied(),
        })
    }
}
