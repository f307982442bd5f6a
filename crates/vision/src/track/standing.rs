//! Time and state of a tracker, of beads and of cells alike.

use super::config::{Decision, TrackState, TrackStep};
use super::motion::Motion;
use crate::fix::{Fix, FixQuality};

/// What is followed, as far as the state goes.
#[derive(Debug, Clone, Copy)]
pub(super) struct Chosen {
    pub motion: Motion,
    /// Whether it has been seen often enough.
    pub confirmed: bool,
    pub last_fix_s: f64,
}

/// Where a tracker stands.
#[derive(Debug, Clone, Copy)]
pub(super) struct Standing {
    pub state: TrackState,
    time_s: Option<f64>,
}

impl Default for Standing {
    fn default() -> Self {
        Standing {
            state: TrackState::Searching,
            time_s: None,
        }
    }
}

impl Standing {
    /// Goes on to `time_s`: the step from the time before, and the time. A time that is past or no number is no step.
    pub(super) fn elapse(&mut self, time_s: f64) -> (f64, f64) {
        let dt_s = self.time_s.map_or(0.0, |before| (time_s - before).max(0.0));
        let dt_s = if dt_s.is_finite() { dt_s } else { 0.0 };
        let time_s = self
            .time_s
            .unwrap_or(if time_s.is_finite() { time_s } else { 0.0 })
            + dt_s;
        self.time_s = Some(time_s);
        (dt_s, time_s)
    }

    /// The state after a frame's decision; `before` as predicted for the frame, `now` with its fix taken in.
    pub(super) fn settle(
        &mut self,
        decision: Decision,
        fix: Option<Fix>,
        before: Option<Chosen>,
        now: Option<Chosen>,
        coast_limit_s: f64,
    ) -> TrackStep {
        let coasted_s = now.map_or(0.0, |c| self.time_s.unwrap_or(c.last_fix_s) - c.last_fix_s);
        self.state = match now {
            None => TrackState::Searching,
            Some(c) if !c.confirmed => TrackState::Searching,
            Some(_) if decision.is_accepted() => TrackState::Tracking,
            Some(_) if self.state == TrackState::Lost => TrackState::Lost,
            Some(_) if coasted_s > coast_limit_s => TrackState::Lost,
            Some(_) => TrackState::Coasting,
        };
        let (x_px, y_px) = now.map_or((f64::NAN, f64::NAN), |c| c.motion.position());
        TrackStep {
            state: self.state,
            decision,
            fix: fix.unwrap_or(Fix::none(x_px, y_px, FixQuality::NoSignal)),
            x_px,
            y_px,
            sd_px: now.map_or(f64::INFINITY, |c| c.motion.sd_px()),
            innovation_sigma: match (before, fix) {
                (Some(b), Some(f)) => b.motion.distance2(&f).sqrt(),
                _ => f64::NAN,
            },
            coasted_s,
            neighbours: 0,
        }
    }
}
