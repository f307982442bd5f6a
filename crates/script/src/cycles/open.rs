//! The running cycle.

use super::fit::SineFit;
use super::place::{Place, bounds_ns};
use super::resting::Rest;
use super::row::{CycleFlags, CycleRow};
use super::shape::Series;
use crate::plan::{Cycle, Plan};
use cellpos_control::{Reference, SolverStatus};
use cellpos_runtime::{Request, Stage, TickFlags, TickRecord};

/// Half of the motion from peak to peak below which the reference rests, um.
const STILL_UM: f64 = 0.01;

/// Sums over the ticks of a cycle so far.
#[derive(Debug)]
pub(super) struct Open {
    row: CycleRow,
    fit: SineFit,
    error_um: f64,
    error_um2: f64,
    neutral_um: f64,
    neutrals: u64,
    /// Time (ns) and position (um) of the last position seen, for increments.
    last_seen: Option<(i64, f64)>,
    /// n, sums of u, v, u u, u v, of the speed v against the displacement u away from neutral.
    gain: [f64; 5],
    far_um: f64,
    /// The last position was at the far end.
    dwells: bool,
    lengths_um: Series,
    areas_um2: Series,
    /// Reference at the start, um, and the rest of the cell there.
    start_um: f64,
    rest: Option<Rest>,
    /// Ticks whose command was late or was not the controller's own, and ticks whose position was refused.
    late: u64,
    gated: u64,
}

impl Open {
    pub(super) fn new(plan: &Plan, cycle: &Cycle, session: u64, place: &Place) -> Self {
        const LOOKS: u32 = 64;
        let start_um = plan.at_um(cycle.start_s);
        let (mut low, mut high) = (start_um, start_um);
        for look in 1..=LOOKS {
            let share = f64::from(look) / f64::from(LOOKS);
            let um = plan.at_um(cycle.start_s + cycle.duration_s * share);
            (low, high) = (low.min(um), high.max(um));
        }
        let mut row = CycleRow::empty(cycle.number, session, cycle.arm);
        let into_ns = place.plan_ns - bounds_ns(cycle).0;
        row.start_s = (place.exposed_ns - into_ns) as f64 * 1e-9;
        row.plan_s = cycle.start_s;
        row.duration_s = cycle.duration_s;
        row.stroke_um = 0.5 * (high - low);
        row.peak_um = 0.0;
        row.dwell_s = 0.0;
        Self {
            row,
            fit: SineFit::default(),
            error_um: 0.0,
            error_um2: 0.0,
            neutral_um: 0.0,
            neutrals: 0,
            last_seen: None,
            gain: [0.0; 5],
            far_um: if high - start_um > start_um - low {
                high
            } else {
                low
            },
            dwells: false,
            lengths_um: Series::default(),
            areas_um2: Series::default(),
            start_um,
            rest: None,
            late: 0,
            gated: 0,
        }
    }

    pub(super) fn last_seen_ns(&self) -> Option<i64> {
        self.last_seen.map(|last| last.0)
    }

    /// Takes a rest that is over: the one before the cycle, if it was at the cycle's first position.
    pub(super) fn begins_after(&mut self, rest: Option<Rest>) {
        if self.rest.is_none() {
            self.rest = rest.filter(|rest| rest.was_at(self.start_um));
        }
    }

    pub(super) fn disturbed(&mut self, flags: CycleFlags) {
        self.row.flags.set(flags.0, true);
    }

    /// A tick whose exposure falls into the cycle. `flow_um`: mean distance of the command from neutral since the last
    /// position; `period_s`: of the loop.
    pub(super) fn add(
        &mut self,
        record: &TickRecord,
        place: &Place,
        phase: f64,
        flow_um: Option<f64>,
        period_s: f64,
    ) {
        self.count(record, place);
        let good = place.fresh && record.verdict == 0 && record.measured_um.is_finite();
        if record.flags.has(TickFlags::BETWEEN) && self.dwells {
            self.row.dwell_s += period_s;
        }
        if place.stage == Stage::Paused {
            // Time continues but the cycle does not.
            self.last_seen = None;
        } else if good {
            self.position(record, place, phase, flow_um, period_s);
        }
    }

    fn count(&mut self, record: &TickRecord, place: &Place) {
        let row = &mut self.row;
        let has = |mask| record.flags.has(mask);
        // No frame was due between two frames of a slower camera.
        let lost = has(TickFlags::LOST) || !(place.fresh || has(TickFlags::BETWEEN));
        let limited = has(TickFlags::RANGE_LIMITED) || has(TickFlags::SLEW_LIMITED);
        let late = has(TickFlags::LATE) || has(TickFlags::ACTUATOR_RING_FULL);
        self.late += u64::from(late);
        self.gated += u64::from(has(TickFlags::GATED));
        let unsolved = record.solver_status >= SolverStatus::PreviousPlan as u8;
        row.ticks += 1;
        row.lost += u64::from(lost);
        row.coasted += u64::from(has(TickFlags::COASTING));
        row.saturated += u64::from(limited);
        row.frozen += u64::from(has(TickFlags::FREEZE));
        row.solver_fallbacks += u64::from(unsolved);
        for (mask, when) in [
            (CycleFlags::LOST, lost),
            (
                CycleFlags::STALE,
                has(TickFlags::STALE) || has(TickFlags::DOUBLED_FRAME),
            ),
            (CycleFlags::DROPPED, has(TickFlags::DROPPED_FRAME)),
            (CycleFlags::COASTED, has(TickFlags::COASTING)),
            (CycleFlags::FROZEN, has(TickFlags::FREEZE)),
            (CycleFlags::SATURATED, limited),
            (CycleFlags::LATE, late),
            (CycleFlags::RECORDS_LOST, has(TickFlags::RECORDS_LOST)),
            (CycleFlags::SOLVER_FALLBACK, unsolved),
            (CycleFlags::GATED, has(TickFlags::GATED)),
            (CycleFlags::STUCK, has(TickFlags::STUCK)),
            (CycleFlags::PAUSED, record.request == Request::Pause as u8),
            (CycleFlags::WAITED, place.stage == Stage::Waiting),
        ] {
            row.flags.set(mask, when);
        }
        if record.neutral_um.is_finite() {
            self.neutral_um += record.neutral_um;
            self.neutrals += 1;
        }
    }

    fn position(
        &mut self,
        record: &TickRecord,
        place: &Place,
        phase: f64,
        flow_um: Option<f64>,
        period_s: f64,
    ) {
        let at_um = record.measured_um;
        let error_um = at_um - place.target_um;
        self.row.seen += 1;
        self.error_um += error_um;
        self.error_um2 += error_um * error_um;
        self.row.peak_um = self.row.peak_um.max(error_um.abs());
        // In a wait the phase is constant: its samples would all weigh on one point of the fit.
        if place.stage == Stage::Running {
            self.fit.add(phase, place.target_um, at_um);
        }
        self.dwells =
            self.row.stroke_um > 0.0 && (at_um - self.far_um).abs() < 0.2 * self.row.stroke_um;
        if self.dwells {
            self.row.dwell_s += period_s;
        }
        if let (Some((then_ns, then_um)), Some(u)) = (self.last_seen, flow_um) {
            let v = (at_um - then_um) / ((place.exposed_ns - then_ns).max(1) as f64 * 1e-9);
            for (sum, term) in self.gain.iter_mut().zip([1.0, u, v, u * u, u * v]) {
                *sum += term;
            }
        }
        self.last_seen = Some((place.exposed_ns, at_um));
        let exposed_s = place.exposed_ns as f64 * 1e-9;
        self.lengths_um.add(exposed_s, phase, record.length_um);
        self.areas_um2.add(exposed_s, phase, record.area_um2);
    }

    /// The row of the finished cycle, and the largest share of its `expected` ticks that one kind of trouble touched. `resting`:
    /// the remaining rest.
    pub(super) fn finish(mut self, expected: f64, resting: Option<Rest>) -> (CycleRow, f64) {
        // A cycle that never left its start is a rest.
        self.begins_after(resting.filter(|_| self.row.stroke_um == 0.0));
        let mut row = self.row;
        if let Some(rest) = self.rest {
            (row.length_rest_um, row.length_rest_sd_um) = (rest.length_um.mean, rest.length_um.sd);
            (row.area_rest_um2, row.area_rest_sd_um2) = (rest.area_um2.mean, rest.area_um2.sd);
        }
        let missing = expected - row.ticks as f64;
        let worst = [
            row.lost,
            row.coasted,
            row.saturated,
            row.solver_fallbacks,
            self.late,
            self.gated,
        ]
        .into_iter()
        .map(|ticks| ticks as f64)
        .fold(missing, f64::max)
            / expected.max(1.0);
        if row.seen > 0 {
            let n = row.seen as f64;
            row.bias_um = self.error_um / n;
            row.rms_um = (self.error_um2 / n).sqrt();
        } else {
            (row.peak_um, row.dwell_s) = (f64::NAN, f64::NAN);
        }
        if let Some(sines) = self.fit.solve() {
            row.drift_um_per_s = sines.slope_per_cycle / row.duration_s;
            // A constant reference has neither amplitude nor phase.
            if sines.commanded > 1e-6 {
                row.commanded_um = sines.commanded;
                row.reached_um = sines.reached;
                row.lag_deg = sines.lag_deg;
            }
        }
        if self.neutrals > 0 {
            row.neutral_um = self.neutral_um / self.neutrals as f64;
        }
        let [n, u, v, uu, uv] = self.gain;
        let spread = uu - u * u / n.max(1.0);
        // A command that hardly moves does not determine the gain: 0.02 um RMS is 8 um/s of bead.
        if n >= 10.0 && spread / n > 4e-4 {
            row.gain_per_s = (uv - u * v / n) / spread;
        }
        let length_um = self.lengths_um.at_phases();
        row.length_start_um = length_um.start;
        row.length_quarter_um = length_um.quarter;
        row.length_half_um = length_um.half;
        row.length_three_quarters_um = length_um.three_quarters;
        row.length_peak_um = length_um.peak;
        row.length_end_um = length_um.end;
        // From the length, not the area: the area follows the length with a power below one, so its relaxation is not a single
        // exponential. A cell at rest under load does not recover, even if its noise looks like it.
        if row.stroke_um > STILL_UM {
            row.recovery_s = self.lengths_um.recovery_s();
        }
        let area_um2 = self.areas_um2.at_phases();
        row.area_start_um2 = area_um2.start;
        row.area_quarter_um2 = area_um2.quarter;
        row.area_half_um2 = area_um2.half;
        row.area_three_quarters_um2 = area_um2.three_quarters;
        row.area_peak_um2 = area_um2.peak;
        row.area_end_um2 = area_um2.end;
        (row, worst)
    }
}
