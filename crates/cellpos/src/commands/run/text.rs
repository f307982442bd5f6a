//! What `cellpos run` prints in the end.

use super::learning::NamedTable;
use crate::cyclic;
use crate::kept;
use cellpos_runtime::Summary;
use cellpos_runtime::realtime::Conditions;
use cellpos_script::CycleRow;
use cellpos_session::connect;
use cellpos_session::{Ended, adapt};
use serde::Serialize;

/// How the session ended.
#[derive(Debug, Serialize)]
pub(crate) struct Ending<'a> {
    /// `done`, `stopped`, `aborted`, or the state of the life cycle.
    pub outcome: &'static str,
    /// What the script was doing last.
    pub stage: &'static str,
    /// How the loop ended, in sentences.
    pub ended: &'a Ended,
    /// Amplitude alarms.
    pub alarms: u64,
    /// The session's folder.
    pub run: String,
    /// The run's folder.
    pub folder: String,
}

/// What `--json` prints.
#[derive(Debug, Serialize)]
pub(crate) struct Report<'a> {
    #[serde(flatten)]
    ending: Ending<'a>,
    /// Cycles of the script.
    cycles: u64,
    /// Cycles in the table, those of earlier sessions included.
    cycles_done: u64,
    /// Of these: changed by what happened in them.
    cycles_disturbed: u64,
    /// Of the others: those with any event.
    cycles_touched: u64,
    /// Mean of reached over commanded amplitude, less 1, percent.
    amplitude_error_percent: Option<f64>,
    /// RMS of the tracking error over the cycles at the time of exposure, nm.
    cycle_rms_nm: Option<f64>,
    bound_rms_nm: Option<f64>,
    conditions: &'a Conditions,
    warnings: &'a [String],
    learned: &'a [NamedTable],
    summary: &'a Summary,
}

fn mean(values: impl Iterator<Item = f64>) -> Option<f64> {
    let (n, sum) = values
        .filter(|value| value.is_finite())
        .fold((0u64, 0.0), |(n, sum), value| (n + 1, sum + value));
    (n > 0).then(|| sum / n as f64)
}

impl<'a> Report<'a> {
    /// Joins what there is to say.
    #[allow(clippy::too_many_arguments, reason = "each is one part of the report")]
    pub(crate) fn new(
        ending: Ending<'a>,
        summary: &'a Summary,
        rows: &[CycleRow],
        cycles: u64,
        bound_rms_nm: Option<f64>,
        conditions: &'a Conditions,
        warnings: &'a [String],
        learned: &'a [NamedTable],
    ) -> Self {
        Self {
            ending,
            cycles,
            cycles_done: rows.len() as u64,
            cycles_disturbed: rows.iter().filter(|r| r.flags.is_disturbed()).count() as u64,
            cycles_touched: rows
                .iter()
                .filter(|r| r.flags.is_touched() && !r.flags.is_disturbed())
                .count() as u64,
            amplitude_error_percent: mean(
                rows.iter()
                    .map(|r| 100.0 * (r.reached_um / r.commanded_um - 1.0)),
            ),
            cycle_rms_nm: CycleRow::rms_over_um(rows).map(|um| um * 1e3),
            bound_rms_nm,
            conditions,
            warnings,
            learned,
            summary,
        }
    }

    /// For people.
    pub(crate) fn text(&self) -> String {
        let mut out = String::new();
        let mut line = |name: &str, value: String| out.push_str(&format!("{name:<18}{value}\n"));
        let or_dash = |value: Option<f64>, unit: &str| {
            value.map_or_else(|| "-".to_string(), |value| format!("{value:.1} {unit}"))
        };
        line(
            "outcome",
            match self.ending.ended.as_asked() {
                false => format!("{}: {}", self.ending.outcome, self.ending.ended.seen),
                true => format!("{} ({})", self.ending.outcome, self.ending.stage),
            },
        );
        if !self.ending.ended.as_asked() {
            line("expected", self.ending.ended.expected.clone());
            line("to do", self.ending.ended.to_do.clone());
        }
        line(
            "cycles",
            format!(
                "{} of {} done, {} disturbed, {} more with a lost frame or the like",
                self.cycles_done, self.cycles, self.cycles_disturbed, self.cycles_touched
            ),
        );
        line(
            "amplitude error",
            format!(
                "{} in the mean, {} alarms",
                or_dash(self.amplitude_error_percent, "%"),
                self.ending.alarms
            ),
        );
        line(
            "error",
            format!("{} RMS over the cycles", or_dash(self.cycle_rms_nm, "nm")),
        );
        line("error, all", kept::error(&self.summary.kept));
        line("held", kept::held(&self.summary.kept));
        let possible = connect::possible_text(self.bound_rms_nm, self.summary.rms_measured_nm);
        line("lowest possible", possible);
        if let Some(now) = &self.summary.adaptation {
            line("adaptation", adapt::text(now));
        }
        let c = &self.summary.counts;
        line(
            "frames",
            format!(
                "{} lost, {} stale, {} without a position, {} ticks coasted",
                c.frames_lost, c.stale, c.fixes_lost, c.coasted
            ),
        );
        line(
            "ticks",
            format!(
                "{} in {:.3} s, {} late, {} skipped, {} records lost",
                c.ticks, self.summary.duration_s, c.late, c.skipped, self.summary.records_lost
            ),
        );
        if let Some(lost) = self.summary.commands_lost.filter(|&lost| lost > 0) {
            line(
                "commands",
                commands_lost(lost, self.summary.commands_not_taken),
            );
        }
        for learned in self.learned {
            let text = cyclic::learned_text(&learned.table);
            line("learned", format!("{}: {text}", learned.name));
        }
        for degraded in &self.conditions.degraded {
            line("DEGRADED", degraded.clone());
        }
        for warning in self.warnings {
            line("WARNING", warning.clone());
        }
        line("run", self.ending.run.clone());
        if !["done", "not-kept"].contains(&self.ending.outcome) {
            line(
                "go on with",
                format!("cellpos run --resume {}", self.ending.folder),
            );
        }
        out
    }
}

/// What became of commands on the way to the board, in words.
pub(crate) fn commands_lost(lost: u64, not_taken: Option<u64>) -> String {
    let not_taken = not_taken.unwrap_or(0);
    format!("{lost} lost on the way to the board; its line refused {not_taken} of these")
}
