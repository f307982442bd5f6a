//! Checks that the camera gives one frame in each period of the loop.
//!
//! A record has a row per frame, but the loop's clock plays the excitation. With a camera of another rate every frequency would be wrong.

use cellpos_runtime::{TickFlags, TickRecord};
use cellpos_session::Failure;

/// Frames in a window: long enough that stamps off by a tenth of a period do not matter.
const WINDOW: u64 = 500;
/// Windows for the decision: in one of these, the camera may have restarted without counting lost frames.
const WINDOWS: usize = 3;
/// Accepted relative difference: a crystal is off by 0.01 %.
const AGREES: f64 = 1e-3;

/// Frames per second by the stamps of the camera, if it differs from one per period of the loop; `None` if it is, or not known yet.
pub(crate) fn foreign_rate_hz(ticks: &[TickRecord], period_ns: i64) -> Option<f64> {
    let mut from: Option<(u64, i64)> = None;
    let mut spacings_ns = Vec::new();
    let seen = |t: &&TickRecord| {
        t.is_running() && !t.flags.has(TickFlags::TIMER) && !t.flags.has(TickFlags::STALE)
    };
    for tick in ticks.iter().filter(seen) {
        let (id, ns) = *from.get_or_insert((tick.frame_id, tick.mid_exposure_ns));
        let frames = tick.frame_id.saturating_sub(id);
        if frames >= WINDOW {
            spacings_ns.push((tick.mid_exposure_ns - ns) as f64 / frames as f64);
            from = Some((tick.frame_id, tick.mid_exposure_ns));
        }
    }
    if spacings_ns.len() < WINDOWS {
        return None;
    }
    spacings_ns.sort_unstable_by(f64::total_cmp);
    let spacing_ns = spacings_ns[spacings_ns.len() / 2];
    let off = spacing_ns / period_ns as f64 - 1.0;
    (off.abs() > AGREES).then(|| 1e9 / spacing_ns)
}

/// Frames of a camera that is faster than the loop, counted in periods of the loop. Each tick takes the newest of several, and a
/// record has a row per tick.
#[derive(Debug, Clone, Copy)]
pub(crate) struct InPeriods {
    period_ns: i64,
    /// Middle of the first exposure, ns.
    first_ns: Option<i64>,
}

impl InPeriods {
    /// `None` if the camera gives at most one frame per period.
    pub(crate) fn of(rate_hz: f64, period_ns: i64) -> Option<Self> {
        /// Frames a period: halfway between one and two.
        const SEVERAL: f64 = 1.5;
        (rate_hz * 1e-9 * period_ns as f64 > SEVERAL).then_some(Self {
            period_ns,
            first_ns: None,
        })
    }

    /// The tick with the number of its frame in periods.
    pub(crate) fn count(&mut self, mut tick: TickRecord) -> TickRecord {
        let has_frame = !tick.flags.has(TickFlags::TIMER) && tick.mid_exposure_ns > 0;
        if has_frame {
            let first_ns = *self.first_ns.get_or_insert(tick.mid_exposure_ns);
            // The first exposure is in the middle of its period, so that a frame more or less changes nothing.
            let since_ns = tick.mid_exposure_ns - first_ns + self.period_ns / 2;
            tick.frame_id = u64::try_from(since_ns / self.period_ns).unwrap_or(0);
        }
        tick
    }
}

/// The difference in a sentence, and what to do.
pub(crate) fn other_rate(rate_hz: f64, period_ns: i64) -> Failure {
    let loop_hz = 1e9 / period_ns as f64;
    let remedy = if rate_hz < loop_hz {
        format!(
            "write rate_hz = {rate_hz:.1} in [camera] of rig.toml: the loop then measures at that rate"
        )
    } else {
        format!(
            "write rate_hz = {rate_hz:.1} in [camera] and period_us = {:.1} in [timing] of rig.toml, or set the camera to \
             {loop_hz:.1} frames/s",
            1e6 / rate_hz
        )
    };
    Failure::bad_input(
        format!(
            "the camera gives {rate_hz:.1} frames/s and the loop runs at {loop_hz:.1} /s: every frequency of the record would be wrong"
        ),
        remedy,
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_runtime::Life;

    fn ticks(rate_hz: f64, restarts: bool) -> Vec<TickRecord> {
        (0..4000)
            .map(|k| {
                let frame = (k as f64 * rate_hz * 1e-3).floor();
                let mut tick = TickRecord::unknown();
                tick.life = Life::Running as u8;
                tick.time_ns = k * 1_000_000;
                tick.frame_id = frame as u64;
                tick.mid_exposure_ns = (frame / rate_hz * 1e9) as i64 - 2_000_000;
                if restarts && k > 900 {
                    // Lost, and not counted.
                    tick.mid_exposure_ns += 300_000_000;
                }
                tick
            })
            .collect()
    }

    #[test]
    fn frames_of_a_faster_camera_are_counted_in_periods() {
        let period_ns = 20_000_000;
        assert!(InPeriods::of(50.0, period_ns).is_none());
        let mut in_periods = InPeriods::of(1000.0, period_ns).unwrap();
        for k in 0..4000_i64 {
            let mut tick = TickRecord::unknown();
            // A frame sooner or later, whatever its own number.
            tick.mid_exposure_ns = 5_000_000 + k * period_ns + (k % 3 - 1) * 1_000_000;
            tick.frame_id = 20 * k as u64 + 7;
            assert_eq!(in_periods.count(tick).frame_id, k as u64);
        }
    }

    #[test]
    fn the_remedy_names_the_key_and_its_value() {
        let said = |rate_hz| match other_rate(rate_hz, 1_000_000) {
            Failure::BadInput(report) => report.help().map(|help| help.to_string()),
            Failure::Failed(_) => None,
        };
        let slow = said(500.0).expect("a remedy");
        assert!(slow.contains("rate_hz = 500.0"), "{slow}");
        assert!(!slow.contains("period_us"), "{slow}");
        let fast = said(1250.0).expect("a remedy");
        for key in ["rate_hz = 1250.0", "period_us = 800.0"] {
            assert!(fast.contains(key), "{fast}");
        }
    }

    #[test]
    fn a_camera_of_another_rate_is_told_from_one_that_drifts_or_restarts() {
        let rate_hz = |rate_hz, restarts| foreign_rate_hz(&ticks(rate_hz, restarts), 1_000_000);
        for same_hz in [999.9, 1000.0, 1000.1] {
            assert_eq!(rate_hz(same_hz, false), None, "{same_hz}");
        }
        assert_eq!(rate_hz(1000.0, true), None);
        for other_hz in [500.0, 990.0, 1010.0, 2000.0] {
            let found = rate_hz(other_hz, false);
            assert!(
                found.is_some_and(|hz| (hz / other_hz - 1.0).abs() < 1e-3),
                "{other_hz}: {found:?}"
            );
        }
        assert_eq!(
            foreign_rate_hz(&ticks(500.0, false)[..1000], 1_000_000),
            None
        );
    }
}
