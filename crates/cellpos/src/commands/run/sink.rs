//! Where the records of a script go: the run folder, the per-cycle table, the progress bar.

use super::learning::Keeper;
use super::unshown::Unshown;
use crate::recording::log_event;
use cellpos_control::LearnerState;
use cellpos_record::{Event as LogEvent, Faults, LineFile, RunWriter};
use cellpos_rig::Clock;
use cellpos_runtime::live::Operator;
use cellpos_runtime::recorder::Unconfirmed;
use cellpos_runtime::{Event, Request, RunSink, Stage, Statistics, TickRecord};
use cellpos_script::{Alarm, AmplitudeWatch, AtRest, CycleRow, CycleTable, FatigueWatch, Plan};
use cellpos_session::say::say;
use cellpos_session::sessions::SessionConfig;
use indicatif::{ProgressBar, ProgressStyle};
use std::ops::Range;
use std::sync::Arc;

/// Writes run folder and table, marks and alarms, and shows how far it is.
pub(super) struct ScriptSink {
    writer: RunWriter,
    lines: LineFile,
    cycles: CycleTable,
    watch: AmplitudeWatch,
    /// Ends the run when the amplitude error is too large.
    limit: Option<AmplitudeWatch>,
    /// Ends the run when the cell has changed as much as the script says.
    fatigue: Option<FatigueWatch>,
    operator: Arc<Operator>,
    pub(super) plan: Arc<Plan>,
    pub(super) unshown: Unshown,
    bar: ProgressBar,
    /// Rows that are not yet acknowledged: their ticks go to the disk first.
    waiting: Vec<CycleRow>,
    acknowledged_ns: i64,
    next_mark: usize,
    pub(super) last: Option<TickRecord>,
    stage: Stage,
    alarms: u64,
    /// Why the rows of the table stopped it.
    row_stop: Option<RowStop>,
    /// Length of the cell at the start of the first cycle, um.
    at_rest: AtRest,
    stretch: Option<f64>,
    stalls: Option<Stalls>,
    keeper: Option<Keeper>,
    /// Whether what is learned is written as the run goes: on the virtual clock its end is soon enough.
    keep_live: bool,
}

/// When the recorder takes nothing, to see what becomes of a run then.
pub(super) struct Stalls {
    /// Spans of the clock, ns.
    pub spans_ns: Vec<Range<i64>>,
    /// The clock of the run.
    pub clock: Clock,
}

/// A limit of the script that the rows of the per-cycle table passed.
#[derive(Debug, Clone)]
pub(super) struct RowStop {
    /// In short.
    pub name: &'static str,
    /// What was seen.
    pub seen: String,
}

/// How a script came to its end.
#[derive(Debug, Clone)]
pub(super) struct End {
    /// What it was doing last.
    pub stage: Stage,
    /// Why the rows of the per-cycle table stopped it, if they did.
    pub row_stop: Option<RowStop>,
    /// Alarms given.
    pub alarms: u64,
}

impl End {
    /// In words.
    pub(super) fn name(&self) -> &'static str {
        (self.row_stop.as_ref()).map_or_else(|| self.stage.name(), |stop| stop.name)
    }

    /// Whether a condition of the script stopped it.
    pub(super) fn is_stop(&self) -> bool {
        self.row_stop.is_some() || self.stage.is_over()
    }

    /// Whether the script reached its end.
    pub(super) fn complete(&self) -> bool {
        let over = [Stage::Done, Stage::StoppedCycles, Stage::StoppedTime];
        self.row_stop.is_none() && over.contains(&self.stage)
    }
}

impl ScriptSink {
    /// A sink that has written the start of the session.
    pub(super) fn new(
        mut writer: RunWriter,
        lines: LineFile,
        cycles: CycleTable,
        watch: AmplitudeWatch,
        plan: Arc<Plan>,
        operator: Arc<Operator>,
        config: &SessionConfig,
    ) -> Self {
        let mut begun = LogEvent::new(0.0, "session")
            .with("number", config.number)
            .with("first_cycle", config.first_cycle);
        if let Some(gap_s) = config.gap_s {
            begun = begun.with("gap_s", gap_s);
        }
        writer.event(&begun);
        // Hidden automatically if standard error is no terminal.
        let bar = crate::output::progress_bar(Some((plan.total_s() * 1e3) as u64));
        if let Ok(style) = ProgressStyle::with_template("{bar:30} {percent:>3}% {wide_msg}") {
            bar.set_style(style);
        }
        let from_s = plan
            .cycle(config.first_cycle)
            .map_or(0.0, |cycle| cycle.start_s);
        let next_mark = if config.number > 1 {
            plan.marks().partition_point(|mark| mark.time_s < from_s)
        } else {
            0
        };
        Self {
            limit: plan
                .stop()
                .amplitude_error_above
                .map(|limit| AmplitudeWatch::new(limit, AmplitudeWatch::WINDOW)),
            fatigue: FatigueWatch::new(plan.stop()),
            writer,
            lines,
            cycles,
            watch,
            operator,
            plan,
            bar,
            unshown: Unshown::default(),
            waiting: Vec::new(),
            acknowledged_ns: 0,
            next_mark,
            last: None,
            stage: Stage::None,
            alarms: 0,
            row_stop: None,
            at_rest: AtRest::default(),
            stretch: None,
            stalls: None,
            keeper: None,
            keep_live: false,
        }
    }

    /// The same sink, that keeps what is learned: as the run goes, or not at all before its end.
    pub(super) fn with_keeper(self, keeper: Keeper, live: bool) -> Self {
        Self {
            keeper: Some(keeper),
            keep_live: live,
            ..self
        }
    }

    /// The same sink, that keeps for a live page what only it knows.
    pub(super) fn with_page(self, page: bool) -> Self {
        Self {
            unshown: Unshown::new(page),
            ..self
        }
    }

    /// The same sink, that takes nothing in some spans of time.
    pub(super) fn with_stalls(self, stalls: Stalls) -> Self {
        Self {
            stalls: Some(stalls),
            ..self
        }
    }

    /// How it ended.
    pub(super) fn end(&self) -> End {
        End {
            stage: self.stage,
            row_stop: self.row_stop.clone(),
            alarms: self.alarms,
        }
    }

    /// Acknowledges finished rows and returns the writer, with the rows that could not be written.
    pub(super) fn close(mut self) -> (RunWriter, Faults) {
        self.acknowledge();
        self.lines.close();
        self.bar.finish_and_clear();
        (self.writer, self.lines.faults())
    }

    /// Ticks first, then the rows that rest on them: a row in the table is never without its ticks.
    fn acknowledge(&mut self) {
        if !self.waiting.is_empty() {
            self.writer.flush();
            for row in self.waiting.drain(..) {
                self.lines.push(&row.to_csv());
            }
        }
        self.lines.flush();
        if self.keep_live
            && let Some(keeper) = &mut self.keeper
        {
            keeper.save();
        }
    }

    fn row(&mut self, row: CycleRow, time_s: f64) {
        if let Some(alarm) = self.watch.add(&row) {
            let (name, error, event) = match alarm {
                Alarm::Raised { error, per_cycle } => (
                    "amplitude-alarm",
                    error,
                    LogEvent::new(time_s, "amplitude-alarm")
                        .with("percent_per_cycle", per_cycle * 100.0),
                ),
                Alarm::Cleared { error } => (
                    "amplitude-alarm-cleared",
                    error,
                    LogEvent::new(time_s, "amplitude-alarm-cleared"),
                ),
            };
            self.alarms += u64::from(name == "amplitude-alarm");
            self.writer.event(
                &event
                    .with("cycle", row.cycle)
                    .with("error_percent", error * 100.0),
            );
            let text = format!(
                "{name}: cycle {}: mean amplitude error {:+.1} %",
                row.cycle,
                error * 100.0
            );
            let level = match alarm {
                Alarm::Raised { .. } => "warning",
                Alarm::Cleared { .. } => "info",
            };
            self.unshown.line(time_s, level, text.clone());
            say(text);
        }
        self.at_rest.take(&row);
        self.unshown.cycle(&row, &self.at_rest);
        self.judge(&row, time_s);
        self.judge_cell(&row, time_s);
        let stretch = self.at_rest.stretch(&row);
        self.stretch = stretch.is_finite().then_some(stretch).or(self.stretch);
        self.waiting.push(row);
    }

    /// The script's own limit of the amplitude error: the bead is frozen and the run ends.
    fn judge(&mut self, row: &CycleRow, time_s: f64) {
        let Some(Alarm::Raised { error, .. }) =
            self.limit.as_mut().and_then(|limit| limit.add(row))
        else {
            return;
        };
        let event = LogEvent::new(time_s, "amplitude-stop")
            .with("cycle", row.cycle)
            .with("error_percent", error * 100.0);
        self.writer.event(&event);
        self.stop(
            "stopped: amplitude error too large",
            format!(
                "the script's error_above stopped it in cycle {}: the amplitude error was {:.1} %",
                row.cycle + 1,
                error * 100.0
            ),
        );
    }

    /// The script's limits for the cell.
    fn judge_cell(&mut self, row: &CycleRow, time_s: f64) {
        let Some(passed) = self.fatigue.as_mut().and_then(|watch| watch.add(row)) else {
            return;
        };
        let event = LogEvent::new(time_s, "fatigue-stop")
            .with("cycle", row.cycle)
            .with("quantity", passed.quantity)
            .with("first", passed.first)
            .with("value", passed.value)
            .with("allowed", passed.allowed);
        self.writer.event(&event);
        // Said once: the rows behind it are of a bead that is frozen.
        self.fatigue = None;
        let (name, of) = match passed.quantity {
            "stretch_down" => ("stopped: the cell stretches less", "its stretch"),
            "rest_length_change" => (
                "stopped: the cell at rest has another length",
                "its length at rest, um,",
            ),
            _ => (
                "stopped: the cell recovers more slowly",
                "its recovery time, s,",
            ),
        };
        self.stop(
            name,
            format!(
                "the script's {} stopped it in cycle {}: {of} went from {:.3} to {:.3}; the limit was {:.3}",
                passed.quantity,
                row.cycle + 1,
                passed.first,
                passed.value,
                passed.allowed
            ),
        );
    }

    fn stop(&mut self, name: &'static str, seen: String) {
        if !matches!(self.operator.asked(), Request::Freeze | Request::Park) {
            let time_s = self.last.map_or(0.0, |r| r.time_ns as f64 * 1e-9);
            self.unshown
                .line(time_s, "fault", format!("The script is {name}."));
            self.row_stop = Some(RowStop { name, seen });
            self.operator.ask(Request::Freeze);
        }
    }

    /// The same sink, that knows the cycles of the sessions before.
    pub(super) fn with_cycles_done(mut self, rows: &[CycleRow]) -> Self {
        for row in rows {
            self.at_rest.take(row);
            if let Some(watch) = &mut self.fatigue {
                watch.add(row);
            }
        }
        self
    }

    fn message(&self, r: &TickRecord) -> String {
        let plan_s = r.plan_ns.max(0) as f64 * 1e-9;
        let left_s = (self.plan.total_s() - plan_s).max(0.0);
        let stage = Stage::from_number(r.stage).name();
        let cycle = self.plan.cycle_at(plan_s).map_or_else(
            || "between cycles".to_string(),
            |cycle| {
                format!(
                    "cycle {} of {}, {:3.0} %",
                    cycle.number + 1,
                    self.plan.cycle_count(),
                    100.0 * (plan_s - cycle.start_s) / cycle.duration_s
                )
            },
        );
        let mut amplitude = self.watch.error().map_or(String::new(), |error| {
            format!("  amplitude {:+.1} %", error * 100.0)
        });
        // Fewer cycles give a slope that is chance.
        if let Some((_, per_cycle)) = self.watch.trend().filter(|(cycles, _)| *cycles >= 20) {
            amplitude.push_str(&format!(" ({:+.2} %/100 cycles)", per_cycle * 1e4));
        }
        if let Some(stretch) = self.stretch {
            amplitude.push_str(&format!("  stretch {stretch:.2}"));
        }
        let error = match r.error_um.is_finite() {
            true => format!("  error {:+.0}nm", r.error_um * 1e3),
            false => String::new(),
        };
        format!("{cycle}  {stage}  {} left{amplitude}{error}", time(left_s))
    }
}

/// A time as a person reads it.
fn time(s: f64) -> String {
    let s = s.round() as u64;
    match s {
        0..=59 => format!("{s}s"),
        60..=3599 => format!("{}min{:02}s", s / 60, s % 60),
        _ => format!("{}h{:02}min", s / 3600, s / 60 % 60),
    }
}

impl RunSink for ScriptSink {
    fn tick(&mut self, record: &TickRecord) {
        const ACKNOWLEDGE_NS: i64 = 1_000_000_000;
        self.writer.tick(record);
        let time_s = record.time_ns as f64 * 1e-9;
        let stage = Stage::from_number(record.stage);
        if stage != Stage::None {
            self.stage = stage;
        }
        if matches!(stage, Stage::Running | Stage::Waiting | Stage::Done) {
            while let Some(mark) = self.plan.marks().get(self.next_mark) {
                let waits = mark.after_wait && stage == Stage::Waiting;
                if waits || mark.time_s * 1e9 > record.plan_ns as f64 + 0.5 {
                    break;
                }
                let event = LogEvent::new(time_s, "mark")
                    .with("text", mark.text.clone())
                    .with("plan_s", mark.time_s);
                self.writer.event(&event);
                self.unshown
                    .line(time_s, "info", format!("Mark: {}", mark.text));
                self.next_mark += 1;
            }
        }
        self.cycles.add(record);
        while let Some(row) = self.cycles.pop() {
            self.row(row, time_s);
        }
        if record.time_ns - self.acknowledged_ns >= ACKNOWLEDGE_NS {
            self.acknowledged_ns = record.time_ns;
            self.acknowledge();
        }
        self.last = Some(*record);
    }

    fn event(&mut self, event: &Event) {
        self.writer.event(&log_event(event));
    }

    fn repeated(&mut self, last: &Event, count: u64) {
        self.writer.event(&log_event(last).with("times", count));
    }

    fn note(&mut self, time_ns: i64, text: &str) {
        let event = LogEvent::new(time_ns as f64 * 1e-9, "note").with("text", text);
        self.writer.event(&event);
    }

    fn is_refused(&self) -> bool {
        self.writer.is_failing() || self.lines.is_failing()
    }

    fn unconfirmed(&self) -> Unconfirmed {
        let (ticks, lines) = (self.writer.unconfirmed(), self.lines.unconfirmed());
        Unconfirmed {
            since: ticks.since.max(lines.since),
            rows: ticks.rows,
        }
    }

    fn learned(&mut self, motion: u16, state: &LearnerState) {
        if let Some(keeper) = &mut self.keeper {
            keeper.take(motion, state);
        }
    }

    fn is_ready(&self) -> bool {
        self.stalls.as_ref().is_none_or(|stalls| {
            let now_ns = stalls.clock.now_ns();
            !stalls.spans_ns.iter().any(|span| span.contains(&now_ns))
        })
    }

    fn progress(&mut self, _: &Statistics) {
        self.writer.poll();
        if self.bar.is_hidden() {
            return;
        }
        if let Some(r) = &self.last {
            self.bar.set_position((r.plan_ns.max(0) / 1_000_000) as u64);
            self.bar.set_message(self.message(r));
        }
    }
}
