//! Where the records of a script go: the run folder, the per-cycle table, the progress bar.

use super::SessionConfig;
use crate::recording::log_event;
use cellpos_record::{Event as LogEvent, Faults, LineFile, RunWriter};
use cellpos_runtime::{Event, RunSink, Stage, Statistics, TickRecord};
use cellpos_script::{Alarm, AmplitudeWatch, CycleRow, CycleTable, Plan};
use indicatif::{ProgressBar, ProgressStyle};
use std::sync::Arc;

/// Writes run folder and table, marks and alarms, and shows how far it is.
pub struct ScriptSink {
    writer: RunWriter,
    lines: LineFile,
    cycles: CycleTable,
    watch: AmplitudeWatch,
    plan: Arc<Plan>,
    bar: ProgressBar,
    /// Rows that are not yet acknowledged: their ticks go to the disk first.
    waiting: Vec<CycleRow>,
    acknowledged_ns: i64,
    next_mark: usize,
    last: Option<TickRecord>,
    stage: Stage,
    alarms: u64,
}

/// How a script came to its end.
#[derive(Debug, Clone, Copy)]
pub struct End {
    /// What it was doing last.
    pub stage: Stage,
    /// Alarms given.
    pub alarms: u64,
}

impl End {
    /// Whether the script did what it was to do.
    pub fn complete(&self) -> bool {
        matches!(
            self.stage,
            Stage::Done | Stage::StoppedCycles | Stage::StoppedTime
        )
    }
}

impl ScriptSink {
    /// A sink that has written the start of the session.
    pub fn new(
        mut writer: RunWriter,
        lines: LineFile,
        cycles: CycleTable,
        watch: AmplitudeWatch,
        plan: Arc<Plan>,
        config: &SessionConfig,
    ) -> Self {
        let mut begun = LogEvent::new(0.0, "session")
            .with("number", config.number)
            .with("first_cycle", config.first_cycle);
        if let Some(gap_s) = config.gap_s {
            begun = begun.with("gap_s", gap_s);
        }
        writer.event(&begun);
        // Hidden by itself where standard error is no terminal.
        let bar = ProgressBar::new((plan.total_s() * 1e3) as u64);
        if let Ok(style) = ProgressStyle::with_template("{bar:30} {percent:>3}% {msg}") {
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
            writer,
            lines,
            cycles,
            watch,
            plan,
            bar,
            waiting: Vec::new(),
            acknowledged_ns: 0,
            next_mark,
            last: None,
            stage: Stage::None,
            alarms: 0,
        }
    }

    /// How it ended.
    pub fn end(&self) -> End {
        End {
            stage: self.stage,
            alarms: self.alarms,
        }
    }

    /// Acknowledges what is finished and gives the writer back, with what of the table could not be written.
    pub fn close(mut self) -> (RunWriter, Faults) {
        self.acknowledge();
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
            self.bar.suspend(|| {
                eprintln!(
                    "{name}: cycle {}: mean amplitude error {:+.1} %",
                    row.cycle,
                    error * 100.0
                );
            });
        }
        self.waiting.push(row);
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
        let amplitude = self.watch.error().map_or(String::new(), |error| {
            format!("  amplitude {:+.1} %", error * 100.0)
        });
        format!(
            "{cycle}  {stage}  {} left{amplitude}  error {:+.0}nm",
            time(left_s),
            (r.measured_um - r.target_um) * 1e3
        )
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
                if mark.time_s * 1e9 > record.plan_ns as f64 + 0.5 {
                    break;
                }
                let event = LogEvent::new(time_s, "mark")
                    .with("text", mark.text.clone())
                    .with("plan_s", mark.time_s);
                self.writer.event(&event);
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
