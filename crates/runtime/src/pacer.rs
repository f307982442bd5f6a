//! When a tick starts: on a new frame, or on the timer where none comes; never twice in a step of the clock's grid.
//!
//! Camera and loop need not agree in rate or phase. The windows of the steps overlap ([`REACH`]), so a frame that comes while the next
//! step's window is open starts its tick at once. One that comes before that is not used, and the frame after it is waited for: it finds
//! the window open. A camera that drifts through the grid costs one tick without a frame, or one unused frame, per whole period of drift. A
//! frame waits only where its tick would be closer than [`APART`] to the one before it. Where the camera is slower, ticks in which none of
//! its frames is to come are made when they are due, without waiting for one. Knows no clock and no thread: its caller gives it the time.

use crate::grid::REACH;

/// A frame may come this late, in parts of a period after it was expected, before the timer replaces it.
const GRACE: f64 = 0.3;
/// The timer's tick comes at the latest so long after its step's window has opened, in periods. What is left of the
/// window is for a thread that wakes up late.
const LATEST: f64 = 2.0 * REACH - 0.1;
/// Ticks of two steps are no closer than this part of a period.
const APART: f64 = 0.25;

/// What to do now.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Pace {
    /// Make a tick; it was due at this time, ns.
    Tick(i64),
    /// Look again at this time, ns, or when a frame has come.
    Wait(i64),
}

/// Paces a loop.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Pacer {
    period_ns: i64,
    /// From frame to frame.
    frame_ns: i64,
    /// When the next tick is expected to be due, by the frames.
    expected_ns: i64,
    /// When the next frame is to come.
    next_frame_ns: i64,
    last_ns: i64,
}

impl Pacer {
    /// `periods_ns`: of the loop, and from frame to frame.
    pub(crate) fn new([period_ns, frame_ns]: [i64; 2], now_ns: i64) -> Self {
        Self {
            period_ns,
            frame_ns,
            expected_ns: now_ns.saturating_add(period_ns),
            next_frame_ns: now_ns,
            last_ns: i64::MIN / 2,
        }
    }

    fn part(&self, of_a_period: f64) -> i64 {
        (self.period_ns as f64 * of_a_period) as i64
    }

    /// `opens_ns`: when the window of the next step opens, `None` before the first tick; `ready_ns`: when the new frame that
    /// waits, if any, was ready.
    pub(crate) fn decide(&self, now_ns: i64, opens_ns: Option<i64>, ready_ns: Option<i64>) -> Pace {
        let Some(opens_ns) = opens_ns else {
            return match ready_ns {
                Some(ready_ns) => Pace::Tick(ready_ns),
                None => Self::at(now_ns, self.expected_ns + self.part(GRACE)),
            };
        };
        let latest_ns = opens_ns + self.part(LATEST);
        let earliest_ns = opens_ns.max(self.last_ns + self.part(APART));
        if now_ns < earliest_ns {
            return Pace::Wait(earliest_ns);
        }
        match ready_ns {
            Some(ready_ns) if ready_ns >= opens_ns => Pace::Tick(ready_ns.max(earliest_ns)),
            Some(ready_ns) => {
                let next_ns = ready_ns + self.period_ns + self.part(GRACE);
                Self::at(now_ns, next_ns.clamp(earliest_ns, latest_ns))
            }
            None => {
                // A frame that is to come in this tick is waited for.
                let comes = self.next_frame_ns < self.expected_ns + self.period_ns / 2;
                let grace_ns = if comes { self.part(GRACE) } else { 0 };
                let due_ns = self.expected_ns + grace_ns;
                Self::at(now_ns, due_ns.clamp(earliest_ns, latest_ns))
            }
        }
    }

    /// A tick at a time that is known.
    pub(crate) fn at(now_ns: i64, due_ns: i64) -> Pace {
        if now_ns >= due_ns {
            Pace::Tick(due_ns)
        } else {
            Pace::Wait(due_ns)
        }
    }

    /// Takes the start of each tick, and the time at which its frame was ready.
    pub(crate) fn ticked(&mut self, start_ns: i64, ready_ns: Option<i64>) {
        self.last_ns = start_ns;
        self.expected_ns = ready_ns.unwrap_or(self.expected_ns) + self.period_ns;
        if let Some(ready_ns) = ready_ns {
            self.next_frame_ns = ready_ns + self.frame_ns;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::Grid;

    const P: i64 = 1_000_000;

    struct Paced {
        ticks: u64,
        without_frame: u64,
        unused: u64,
        longest_wait_ns: i64,
        /// Frames that did not start their tick at once.
        waited: u64,
        off_ns: i64,
        closest_ns: i64,
    }

    /// Ten minutes of frames at these times; returns the fate of each.
    fn pace(frames: impl Iterator<Item = i64>) -> Paced {
        pace_beside(P, frames)
    }

    /// The same with a camera that is stated to give a frame so often.
    fn pace_beside(frame_ns: i64, frames: impl Iterator<Item = i64>) -> Paced {
        let mut pacer = Pacer::new([P, frame_ns], 0);
        let (mut grid, mut index) = (None::<Grid>, 0);
        let (mut now, mut last) = (0, None::<i64>);
        let mut ready = None;
        let mut out = Paced {
            ticks: 0,
            without_frame: 0,
            unused: 0,
            longest_wait_ns: 0,
            waited: 0,
            off_ns: 0,
            closest_ns: i64::MAX,
        };
        let mut frames = frames.peekable();
        while frames.peek().is_some() {
            while let Some(at) = frames.next_if(|&at| at <= now) {
                out.unused += u64::from(ready.is_some());
                ready = Some(at);
            }
            let opens = grid.map(|grid: Grid| grid.opens_ns(index + 1));
            match pacer.decide(now, opens, ready) {
                Pace::Wait(until) => {
                    assert!(until > now);
                    now = until.min(frames.peek().copied().unwrap_or(until));
                }
                Pace::Tick(due) => {
                    assert!(due <= now);
                    let grid = grid.get_or_insert(Grid::new(now, P));
                    if out.ticks > 0 {
                        let at = grid.index_after(index, now);
                        assert_eq!(at, Some(index + 1), "at {now} ns");
                        index += 1;
                    }
                    out.ticks += 1;
                    out.without_frame += u64::from(ready.is_none());
                    if let Some(ready) = ready {
                        out.longest_wait_ns = out.longest_wait_ns.max(now - ready);
                        out.waited += u64::from(now > ready);
                    }
                    // Before the first frames nothing is known of when they come.
                    if let Some(last) = last.filter(|_| out.ticks > 10) {
                        out.closest_ns = out.closest_ns.min(now - last);
                    }
                    last = Some(now);
                    pacer.ticked(now, ready.take());
                    out.off_ns = out
                        .off_ns
                        .max((grid.opens_ns(index) + 3 * P / 4 - now).abs());
                }
            }
        }
        out
    }

    fn camera(rate_hz: f64, seconds: f64) -> impl Iterator<Item = i64> {
        (1..(rate_hz * seconds) as i64).map(move |k| (k as f64 * 1e9 / rate_hz) as i64)
    }

    #[test]
    fn a_camera_of_another_rate_costs_one_tick_or_frame_for_each_period_of_difference() {
        for rate_hz in [990.0, 999.9, 1000.0, 1000.02, 1010.0] {
            let seconds = 600.0;
            let paced = pace(camera(rate_hz, seconds));
            let slips = ((rate_hz - 1000.0) * seconds).abs().ceil() as u64 + 2;
            assert!(
                paced.ticks.abs_diff(600_000) < 3,
                "{rate_hz}: {}",
                paced.ticks
            );
            assert!(
                paced.without_frame <= slips,
                "{rate_hz}: {}",
                paced.without_frame
            );
            assert!(paced.unused <= slips, "{rate_hz}: {}", paced.unused);
            assert!(paced.longest_wait_ns <= P / 4, "{rate_hz}");
            assert!(paced.waited <= slips, "{rate_hz}: {}", paced.waited);
            assert!(
                paced.closest_ns >= P / 4 && paced.off_ns <= 3 * P / 4,
                "{rate_hz}"
            );
        }
    }

    #[test]
    fn after_a_late_frame_none_waits() {
        for late in [0.2, 0.35, 0.5, 0.65, 0.8, 0.95, 1.7] {
            let late_ns = (late * P as f64) as i64;
            for first_ns in [0, late_ns] {
                // The first frame, or the hundredth, is late; the camera is 15 ppm off, either way.
                for ppm in [-15, 15] {
                    let frames = (0..60_000).map(|k| {
                        let delay_ns = match k {
                            0 => first_ns,
                            100 => late_ns,
                            _ => 0,
                        };
                        (k + 1) * (P + P * ppm / 1_000_000) + delay_ns
                    });
                    // A frame that was overtaken comes with the one after it.
                    let mut frames: Vec<i64> = frames.collect();
                    frames.sort_unstable();
                    let paced = pace(frames.into_iter());
                    let what = format!("{late} {first_ns} {ppm}");
                    // One next to the late frame, one as the drift leaves a window.
                    assert!(paced.waited <= 2, "{what}: {} frames waited", paced.waited);
                    assert!(paced.longest_wait_ns <= P / 4, "{what}");
                    assert!(paced.without_frame <= 5 && paced.unused <= 5, "{what}");
                }
            }
        }
    }

    #[test]
    fn a_camera_of_half_or_double_the_rate_runs_on_the_loops_time() {
        let half = pace(camera(500.0, 60.0));
        assert!(half.ticks.abs_diff(60_000) < 3 && half.without_frame.abs_diff(30_000) < 3);
        let double = pace(camera(2000.0, 60.0));
        assert!(double.ticks.abs_diff(60_000) < 3 && double.without_frame == 0);
        assert!(double.unused.abs_diff(60_000) < 5);
    }

    #[test]
    fn between_the_frames_of_a_slower_camera_ticks_are_as_even_as_the_clock() {
        let paced = pace_beside(5 * P, camera(200.0, 60.0));
        assert!(paced.ticks.abs_diff(60_000) < 7, "{}", paced.ticks);
        assert!(paced.without_frame.abs_diff(48_000) < 7);
        assert!(
            paced.longest_wait_ns <= P / 100,
            "{}",
            paced.longest_wait_ns
        );
        let closest_ns = paced.closest_ns;
        assert!(
            closest_ns >= P - P / 20,
            "{closest_ns} ns from tick to tick"
        );
    }

    #[test]
    fn jitter_at_the_edge_of_a_step_does_not_make_frames_fall_to_either_side_in_turn() {
        let mut random = cellpos_numeric::Random::new(1);
        let mut jitter = move || random.below(200_000) as i64 - 100_000;
        // 20 s for a period of drift, with a tenth of a period of jitter: every phase is passed.
        let frames = (1..600_000).map(|k| (k as f64 * 1e9 / 1000.05) as i64 + jitter());
        let paced = pace(frames);
        assert!(paced.ticks.abs_diff(599_970) < 3, "{}", paced.ticks);
        assert!(paced.without_frame < 70, "{}", paced.without_frame);
        assert!(paced.unused < 100, "{}", paced.unused);
    }
}
