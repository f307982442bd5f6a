//! Progress of a script for the live page: cycle, next step, time left, trend of the cycles.

use super::sink::ScriptSink;
use cellpos_runtime::Stage;
use cellpos_script::{Condition, Motion, Plan, Segment};
use cellpos_session::view::{self, EventLine, Shown, State};

impl Shown for ScriptSink {
    fn complete(&self, state: &mut State) {
        let Some(record) = &self.last else {
            return;
        };
        let plan_s = record.plan_ns.max(0) as f64 * 1e-9;
        let stage = Stage::from_number(record.stage);
        if stage == Stage::Paused && state.banner.state == "frozen" {
            state.banner.state = "paused";
        }
        if stage.is_over() {
            state.banner.reason = format!("The script {}.", stage.name());
        }
        state.cycle = self
            .plan
            .cycle_at(plan_s)
            .map(|cycle| [cycle.number + 1, self.plan.cycle_count()]);
        state.next = next(&self.plan, plan_s);
        state.left_s = Some((self.plan.total_s() - plan_s).max(0.0));
    }

    fn next_cycle(&mut self) -> Option<view::CycleRow> {
        self.unshown.cycles.pop_front()
    }

    fn next_line(&mut self) -> Option<EventLine> {
        self.unshown.lines.pop_front()
    }
}

/// The step behind the one that runs, in words.
fn next(plan: &Plan, plan_s: f64) -> Option<String> {
    let now = plan.segment_at(plan_s)?;
    plan.segments()
        .iter()
        .skip_while(|segment| !std::ptr::eq(*segment, now))
        .skip(1)
        // A repeat comes back to the same lines: what comes next is the next of another line.
        .find(|segment| segment.line != now.line)
        .map(words)
}

fn words(segment: &Segment) -> String {
    match segment.motion {
        Motion::Hold => format!(
            "hold {:.2} um for {:.3} s",
            segment.from_um, segment.duration_s
        ),
        Motion::Move { to_um, .. } => {
            format!("go to {to_um:.2} um in {:.3} s", segment.duration_s)
        }
        Motion::Wave {
            shape,
            amplitude_um,
            frequency_hz,
            ..
        } => format!(
            "{} of {amplitude_um:.2} um at {frequency_hz:.3} Hz",
            shape.name()
        ),
        Motion::Points { period_s, .. } => format!("waveform, {period_s:.3} s a cycle"),
        Motion::Wait { condition, .. } => match condition {
            Condition::Settled { within_um, .. } => {
                format!("wait until the error stays within {within_um:.3} um")
            }
            Condition::Position { level_um, above } => {
                format!("wait for a position {} {level_um:.2} um", side(above))
            }
            Condition::CellLength { level_um, above } => {
                format!("wait for a length {} {level_um:.2} um", side(above))
            }
        },
    }
}

fn side(above: bool) -> &'static str {
    if above { "above" } else { "below" }
}
