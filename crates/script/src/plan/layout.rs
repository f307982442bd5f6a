//! Laying a script out in time.

use super::course::Periodic;
use super::parts::{ArmKind, Cycles, Mark, Motion, Plan, Segment};
use crate::error::ScriptError;
use crate::script::{Load, MoveShape, Script, Step, StepKind};
use std::collections::BTreeMap;
use std::ops::Range;

/// Most segments of a plan.
const MAX_SEGMENTS: usize = 2_000_000;
/// Longest plan, s: thirty days.
const MAX_S: f64 = 30.0 * 86_400.0;
/// Longest hold of a shortened plan, s.
const SHORT_HOLD_S: f64 = 20.0;

/// Results of a labelled step.
#[derive(Debug, Clone, Copy)]
struct Arm {
    cycles: u64,
    duration_s: f64,
    mean_um: f64,
    peak_um: f64,
}

/// Lays the steps of a script out one after the other.
pub(super) struct Layout<'s> {
    script: &'s Script,
    short: bool,
    time_s: f64,
    at_um: f64,
    /// Integral of the position over time, um s.
    integral: f64,
    /// Positions reached since the innermost label began.
    range: Range<f64>,
    next_cycle: u64,
    /// Repeats that are being laid out: a pass of one is a cycle, and the values of a sweep in it are parts of that.
    repeats: usize,
    labels: BTreeMap<String, Arm>,
    plan: Plan,
}

impl Layout<'_> {
    /// The plan of a script; `short`: see [`Plan::shortened`].
    pub(super) fn of(script: &Script, short: bool, plan: Plan) -> Result<Plan, ScriptError> {
        let mut layout = Layout {
            script,
            short,
            time_s: 0.0,
            at_um: script.start_um,
            integral: 0.0,
            range: script.start_um..script.start_um,
            next_cycle: 0,
            repeats: 0,
            labels: BTreeMap::new(),
            plan,
        };
        layout.steps(&script.steps)?;
        layout.plan.duration_s = layout.time_s;
        Ok(layout.plan)
    }

    fn fail(&self, step: &Step, message: String, help: &str) -> ScriptError {
        ScriptError::new(
            &self.script.file,
            &self.script.text,
            step.span.clone(),
            message,
            Some(help.to_owned()),
        )
    }

    fn steps(&mut self, steps: &[Step]) -> Result<(), ScriptError> {
        steps.iter().try_for_each(|step| self.step(step))
    }

    /// Adds a segment that moves between positions `low` and `high` from here, with its mean.
    fn push(
        &mut self,
        step: &Step,
        motion: Motion,
        duration_s: f64,
        mean_um: f64,
        (low, high): (f64, f64),
    ) -> Result<(), ScriptError> {
        if self.plan.segments.len() >= MAX_SEGMENTS || self.time_s + duration_s > MAX_S {
            return Err(self.fail(
                step,
                format!("the script is longer than {MAX_SEGMENTS} segments or thirty days"),
                "use fewer repeats, or a wave instead of single moves",
            ));
        }
        self.plan.segments.push(Segment {
            start_s: self.time_s,
            duration_s,
            from_um: self.at_um,
            motion,
            line: step.line,
            periodic: None,
        });
        self.time_s += duration_s;
        self.integral += mean_um * duration_s;
        self.range = self.range.start.min(low)..self.range.end.max(high);
        Ok(())
    }

    fn cycles(&mut self, start_s: f64, period_s: f64, count: u64) {
        self.arm_cycles(start_s, period_s, count, ArmKind::Cyclic, false);
    }

    fn arm_cycles(&mut self, start_s: f64, period_s: f64, count: u64, arm: ArmKind, ramp: bool) {
        if count == 0 {
            return;
        }
        self.plan.cycles.push(Cycles {
            arm,
            ramp,
            first: self.next_cycle,
            count,
            start_s,
            period_s,
        });
        self.next_cycle += count;
    }

    fn go(
        &mut self,
        step: &Step,
        to_um: f64,
        duration_s: f64,
        shape: MoveShape,
    ) -> Result<(), ScriptError> {
        let from = self.at_um;
        let motion = Motion::Move { shape, to_um };
        let ends = (from.min(to_um), from.max(to_um));
        self.push(step, motion, duration_s, (from + to_um) / 2.0, ends)?;
        self.at_um = to_um;
        Ok(())
    }

    fn hold(&mut self, step: &Step, duration_s: f64) -> Result<(), ScriptError> {
        // After a while a hold makes no new demands.
        let duration_s = if self.short {
            duration_s.min(SHORT_HOLD_S)
        } else {
            duration_s
        };
        let at = self.at_um;
        self.push(step, Motion::Hold, duration_s, at, (at, at))
    }

    fn step(&mut self, step: &Step) -> Result<(), ScriptError> {
        let began = (self.time_s, self.integral, self.at_um);
        let cycles_before = self.next_cycle;
        let outer = std::mem::replace(&mut self.range, self.at_um..self.at_um);
        self.inner(step)?;
        if let Some(label) = &step.label {
            let duration_s = self.time_s - began.0;
            let far = |x: f64| (x - began.2).abs();
            let peak_um = if far(self.range.start) > far(self.range.end) {
                self.range.start
            } else {
                self.range.end
            };
            let mean_um = if duration_s > 0.0 {
                (self.integral - began.1) / duration_s
            } else {
                self.at_um
            };
            let arm = Arm {
                cycles: self.next_cycle - cycles_before,
                duration_s,
                mean_um,
                peak_um,
            };
            self.labels.insert(label.clone(), arm);
        }
        self.range = self.range.start.min(outer.start)..self.range.end.max(outer.end);
        Ok(())
    }

    fn inner(&mut self, step: &Step) -> Result<(), ScriptError> {
        match &step.kind {
            StepKind::Hold { duration_s } => self.hold(step, *duration_s),
            StepKind::Move {
                to_um,
                duration_s,
                speed_um_per_s,
                shape,
            } => {
                let distance = (to_um - self.at_um).abs();
                let duration_s = match (duration_s, speed_um_per_s) {
                    (Some(duration_s), _) => *duration_s,
                    (None, Some(speed)) => distance / speed,
                    (None, None) => 0.0,
                };
                self.go(step, *to_um, duration_s, *shape)
            }
            StepKind::Wave { .. } => self.wave(step),
            StepKind::Waveform { points, cycles } => self.waveform(step, points, *cycles),
            StepKind::Repeat { times, steps } => {
                let times = if self.short { (*times).min(3) } else { *times };
                for _ in 0..times {
                    self.repeats += 1;
                    let laid = self.pass(steps);
                    self.repeats -= 1;
                    laid?;
                }
                Ok(())
            }
            StepKind::Sweep(passes) if self.repeats == 0 => {
                passes.iter().try_for_each(|steps| self.pass(steps))
            }
            StepKind::Sweep(passes) => passes.iter().try_for_each(|steps| self.steps(steps)),
            StepKind::Wait {
                condition,
                timeout_s,
                on_timeout,
            } => {
                let motion = Motion::Wait {
                    condition: *condition,
                    timeout_s: *timeout_s,
                    on_timeout: *on_timeout,
                };
                let wait = (self.plan.segments.len(), self.time_s);
                self.push(step, motion, 0.0, self.at_um, (self.at_um, self.at_um))?;
                self.plan.waits.push(wait);
                Ok(())
            }
            StepKind::Mark { text } => {
                if self.plan.marks.len() < MAX_SEGMENTS {
                    self.plan.marks.push(Mark {
                        time_s: self.time_s,
                        after_wait: (self.plan.waits.last())
                            .is_some_and(|(_, wait_s)| *wait_s == self.time_s),
                        text: text.clone(),
                    });
                }
                Ok(())
            }
            StepKind::Static { like, load } => self.static_arm(step, like, *load),
        }
    }

    /// A pass of a repeat or a sweep. It is a cycle if it contains neither a wave nor passes that count already.
    fn pass(&mut self, steps: &[Step]) -> Result<(), ScriptError> {
        let (start_s, cycles) = (self.time_s, self.next_cycle);
        self.steps(steps)?;
        if self.next_cycle == cycles && self.time_s > start_s {
            self.cycles(start_s, self.time_s - start_s, 1);
        }
        Ok(())
    }

    fn wave(&mut self, step: &Step) -> Result<(), ScriptError> {
        let StepKind::Wave {
            shape,
            amplitude_um,
            frequency_hz,
            cycles,
            ramp_in,
            ramp_out,
        } = step.kind
        else {
            return Ok(());
        };
        let cycles = if self.short {
            cycles.min(ramp_in + ramp_out + 6)
        } else {
            cycles
        };
        let motion = Motion::Wave {
            shape,
            amplitude_um,
            frequency_hz,
            ramp_in: ramp_in as f64,
            ramp_out: ramp_out as f64,
        };
        let (at, start_s) = (self.at_um, self.time_s);
        let reach = (at - amplitude_um, at + amplitude_um);
        self.push(step, motion, cycles as f64 / frequency_hz, at, reach)?;
        let full = cycles.saturating_sub(ramp_in + ramp_out);
        self.repeats(Periodic::wave(shape, amplitude_um, frequency_hz), full);
        let period_s = 1.0 / frequency_hz;
        let ramp_in = ramp_in.min(cycles);
        let ramp_out = ramp_out.min(cycles - ramp_in);
        let mut before = 0;
        for (count, ramp) in [
            (ramp_in, true),
            (cycles - ramp_in - ramp_out, false),
            (ramp_out, true),
        ] {
            let from_s = start_s + before as f64 * period_s;
            self.arm_cycles(from_s, period_s, count, ArmKind::Cyclic, ramp);
            before += count;
        }
        Ok(())
    }

    fn waveform(
        &mut self,
        step: &Step,
        points: &[(f64, f64)],
        cycles: u64,
    ) -> Result<(), ScriptError> {
        let cycles = if self.short { cycles.min(3) } else { cycles };
        let period_s = points.last().map_or(0.0, |(time, _)| *time);
        let first = self.points(step, points)?;
        let area: f64 = points
            .windows(2)
            .map(|pair| (pair[1].0 - pair[0].0) * (pair[0].1 + pair[1].1) / 2.0)
            .sum();
        let (low, high) = points.iter().fold((0.0f64, 0.0f64), |(low, high), (_, x)| {
            (low.min(*x), high.max(*x))
        });
        let count = points.len();
        let motion = Motion::Points {
            first,
            count,
            period_s,
        };
        let (at, start_s) = (self.at_um, self.time_s);
        let reach = (at + low, at + high);
        let mean_um = at + area / period_s;
        self.push(step, motion, cycles as f64 * period_s, mean_um, reach)?;
        self.repeats(Periodic::points(first, count, period_s), cycles);
        self.cycles(start_s, period_s, cycles);
        Ok(())
    }

    /// The points of a waveform in the plan. Equal points are stored once, so a repeat takes no more room than one pass.
    fn points(&mut self, step: &Step, points: &[(f64, f64)]) -> Result<usize, ScriptError> {
        let all = &self.plan.points;
        let mut known = self.plan.periodic.iter().filter_map(Periodic::span);
        if let Some(span) = known.find(|span| all.get(span.clone()) == Some(points)) {
            return Ok(span.start);
        }
        let first = all.len();
        if first + points.len() > MAX_SEGMENTS {
            let help = "put the repetition into `cycles` of the waveform";
            return Err(self.fail(step, "too many points in all".to_owned(), help));
        }
        self.plan.points.extend(points);
        Ok(first)
    }

    /// Marks the segment pushed last as a periodic motion with `full` cycles at full amplitude.
    fn repeats(&mut self, motion: Periodic, full: u64) {
        let known = &mut self.plan.periodic;
        let number = match known.iter().position(|other| other.moves_as(&motion)) {
            Some(number) => number,
            None if known.len() < Periodic::MOST => {
                known.push(motion);
                known.len() - 1
            }
            // It gets no number, because nothing can be learned on it.
            None => return,
        };
        if let Some(motion) = known.get_mut(number) {
            motion.cycles += full;
        }
        if let Some(segment) = self.plan.segments.last_mut() {
            segment.periodic = u16::try_from(number).ok();
        }
    }

    fn static_arm(&mut self, step: &Step, like: &str, load: Load) -> Result<(), ScriptError> {
        let Some(arm) = self.labels.get(like).copied() else {
            let names: Vec<&str> = self.labels.keys().map(String::as_str).collect();
            let near = crate::error::nearest(like, &names);
            let help = match (near, names.is_empty()) {
                (Some(near), _) => format!("did you mean `{near}`?"),
                (None, true) => "give the step above a label".to_owned(),
                (None, false) => format!("labels above: {}", names.join(", ")),
            };
            let message = format!("no step above is labelled `{like}`");
            return Err(self.fail(step, message, &help));
        };
        let home_um = self.at_um;
        let load_um = match load {
            Load::Mean => arm.mean_um,
            Load::Peak => arm.peak_um,
        };
        let (start_s, cycles) = (self.time_s, arm.cycles);
        let travel_s = (arm.duration_s * 0.1).min(1.0);
        self.go(step, load_um, travel_s, MoveShape::MinimumJerk)?;
        self.hold(step, arm.duration_s - 2.0 * travel_s)?;
        self.go(step, home_um, travel_s, MoveShape::MinimumJerk)?;
        if cycles > 0 && arm.duration_s > 0.0 {
            let period_s = arm.duration_s / cycles as f64;
            self.arm_cycles(start_s, period_s, cycles, ArmKind::Static, false);
        }
        Ok(())
    }
}
