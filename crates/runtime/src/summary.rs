//! Summary of a run: errors, losses and timing, gathered from the records as they pass.

use crate::core::Counts;
use crate::keeping::{Hold, KeepWatch, Kept};
use crate::latency::Quantiles;
use crate::life::{Life, SafeReason};
use crate::recording::RecorderReport;
use crate::reference::Stage;
use crate::tick_record::{TickFlags, TickRecord};
use crate::ticker::Account;
use cellpos_control::Adaptation;
use cellpos_rig::CommandAccount;
use serde::Serialize;

/// Running sums of one quantity.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Moments {
    n: u64,
    sum: f64,
    sum_of_squares: f64,
}

impl Moments {
    fn add(&mut self, value: f64) {
        if value.is_finite() {
            self.n += 1;
            self.sum += value;
            self.sum_of_squares += value * value;
        }
    }

    fn rms_nm(&self) -> Option<f64> {
        (self.n > 0).then(|| (self.sum_of_squares / self.n as f64).sqrt() * 1e3)
    }
}

/// How far a reference's own time went while the clock went on.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct PlanWatch {
    plan_ns: i64,
    clock_ns: i64,
}

impl PlanWatch {
    /// What is shorter says nothing: plan and clock may be a period apart at any time, ns.
    const SHORTEST_NS: i64 = 1_000_000_000;
    /// Between two records the operator may have skipped a step, which leaves out its time, ns.
    const SKIPPED_NS: i64 = 50_000_000;

    fn add(&mut self, before: &TickRecord, now: &TickRecord) {
        let by_the_plan = |r: &TickRecord| {
            r.plan_ns >= 0 && r.stage == Stage::Running as u8 && !r.flags.has(TickFlags::FREEZE)
        };
        let (plan_ns, clock_ns) = (now.plan_ns - before.plan_ns, now.time_ns - before.time_ns);
        if by_the_plan(before) && by_the_plan(now) && (plan_ns - clock_ns).abs() < Self::SKIPPED_NS
        {
            self.plan_ns = self.plan_ns.saturating_add(plan_ns);
            self.clock_ns = self.clock_ns.saturating_add(clock_ns);
        }
    }

    fn off_percent(&self) -> Option<f64> {
        (self.clock_ns >= Self::SHORTEST_NS)
            .then(|| 100.0 * (self.plan_ns as f64 / self.clock_ns as f64 - 1.0))
    }
}

/// How long after closing the loop errors are counted from, s, unless the run says otherwise.
pub const SETTLED_AFTER_S: f64 = 2.0;

/// Statistics over the records of a run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Statistics {
    settled_after_ns: i64,
    running_since_ns: Option<i64>,
    /// The bead of the newest record is held.
    held: bool,
    keeping: KeepWatch,
    truth: Moments,
    variance: Moments,
    step: Option<StepWatch>,
    plan: PlanWatch,
    last: Option<TickRecord>,
}

/// How the bead went from where it was to where it should be, after the loop was closed.
#[derive(Debug, Clone, Copy, PartialEq)]
struct StepWatch {
    target_um: f64,
    size_um: f64,
    overshoot_um: f64,
    last_outside_ns: i64,
}

/// Figures of the move to the first reference, if it was one worth the name.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct StepResult {
    /// From the bead to the reference when the loop was closed, um.
    pub size_um: f64,
    /// Largest excursion beyond the reference, percent of the size (Brownian motion included).
    pub overshoot_percent: f64,
    /// Until the bead stayed within 5 % of the size, ms.
    pub settling_ms: f64,
}

impl StepWatch {
    /// Of a shorter move the band of 5 % is within the Brownian motion of a held bead (0.25 um: four times its RMS), um.
    const SMALLEST_UM: f64 = 5.0;
    /// The move is over after this long, ns: what comes later is another matter.
    const LONGEST_NS: i64 = 1_000_000_000;

    fn add(&mut self, position_um: f64, since_ns: i64) {
        if since_ns > Self::LONGEST_NS || !position_um.is_finite() {
            return;
        }
        let beyond_um = (position_um - self.target_um) * self.size_um.signum();
        self.overshoot_um = self.overshoot_um.max(beyond_um);
        if beyond_um.abs() > 0.05 * self.size_um.abs() {
            self.last_outside_ns = since_ns;
        }
    }
}

impl Default for Statistics {
    fn default() -> Self {
        Self::new(SETTLED_AFTER_S)
    }
}

impl Statistics {
    /// Counts errors from `settled_after_s` after the loop was closed.
    pub fn new(settled_after_s: f64) -> Self {
        Self {
            settled_after_ns: (settled_after_s * 1e9) as i64,
            running_since_ns: None,
            held: false,
            keeping: KeepWatch::default(),
            truth: Moments::default(),
            variance: Moments::default(),
            step: None,
            plan: PlanWatch::default(),
            last: None,
        }
    }

    /// The same for a run that is to hold a bead, as well as can be expected.
    #[must_use]
    pub fn holding(self, hold: Hold) -> Self {
        Self {
            keeping: KeepWatch::expecting(hold),
            ..self
        }
    }

    /// Takes one record.
    pub fn add(&mut self, record: &TickRecord) {
        if let Some(before) = &self.last {
            self.plan.add(before, record);
        }
        // A bead that the operator froze is not held on its reference: its wandering is no error of the loop. When the run continues, the
        // errors start as they do after the loop was closed. A bead that was not seen is no less far off for that.
        let held = KeepWatch::is_held(record);
        if held {
            if !self.held && self.running_since_ns.is_some() {
                self.running_since_ns = Some(record.time_ns);
            }
            let seen_um = if record.true_um.is_finite() {
                record.true_um
            } else {
                record.measured_um
            };
            let first = self.running_since_ns.is_none();
            let since = *self.running_since_ns.get_or_insert(record.time_ns);
            let size_um = record.target_um - seen_um;
            if first && size_um.abs() >= StepWatch::SMALLEST_UM {
                self.step = Some(StepWatch {
                    target_um: record.target_um,
                    size_um,
                    overshoot_um: 0.0,
                    last_outside_ns: 0,
                });
            }
            if let Some(step) = &mut self.step {
                step.add(seen_um, record.time_ns - since);
            }
            let counts = record.time_ns - since >= self.settled_after_ns;
            self.keeping.add(record, counts);
            if counts {
                self.truth.add(record.true_um - record.target_um);
                self.variance.add(record.variance_um2);
            }
        } else {
            self.keeping.pause();
        }
        self.held = held;
        self.last = Some(*record);
    }

    /// The newest record.
    pub fn last(&self) -> Option<&TickRecord> {
        self.last.as_ref()
    }

    /// How far the plan's time is off the clock's so far, percent; `None` before a second by a plan.
    pub fn plan_off_percent(&self) -> Option<f64> {
        self.plan.off_percent()
    }

    /// Localisation noise as vision states it, um RMS; `None` before the first position.
    pub fn fix_noise_um(&self) -> Option<f64> {
        (self.variance.n > 0).then(|| (self.variance.sum / self.variance.n as f64).max(0.0).sqrt())
    }

    fn step_result(&self) -> Option<StepResult> {
        self.step.map(|step| StepResult {
            size_um: step.size_um,
            overshoot_percent: 100.0 * step.overshoot_um / step.size_um.abs(),
            settling_ms: step.last_outside_ns as f64 * 1e-6,
        })
    }

    /// RMS of measured position less reference so far, nm.
    pub fn rms_measured_nm(&self) -> Option<f64> {
        self.keeping.rms_measured_nm()
    }

    /// Positions that the errors are of.
    pub fn positions(&self) -> u64 {
        self.keeping.positions()
    }

    /// Mean of measured position less reference so far, nm.
    pub fn mean_error_nm(&self) -> Option<f64> {
        self.keeping.mean_nm()
    }

    /// Largest distance of a measured position from its reference so far, nm.
    pub fn peak_error_nm(&self) -> Option<f64> {
        self.keeping.peak_nm()
    }

    /// How the run has kept its bead so far.
    pub fn kept(&self) -> Kept {
        self.keeping.kept()
    }

    /// Whether the errors of this tick are among those counted: the loop closed and settled, the bead not frozen by the operator.
    pub fn counts_now(&self) -> bool {
        let held = self.last.as_ref().filter(|_| self.held);
        held.zip(self.running_since_ns)
            .is_some_and(|(r, since)| r.time_ns - since >= self.settled_after_ns)
    }
}

/// The sentence of a plan that is off the clock by so much.
pub fn plan_warning(percent: f64) -> String {
    format!(
        "the plan's time is {percent:+.1} % off the clock's: frequencies and durations of this run are not those of its script"
    )
}

/// How a run ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum End {
    /// Its time was over.
    Duration,
    /// The script came to its end, or to one of its stop conditions.
    Script,
    /// The operator ended it.
    Operator,
    /// Safe was latched.
    Safe,
}

/// In what state a run ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum EndState {
    /// The board was not armed.
    Disarmed,
    /// The loop was never closed.
    Armed,
    /// The loop ran, and kept its bead.
    Running,
    /// The loop ran to the end and did not keep its bead: [`Kept::why`].
    NotKept,
    /// Safe was latched.
    Safe,
}

impl EndState {
    fn new(life: Life, kept: &Kept) -> Self {
        match life {
            Life::Disarmed => Self::Disarmed,
            Life::Armed => Self::Armed,
            Life::Running if kept.why.is_some() => Self::NotKept,
            Life::Running => Self::Running,
            Life::Safe => Self::Safe,
        }
    }

    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Disarmed => "disarmed",
            Self::Armed => "armed",
            Self::Running => "running",
            Self::NotKept => "not-kept",
            Self::Safe => "safe",
        }
    }
}

/// The figures of a run. Errors count from two seconds after the loop was closed, or resumed after a freeze by the operator, until the PZT
/// parks. Moments without a fix count; `None` where there is nothing to say.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Summary {
    /// State in which the run ended: `running` unless something went wrong.
    pub state: EndState,
    /// Why it ended.
    pub end: End,
    /// Why Safe was latched, if it was.
    pub safe_reason: Option<SafeReason>,
    /// From the start of the run, before the first frame, to the end of the last tick, s.
    pub duration_s: f64,
    /// Deviation of the plan's (script's) time from the clock's, percent; `None` without a plan, or less than a second of it.
    pub plan_off_percent: Option<f64>,
    /// Losses and limits by kind.
    #[serde(flatten)]
    pub counts: Counts,
    /// Records that are not on disk: the recorder's ring was full, the recorder failed, or the disk refused.
    pub records_lost: u64,
    /// Events that found their ring full.
    pub events_lost: u64,
    /// Commands handed over that the board never named as obeyed; `None` where the actuator does not say.
    pub commands_lost: Option<u64>,
    /// Of these, commands that the line did not take before a newer one replaced them.
    pub commands_not_taken: Option<u64>,
    /// How the run kept its bead, and its error.
    pub kept: Kept,
    /// RMS of measured position less the reference at its exposure ([`TickRecord::error_um`]), nm; moments without a fix count through the estimate.
    pub rms_measured_nm: Option<f64>,
    /// RMS of true position less reference, nm (emulated rig).
    pub rms_true_nm: Option<f64>,
    /// Mean of measured position less reference, nm.
    pub mean_error_nm: Option<f64>,
    /// Largest distance of the measured position from the reference, nm.
    pub peak_error_nm: Option<f64>,
    /// Localisation noise as vision states it, nm RMS.
    pub fix_noise_nm: Option<f64>,
    /// The move to the first reference; `None` when the bead was there already.
    pub step: Option<StepResult>,
    /// The estimate of the plant's gain and delay at the end, and the tuning of the loop; `None` where it does not adapt.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub adaptation: Option<Adaptation>,
    /// Median loop delay: exposure to command, and half a period of hold, ms.
    pub loop_delay_ms: f64,
    /// From the start of a tick to the hand-over of its command, us.
    pub tick_us: Quantiles,
    /// From the arrival of a position to the start of its tick, us.
    pub wake_us: Quantiles,
    /// From the middle of the exposure to the hand-over of the command computed from it, us.
    pub exposure_to_command_us: Quantiles,
    /// How far the spacing of commands that the board saw is off that at which they were handed over, us.
    pub board_spacing_us: Quantiles,
}

impl Summary {
    /// Plan and clock may differ by so much before every output says so, percent.
    pub const PLAN_OFF_PERCENT: f64 = 1.0;

    /// Says so in a sentence where plan and clock differ by more than they may.
    pub fn plan_warning(&self) -> Option<String> {
        self.plan_off_percent
            .filter(|percent| percent.is_nan() || percent.abs() > Self::PLAN_OFF_PERCENT)
            .map(plan_warning)
    }

    /// The same figures with the records counted as lost that the recorder could not hand over.
    #[must_use]
    pub fn with_unkept(mut self, recorder: &RecorderReport) -> Self {
        self.records_lost += recorder.records_unkept;
        self.events_lost += recorder.events_unkept;
        self
    }

    /// The same figures with what became of the commands.
    #[must_use]
    pub fn with_commands(self, account: Option<CommandAccount>) -> Self {
        Self {
            commands_lost: account.map(|account| account.lost_in_all()),
            commands_not_taken: account.map(|account| account.not_taken),
            ..self
        }
    }

    /// The same figures with what adaptation came to.
    #[must_use]
    pub fn with_adaptation(self, adaptation: Option<Adaptation>) -> Self {
        Self { adaptation, ..self }
    }

    /// Joins the accounts of the control thread and of the records.
    pub fn new(
        life: Life,
        safe_reason: Option<SafeReason>,
        end: End,
        counts: Counts,
        account: &Account,
        statistics: &Statistics,
        period_us: f64,
    ) -> Self {
        let last_ns = statistics.last().map_or(0, |record| record.time_ns);
        let kept = statistics.kept();
        Self {
            state: EndState::new(life, &kept),
            end,
            safe_reason,
            duration_s: (last_ns as f64 + period_us * 1e3) * 1e-9,
            plan_off_percent: statistics.plan_off_percent(),
            counts,
            records_lost: account.records_lost,
            events_lost: account.events_lost,
            commands_lost: None,
            commands_not_taken: None,
            kept,
            rms_measured_nm: statistics.keeping.rms_measured_nm(),
            rms_true_nm: statistics.truth.rms_nm(),
            mean_error_nm: statistics.keeping.mean_nm(),
            peak_error_nm: statistics.keeping.peak_nm(),
            fix_noise_nm: statistics.fix_noise_um().map(|um| um * 1e3),
            step: statistics.step_result(),
            adaptation: None,
            loop_delay_ms: account.exposure_to_command.quantiles_us().p50 * 1e-3
                + 0.5e-3 * period_us,
            tick_us: account.tick.quantiles_us(),
            wake_us: account.wake.quantiles_us(),
            exposure_to_command_us: account.exposure_to_command.quantiles_us(),
            board_spacing_us: account.board_spacing.quantiles_us(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Ten seconds in ticks of `tick_ns` of which each takes the plan a millisecond on, with a second's skip in between.
    fn off_percent(tick_ns: i64) -> Option<f64> {
        let mut statistics = Statistics::default();
        for k in 0..10_000 {
            let mut record = TickRecord::unknown();
            record.life = Life::Running as u8;
            record.stage = Stage::Running as u8;
            record.time_ns = k * tick_ns;
            record.plan_ns = (k + if k > 5000 { 1000 } else { 0 }) * 1_000_000;
            statistics.add(&record);
        }
        statistics.plan_off_percent()
    }

    #[test]
    fn a_plan_that_runs_by_the_number_of_ticks_is_off_the_clock_and_said_to_be() {
        assert!(off_percent(1_000_000).is_some_and(|percent| percent.abs() < 1e-9));
        let doubled = off_percent(500_000).expect("seconds of plan");
        assert!((doubled - 100.0).abs() < 1e-6, "{doubled}");
        let slow = off_percent(1_020_000).expect("seconds of plan");
        assert!((slow + 1.96).abs() < 0.01, "{slow}");
        assert!(plan_warning(slow).contains("-2.0 %"));
        assert_eq!(Statistics::default().plan_off_percent(), None);
    }
}
