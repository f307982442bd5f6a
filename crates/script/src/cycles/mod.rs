//! The per-cycle table: one row for each cycle of a plan, made from the loop's records during the run.
//!
//! Every cycle of the plan gets exactly one row, in order, when it is over. A skipped cycle, or one whose records were all lost,
//! has a row with a flag and no figures. An unfinished cycle has no row, so that a resumed run repeats it.

mod fatigue;
mod fit;
mod minimum;
mod open;
mod outlier;
mod place;
mod rest;
mod resting;
mod row;
mod saturating;
mod shape;
mod table;
mod trend;

pub use fatigue::{FatigueStop, FatigueWatch};
pub use rest::AtRest;
pub use row::{CycleFlags, CycleRow};
pub use saturating::Saturating;
pub use table::{CycleColumns, HeadError, ReadCycles, read_cycles};
pub use trend::{Alarm, AmplitudeWatch, Mean, Trend, half95, trend};

use crate::plan::Plan;
use cellpos_runtime::{Life, Request, Stage, TickFlags, TickRecord};
use open::Open;
use outlier::Outliers;
use place::{Place, bounds_ns};
use resting::{Rest, Resting};
use std::collections::VecDeque;
use std::sync::Arc;

/// Ticks kept, to find the command at the exposure of a position.
const PAST: usize = 128;

/// Makes rows from records.
#[derive(Debug)]
pub struct CycleTable {
    plan: Arc<Plan>,
    session: u64,
    delay_ns: i64,
    period_ns: i64,
    past: VecDeque<Past>,
    next: u64,
    open: Option<Open>,
    /// Events since the last row, which belong to the next one.
    pending: CycleFlags,
    ready: VecDeque<CycleRow>,
    last_seq: Option<u64>,
    /// Spans of the plan that the operator skipped, ns.
    skips_ns: Vec<(i64, i64)>,
    outliers: Outliers,
    resting: Resting,
}

/// State of the loop at a tick.
#[derive(Debug, Clone, Copy)]
struct Past {
    time_ns: i64,
    plan_ns: i64,
    target_um: f64,
    command_um: f64,
    neutral_um: f64,
    stage: Stage,
}

impl CycleTable {
    /// A table for a session that starts with a cycle. `delay_ms`: from the middle of an exposure to the tick that uses it
    /// (for ticks without a frame); `period_us`: of the loop.
    pub fn new(
        plan: Arc<Plan>,
        session: u64,
        first_cycle: u64,
        delay_ms: f64,
        period_us: f64,
    ) -> Self {
        Self {
            plan,
            session,
            delay_ns: (delay_ms * 1e6) as i64,
            period_ns: (period_us * 1e3) as i64,
            past: VecDeque::with_capacity(PAST),
            next: first_cycle,
            open: None,
            pending: CycleFlags::default(),
            ready: VecDeque::new(),
            last_seq: None,
            skips_ns: Vec::new(),
            outliers: Outliers::default(),
            resting: Resting::default(),
        }
    }

    /// The next finished row.
    pub fn pop(&mut self) -> Option<CycleRow> {
        self.ready.pop_front()
    }

    /// Takes the next record.
    pub fn add(&mut self, record: &TickRecord) {
        let stage = Stage::from_number(record.stage);
        let gap = self.last_seq.is_some_and(|last| record.seq > last + 1);
        self.last_seq = Some(record.seq);
        self.pending.set(CycleFlags::RECORDS_LOST, gap);
        self.pending.set(
            CycleFlags::SAFE,
            record.life == Life::Safe as u8 && self.open.is_some(),
        );
        if stage == Stage::None || record.plan_ns < 0 {
            return;
        }
        if record.request == Request::Skip as u8 {
            let ran_ns = |past: &Past| match past.stage {
                Stage::Running => past.plan_ns + self.period_ns,
                _ => past.plan_ns,
            };
            let from_ns = self.past.back().map_or(record.plan_ns, ran_ns);
            self.skips_ns
                .push((from_ns.min(record.plan_ns), record.plan_ns));
        }
        let apart_ns = self
            .past
            .back()
            .map_or(0, |past| record.time_ns - past.time_ns);
        let late = !gap && 2 * apart_ns > 3 * self.period_ns;
        if self.past.len() >= PAST {
            self.past.pop_front();
        }
        self.past.push_back(Past {
            time_ns: record.time_ns,
            plan_ns: record.plan_ns,
            target_um: record.target_um,
            command_um: record.command_um,
            neutral_um: record.neutral_um,
            stage,
        });
        let fresh = !record.flags.has(TickFlags::TIMER) && !record.flags.has(TickFlags::STALE);
        let exposed_ns = if fresh {
            record.mid_exposure_ns
        } else {
            record.time_ns - self.delay_ns
        };
        // Positions exposed before the first tick of the script belong to no cycle.
        let Some(place) = self.place(exposed_ns, fresh) else {
            return;
        };
        self.close_until(place.plan_ns);
        let rest = if fresh {
            self.resting.add(record, place.target_um)
        } else {
            None
        };
        self.pending.set(CycleFlags::SKIPPED_TICKS, late);
        if matches!(place.stage, Stage::Running | Stage::Waiting | Stage::Paused) {
            self.gather(record, place, rest);
        }
    }

    /// The plan's time at a time of the run.
    fn place(&self, time_ns: i64, fresh: bool) -> Option<Place> {
        let index = self.past.partition_point(|past| past.time_ns <= time_ns);
        let before = self.past.get(index.checked_sub(1)?)?;
        // The plan's clock ran between two ticks if it advanced by no more than their distance. A larger advance is a skipped
        // step; no advance is a wait.
        let after = self.past.get(index).filter(|after| {
            before.stage == Stage::Running
                && after.plan_ns - before.plan_ns <= (after.time_ns - before.time_ns) * 3 / 2
        });
        let (plan_ns, target_um) = match after {
            Some(after) => {
                let share = (time_ns - before.time_ns) as f64
                    / (after.time_ns - before.time_ns).max(1) as f64;
                (
                    before.plan_ns + ((after.plan_ns - before.plan_ns) as f64 * share) as i64,
                    before.target_um + (after.target_um - before.target_um) * share,
                )
            }
            None => (before.plan_ns, before.target_um),
        };
        Some(Place {
            plan_ns,
            target_um,
            stage: before.stage,
            exposed_ns: time_ns,
            fresh,
        })
    }

    /// Finishes every cycle that ends at or before a time of the plan.
    fn close_until(&mut self, plan_ns: i64) {
        while let Some(cycle) = self.plan.cycle(self.next) {
            let (start_ns, end_ns) = bounds_ns(&cycle);
            if end_ns > plan_ns {
                return;
            }
            // This includes a cycle that continued after the skipped step: it differs from the script.
            let skipped = self
                .skips_ns
                .iter()
                .any(|(from_ns, to_ns)| *from_ns < end_ns && *to_ns > start_ns);
            self.skips_ns.retain(|(_, to_ns)| *to_ns > end_ns);
            let expected = (end_ns - start_ns) as f64 / self.period_ns.max(1) as f64;
            let (mut row, worst) = match self.open.take() {
                Some(open) => open.finish(expected, self.resting.so_far()),
                None => {
                    let mut row = CycleRow::empty(cycle.number, self.session, cycle.arm);
                    row.plan_s = cycle.start_s;
                    row.duration_s = cycle.duration_s;
                    row.flags.set(CycleFlags::RECORDS_LOST, !skipped);
                    (row, 1.0)
                }
            };
            row.flags.set(CycleFlags::SKIPPED, skipped);
            row.flags.set(self.pending.0, true);
            row.flags.set(CycleFlags::RAMP, cycle.ramp);
            row.flags.judge(worst);
            let outlier = self.outliers.is_one(&row);
            row.flags.set(CycleFlags::OUTLIER, outlier);
            row.flags.judge(worst);
            self.ready.push_back(row);
            self.next += 1;
            // A gap disturbs every cycle that it touches, including the one in which it ends.
            let reaches_on = self
                .plan
                .cycle(self.next)
                .is_some_and(|next| bounds_ns(&next).0 < plan_ns);
            let gap = self.pending.0 & CycleFlags::RECORDS_LOST;
            self.pending = CycleFlags(if reaches_on { gap } else { 0 });
        }
    }

    /// `rest`: one that is over with this frame.
    fn gather(&mut self, record: &TickRecord, place: Place, rest: Option<Rest>) {
        let Some(cycle) = self.plan.cycle(self.next) else {
            return;
        };
        let (start_ns, end_ns) = bounds_ns(&cycle);
        if !(start_ns..end_ns).contains(&place.plan_ns) {
            return;
        }
        // During a wait or a pause before its first motion the plan's clock stands at the start of a cycle: none of it is the cycle's.
        if self.open.is_none() && place.stage != Stage::Running {
            return;
        }
        let since_ns = self.open.as_ref().and_then(Open::last_seen_ns);
        let flow_um = self.away_from_neutral_um(since_ns, place.exposed_ns);
        let open = self
            .open
            .get_or_insert_with(|| Open::new(&self.plan, &cycle, self.session, &place));
        open.begins_after(rest);
        open.disturbed(self.pending);
        self.pending = CycleFlags::default();
        let phase = (place.plan_ns - start_ns) as f64 / (end_ns - start_ns).max(1) as f64;
        open.add(record, &place, phase, flow_um, self.period_ns as f64 * 1e-9);
    }

    /// Mean distance of the command from neutral between two times, um; None when it is not known.
    fn away_from_neutral_um(&self, from_ns: Option<i64>, to_ns: i64) -> Option<f64> {
        let from_ns = from_ns?;
        let first = self
            .past
            .partition_point(|past| past.time_ns <= from_ns)
            .checked_sub(1)?;
        let (mut sum, mut total) = (0.0, 0.0);
        for index in first..self.past.len() {
            let past = self.past.get(index)?;
            if past.time_ns >= to_ns {
                break;
            }
            let until_ns = self.past.get(index + 1).map_or(to_ns, |next| next.time_ns);
            let span = (until_ns.min(to_ns) - past.time_ns.max(from_ns)) as f64;
            sum += (past.command_um - past.neutral_um) * span;
            total += span;
        }
        (total > 0.0).then(|| sum / total)
    }
}

#[cfg(test)]
#[path = "tests.rs"]
mod tests;
