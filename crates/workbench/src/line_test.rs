//! Identity of a board, and quality of the line.

use crate::bench::Board;
use cellpos_link::Status;
use cellpos_numeric::statistics;
use cellpos_rig::{Actuator, ActuatorInfo, Clock};
use cellpos_session::Failure;
use serde::Serialize;
use std::time::Duration;

/// Quantiles of a set of times.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Quantiles {
    /// Median.
    pub p50: f64,
    /// 99 % are below.
    pub p99: f64,
    /// Largest.
    pub max: f64,
}

impl Quantiles {
    /// Of values in any order; 0 without any.
    pub fn of(values: &[f64]) -> Self {
        if values.is_empty() {
            return Self::default();
        }
        let [p50, p99, max] = statistics::quantiles(values, [0.5, 0.99, 1.0]);
        Self { p50, p99, max }
    }
}

/// What was found.
#[derive(Debug, Clone, Serialize)]
pub struct LineTest {
    /// Identity of the board.
    pub info: ActuatorInfo,
    /// Its state in words.
    pub state: String,
    /// Displacement at its output, um.
    pub applied_um: f64,
    /// Pings sent.
    pub sent: u32,
    /// Pings without an answer.
    pub lost: u32,
    /// Round trip, ms.
    pub round_trip_ms: Quantiles,
    /// Deviation of the pings' spacing from a millisecond on the board's own clock, ms: jitter of host and line.
    pub jitter_ms: Quantiles,
    /// Frames that the board could not read, since it was switched on.
    pub bad_frames: u32,
    /// Commands that it ignored.
    pub ignored: u32,
    /// Commands that came late.
    pub late: u32,
    /// Commands that it clipped.
    pub clipped: u32,
    /// Messages that it could not send.
    pub unsent: u32,
    /// Frames from the board that could not be read here.
    pub bad_frames_here: u32,
}

/// Sends `count` pings, one a millisecond, and reads the board's counters. Nothing moves.
///
/// # Errors
/// The line breaks, or the board gives no status.
pub fn run(board: &mut Board, count: u32) -> Result<LineTest, Failure> {
    const PERIOD_NS: i64 = 1_000_000;
    const PATIENCE: Duration = Duration::from_millis(200);
    let clock = Clock::Real;
    let status: Status = board.status().map_err(Failure::failed)?;
    let (mut trips_ms, mut times_us) = (Vec::new(), Vec::new());
    let mut lost = 0;
    let mut due_ns = clock.now_ns();
    for token in 1..=count {
        clock.sleep_until_ns(due_ns);
        match board.ping(token, PATIENCE).map_err(Failure::failed)? {
            Some((trip, board_time_us)) => {
                trips_ms.push(trip.as_secs_f64() * 1e3);
                times_us.push((token, board_time_us));
            }
            None => lost += 1,
        }
        // A late answer shifts the later pings: the spacing is never below a period.
        due_ns = (due_ns + PERIOD_NS).max(clock.now_ns());
    }
    let jitter_ms: Vec<f64> = (times_us.windows(2))
        .filter(|pair| pair[1].0 == pair[0].0 + 1)
        .map(|pair| ((pair[1].1 - pair[0].1) as f64 * 1e-3 - 1.0).abs())
        .collect();
    Ok(LineTest {
        info: board.info(),
        state: format!("{:?}", status.state).to_lowercase(),
        applied_um: cellpos_link::um_from_picometres(status.applied_pm),
        sent: count,
        lost,
        round_trip_ms: Quantiles::of(&trips_ms),
        jitter_ms: Quantiles::of(&jitter_ms),
        bad_frames: status.bad_frames,
        ignored: status.ignored,
        late: status.late,
        clipped: status.clipped,
        unsent: status.unsent,
        bad_frames_here: board.bad_frames(),
    })
}
