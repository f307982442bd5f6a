//! Walking through a plan: waits, stop conditions.

use crate::plan::{Motion, Plan};
use crate::script::{Condition, OnTimeout};
use cellpos_control::Reference;

/// Measurements of the bead or cell at a tick.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Seen {
    /// Measured position, um; None: not seen.
    pub position_um: Option<f64>,
    /// Measured length of the cell, um; None: not seen, or a bead.
    pub length_um: Option<f64>,
    /// Measured position minus the reference at its exposure, um. None: uses the present reference, which is wrong by the
    /// camera's delay while the reference moves.
    pub error_um: Option<f64>,
}

/// Why a script stopped before its end.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StopReason {
    /// Not seen for too long.
    Lost,
    /// The tracking error became too large.
    Error,
    /// The cell's length changed too much.
    LengthChange,
    /// The time is up.
    Time,
    /// The cycles are done.
    Cycles,
    /// A wait took too long.
    WaitTimeout,
}

/// Where a cursor is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Progress {
    /// Moving or holding by the plan.
    Running,
    /// Waiting for a condition.
    Waiting,
    /// At the end of the plan.
    Done,
    /// Stopped by a stop condition; the reference stays where it was.
    Stopped(StopReason),
}

/// The reference of a tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Output {
    /// Reference, um.
    pub reference_um: f64,
    /// Time of the plan, s; it does not advance in a wait.
    pub plan_s: f64,
    /// What is going on.
    pub status: Progress,
    /// Number of the periodic motion in full swing ([`Plan::periodic`]), and its phase in cycles.
    pub swing: Option<(u16, f64)>,
}

/// A place in a plan. Plain data: it can be copied, kept and compared.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Cursor {
    /// Time of the plan, s: `from_s` and `ticks` samples. A sum of samples would drift by a tick in a long script.
    plan_s: f64,
    from_s: f64,
    ticks: u64,
    /// Running time, waits and pauses included, of all sessions, s.
    elapsed_s: f64,
    segment: usize,
    waited_s: f64,
    settled_s: f64,
    lost_s: f64,
    first_length_um: Option<f64>,
    status: Progress,
}

impl Plan {
    /// A cursor at the start.
    pub fn start(&self) -> Cursor {
        self.start_at(0.0)
    }

    /// A cursor at a time of the plan, to resume at a whole cycle. Earlier waits count as done in no time;
    /// [`Cursor::expect_elapsed`] sets their real time.
    pub fn start_at(&self, plan_s: f64) -> Cursor {
        let segment = self.segments().partition_point(|s| s.start_s < plan_s);
        let segment = match self.segments().get(segment.saturating_sub(1)) {
            Some(before) if plan_s < before.start_s + before.duration_s => {
                segment.saturating_sub(1)
            }
            _ => segment,
        };
        Cursor {
            plan_s,
            from_s: plan_s,
            ticks: 0,
            elapsed_s: plan_s,
            segment,
            waited_s: 0.0,
            settled_s: 0.0,
            lost_s: 0.0,
            first_length_um: None,
            status: Progress::Running,
        }
    }

    /// The reference of this tick; then the cursor advances by `sample_s`. Allocates nothing and cannot panic.
    pub fn step(&self, cursor: &mut Cursor, sample_s: f64, seen: &Seen) -> Output {
        if !matches!(cursor.status, Progress::Done | Progress::Stopped(_)) {
            self.advance(cursor, sample_s, seen);
        }
        let output = Output {
            reference_um: self.reference_um(cursor),
            plan_s: cursor.plan_s,
            status: cursor.status,
            swing: self
                .segments()
                .get(cursor.segment)
                .filter(|_| cursor.status == Progress::Running)
                .and_then(|segment| self.swing(segment, cursor.plan_s)),
        };
        if cursor.status == Progress::Running {
            cursor.ticks += 1;
            cursor.plan_s = cursor.from_s + cursor.ticks as f64 * sample_s;
        }
        cursor.elapsed_s += sample_s;
        output
    }

    /// A tick in which the plan's clock does not advance, but running time and stop conditions do. Allocates nothing.
    pub fn stand(&self, cursor: &mut Cursor, sample_s: f64, seen: &Seen) -> Output {
        if !matches!(cursor.status, Progress::Done | Progress::Stopped(_)) {
            let blind = Seen {
                // A frozen bead does not follow the reference, so its distance from the reference is not an error.
                error_um: seen.position_um.map(|_| 0.0),
                ..*seen
            };
            if let Some(reason) = self.stop_reason(cursor, sample_s, &blind) {
                cursor.status = Progress::Stopped(reason);
            }
        }
        cursor.elapsed_s += sample_s;
        Output {
            reference_um: self.reference_um(cursor),
            plan_s: cursor.plan_s,
            status: cursor.status,
            swing: None,
        }
    }

    /// The known reference of future ticks, the next one first; constant from the next wait on. Allocates nothing.
    pub fn preview(&self, cursor: &Cursor, sample_s: f64, preview_um: &mut [f64]) {
        if cursor.status != Progress::Running {
            preview_um.fill(self.reference_um(cursor));
            return;
        }
        let until_s = self.next_wait_s(cursor.segment);
        for (ahead, slot) in (0u64..).zip(preview_um) {
            let time_s = cursor.from_s + (cursor.ticks + ahead) as f64 * sample_s;
            *slot = self.at_um(time_s.min(until_s));
        }
    }

    /// The reference of a cursor, um.
    pub fn reference_um(&self, cursor: &Cursor) -> f64 {
        match self.segments().get(cursor.segment) {
            Some(segment) => self.segment_um(segment, cursor.plan_s),
            None => self.at_um(self.total_s()),
        }
    }

    fn advance(&self, cursor: &mut Cursor, sample_s: f64, seen: &Seen) {
        // Ends of segments are sums of durations: half a nanosecond of rounding is not a tick.
        const ROUNDING_S: f64 = 5e-10;
        cursor.status = Progress::Running;
        loop {
            let Some(segment) = self.segments().get(cursor.segment) else {
                cursor.status = Progress::Done;
                return;
            };
            if let Motion::Wait {
                condition,
                timeout_s,
                on_timeout,
            } = segment.motion
            {
                if self.met(cursor, condition, segment.from_um, sample_s, seen) {
                    cursor.leave();
                    continue;
                }
                if cursor.waited_s >= timeout_s {
                    if on_timeout == OnTimeout::Continue {
                        cursor.leave();
                        continue;
                    }
                    cursor.status = Progress::Stopped(StopReason::WaitTimeout);
                    return;
                }
                cursor.waited_s += sample_s;
                cursor.status = Progress::Waiting;
                break;
            }
            if cursor.plan_s + ROUNDING_S < segment.start_s + segment.duration_s {
                break;
            }
            cursor.leave();
        }
        if let Some(reason) = self.stop_reason(cursor, sample_s, seen) {
            cursor.status = Progress::Stopped(reason);
        }
    }

    fn met(
        &self,
        cursor: &mut Cursor,
        condition: Condition,
        target_um: f64,
        sample_s: f64,
        seen: &Seen,
    ) -> bool {
        let passes = |value: Option<f64>, level: f64, above: bool| {
            value.is_some_and(|value| if above { value > level } else { value < level })
        };
        match condition {
            Condition::Settled {
                within_um,
                during_s,
            } => {
                let inside = seen
                    .position_um
                    .is_some_and(|position| (position - target_um).abs() <= within_um);
                cursor.settled_s = if inside {
                    cursor.settled_s + sample_s
                } else {
                    0.0
                };
                cursor.settled_s >= during_s
            }
            Condition::Position { level_um, above } => passes(seen.position_um, level_um, above),
            Condition::CellLength { level_um, above } => passes(seen.length_um, level_um, above),
        }
    }

    fn stop_reason(&self, cursor: &mut Cursor, sample_s: f64, seen: &Seen) -> Option<StopReason> {
        let stop = self.stop();
        cursor.lost_s = match seen.position_um {
            Some(_) => 0.0,
            None => cursor.lost_s + sample_s,
        };
        if cursor.first_length_um.is_none() {
            cursor.first_length_um = seen.length_um;
        }
        let beyond = |limit: Option<f64>, value: f64| limit.is_some_and(|limit| value > limit);
        if beyond(stop.lost_longer_than_s, cursor.lost_s) {
            return Some(StopReason::Lost);
        }
        if let Some(position_um) = seen.position_um
            && beyond(
                stop.error_above_um,
                seen.error_um
                    .unwrap_or(position_um - self.reference_um(cursor))
                    .abs(),
            )
        {
            return Some(StopReason::Error);
        }
        if let (Some(first_um), Some(length_um)) = (cursor.first_length_um, seen.length_um)
            && beyond(stop.length_change_above_um, (length_um - first_um).abs())
        {
            return Some(StopReason::LengthChange);
        }
        if stop
            .after_s
            .is_some_and(|after_s| cursor.elapsed_s >= after_s)
        {
            return Some(StopReason::Time);
        }
        stop.after_cycles
            .is_some_and(|cycles| self.cycles_done(cursor.plan_s) >= cycles)
            .then_some(StopReason::Cycles)
    }
}

impl Cursor {
    /// Sets the length from which changes of the cell count; None: the first measured length.
    pub fn expect_length(&mut self, length_um: Option<f64>) {
        self.first_length_um = length_um;
    }

    /// Adds the running time of earlier sessions, s.
    pub fn expect_elapsed(&mut self, elapsed_s: f64) {
        self.elapsed_s = elapsed_s;
    }

    /// Time of the script without the plan: on the way to its next position.
    pub(crate) fn pass(&mut self, sample_s: f64) {
        self.elapsed_s += sample_s;
    }

    /// Goes on to the next segment.
    fn leave(&mut self) {
        self.segment += 1;
        self.waited_s = 0.0;
        self.settled_s = 0.0;
    }

    /// Leaves the segment or wait in force; the clock of the plan jumps to its end.
    pub fn skip(&mut self, plan: &Plan) {
        if let Some(segment) = plan.segments().get(self.segment) {
            self.plan_s = self.plan_s.max(segment.start_s + segment.duration_s);
            (self.from_s, self.ticks) = (self.plan_s, 0);
            self.leave();
        }
    }

    /// Time of the plan, s.
    pub fn plan_s(&self) -> f64 {
        self.plan_s
    }
}
